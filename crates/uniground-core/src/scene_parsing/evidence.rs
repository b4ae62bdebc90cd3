//! Evidence pictures for people: of every view a crop and the full frame with a red box, the instance outlined in both (paper: candidate
//! visual evidence). Models get collages, whose outlines are drawn at their own size: [`crate::render::Shot::of_view`].

use super::ParseError;
use crate::progress::Progress;
use crate::render::{Around, crop_area, cut, draw_outline, jpeg, outline_reach, shares};
use crate::scene::{CellMask, FrameRef, Instance, InstanceId, View, stream_frames};
use image::{Rgb, RgbImage};

/// Which of the two pictures of a view.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Picture {
    /// The instance and a little around it: outlined, its surroundings dimmed.
    Crop,
    /// The whole photograph, with a red box around the outlined instance.
    Frame,
}

/// One encoded picture.
pub struct EvidencePicture {
    /// Whose picture it is.
    pub instance: InstanceId,
    /// Position in [`Instance::views`].
    pub view: usize,
    /// Crop or whole frame.
    pub picture: Picture,
    /// The encoded file.
    pub jpeg: Vec<u8>,
}

const RED: Rgb<u8> = Rgb([230, 20, 20]);

/// Instance, position among its views, and the view itself.
type WantedView<'a> = (InstanceId, usize, &'a View);

/// Renders the evidence of all instances, frame by frame, and hands each picture to `keep`.
///
/// # Errors
/// [`ParseError`] for unreadable frames and cancellation, or whatever `keep` fails with.
pub fn render<E: From<ParseError> + Send>(
    frames: &[FrameRef],
    instances: &[Instance],
    progress: &Progress,
    mut keep: impl FnMut(EvidencePicture) -> Result<(), E>,
) -> Result<(), E> {
    let wanted: Vec<(&FrameRef, Vec<WantedView>)> = frames
        .iter()
        .map(|frame| {
            let views = instances.iter().flat_map(|i| i.views.iter().enumerate().map(|(k, view)| (i.id, k, view)));
            (frame, views.filter(|(_, _, view)| view.frame == frame.index).collect::<Vec<_>>())
        })
        .filter(|(_, views)| !views.is_empty())
        .collect();
    let refs: Vec<FrameRef> = wanted.iter().map(|(frame, _)| (*frame).clone()).collect();
    let views_of = |frame: &FrameRef| wanted.iter().find(|(f, _)| f.index == frame.index).map_or(&[][..], |(_, views)| views);
    stream_frames(
        &refs,
        |frame| {
            progress.check().map_err(ParseError::from)?;
            let colour = frame.decode_colour().map_err(ParseError::from)?;
            Ok(views_of(frame).iter().flat_map(|&(id, k, view)| pictures(&colour, id, k, view)).collect::<Vec<_>>())
        },
        |i, pictures: Vec<EvidencePicture>| {
            progress.report("evidence", i as f32 / refs.len() as f32).map_err(ParseError::from)?;
            pictures.into_iter().try_for_each(&mut keep)
        },
    )
}

/// One picture of a view, from the photograph it is of: a JPEG file.
#[must_use]
pub fn picture(colour: &RgbImage, seen: &View, picture: Picture) -> Vec<u8> {
    let [crop, frame] = pictures(colour, InstanceId(0), 0, seen);
    match picture {
        Picture::Crop => crop.jpeg,
        Picture::Frame => frame.jpeg,
    }
}

fn pictures(colour: &RgbImage, instance: InstanceId, view: usize, seen: &View) -> [EvidencePicture; 2] {
    let area = crop_area(seen.box_px, colour.dimensions());
    let (mut crop, mut boxed, mut around) = (cut(colour, area), colour.clone(), seen.box_px);
    if let Some(mask) = seen.mask.as_ref().and_then(CellMask::unpacked) {
        let of = |picture: &RgbImage| (0, 0, picture.width(), picture.height());
        let (in_crop, in_frame) = (of(&crop), of(&boxed));
        draw_outline(&mut crop, in_crop, &mask, shares(seen.box_px, area), Around::Dimmed);
        draw_outline(&mut boxed, in_frame, &mask, shares(seen.box_px, [0, 0, in_frame.2, in_frame.3]), Around::Kept);
        // The box leaves room for the outline.
        let ([left, top, right, bottom], room) = (around, outline_reach(in_frame.2, in_frame.3));
        around = [left.saturating_sub(room), top.saturating_sub(room), (right + room).min(in_frame.2), (bottom + room).min(in_frame.3)];
    }
    draw_box(&mut boxed, around);
    let picture = |picture, image: &RgbImage| EvidencePicture { instance, view, picture, jpeg: jpeg(image) };
    [picture(Picture::Crop, &crop), picture(Picture::Frame, &boxed)]
}

/// A red outline just outside the box, three pixels wide, clipped to the picture.
fn draw_box(image: &mut RgbImage, [left, top, right, bottom]: [u32; 4]) {
    const WIDTH: i64 = 3;
    let (w, h) = (i64::from(image.width()), i64::from(image.height()));
    let [l, t, r, b] = [left, top, right, bottom].map(i64::from);
    let mut put = |x: i64, y: i64| {
        if (0..w).contains(&x) && (0..h).contains(&y) {
            image.put_pixel(x as u32, y as u32, RED);
        }
    };
    for k in 1..=WIDTH {
        for x in l - k..r + k {
            // At the picture's rim the outline moves inside, so that it stays visible.
            put(x, (t - k).max(WIDTH - k));
            put(x, (b - 1 + k).min(h - 1 - (WIDTH - k)));
        }
        for y in t - k..b + k {
            put((l - k).max(WIDTH - k), y);
            put((r - 1 + k).min(w - 1 - (WIDTH - k)), y);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::FrameIndex;

    #[test]
    fn the_frame_has_a_red_box_around_the_object_and_the_crop_an_outline() {
        let colour = RgbImage::from_pixel(400, 300, Rgb([90, 90, 90]));
        let mask = CellMask::of(8, 8, |column, row| column + row < 8).packed();
        let seen = View { frame: FrameIndex(0), visible_points: 9, box_px: [100, 100, 180, 180], mask: Some(mask) };
        let [crop, frame] = pictures(&colour, InstanceId(1), 0, &seen);
        let decoded = |p: &EvidencePicture| image::load_from_memory(&p.jpeg).unwrap().into_rgb8();
        let (crop, frame) = (decoded(&crop), decoded(&frame));
        assert_eq!((crop.dimensions(), frame.dimensions()), ((224, 224), (400, 300)));
        let reddish = |p: &Rgb<u8>| p.0[0] > 150 && p.0[1] < 110;
        let yellowish = |p: &&Rgb<u8>| p.0[0] > 150 && p.0[1] > 150 && p.0[2] < 130;
        assert!(reddish(frame.get_pixel(94, 140)) && reddish(frame.get_pixel(140, 94)) && !reddish(frame.get_pixel(120, 120)));
        assert!(frame.pixels().filter(yellowish).count() > 80 && crop.pixels().filter(yellowish).count() > 80);
        assert!(crop.pixels().all(|p| !reddish(p)) && crop.get_pixel(2, 2).0[0] < 70, "dimmed");
    }

    #[test]
    fn a_box_at_the_rim_stays_visible() {
        let mut image = RgbImage::new(20, 20);
        draw_box(&mut image, [0, 0, 20, 20]);
        assert_eq!((*image.get_pixel(0, 10), *image.get_pixel(19, 10)), (RED, RED));
        assert_ne!(*image.get_pixel(10, 10), RED);
    }
}
