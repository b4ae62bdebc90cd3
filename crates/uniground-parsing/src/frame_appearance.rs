//! Embeddings of whole frames, so that a text query can find photographs of objects that are in no
//! instance.
//!
//! Small things vanish in one vector of a photograph. So six overlapping crops are embedded besides
//! the whole, in two rows of three.

use super::model_clock::PictureEncoder;
use super::{ParseError, frame_sampling};
use image::{RgbImage, imageops};
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{FrameEmbeddings, FrameRef, stream_frames};
use uniground_types::settings::{AppearanceSettings, FrameSamplingSettings};

/// Embeds some of these frames, spread along the camera's path. `None` where no frame embeddings
/// are configured or there are no frames.
///
/// # Errors
/// [`ParseError`]: an unreadable frame, an encoder that fails, cancellation.
pub fn embed_frames(
    frames: &[FrameRef],
    encoder: &PictureEncoder,
    settings: &AppearanceSettings,
    progress: &Progress,
) -> Result<Option<FrameEmbeddings>, ParseError> {
    if settings.frames == 0 || frames.is_empty() {
        return Ok(None);
    }
    let spread = FrameSamplingSettings {
        max_frames: Some(settings.frames),
        ..FrameSamplingSettings::default()
    };
    let frames = frame_sampling::sample_frames(frames, &spread);
    let (mut of_row, mut rows) = (Vec::new(), Vec::new());
    stream_frames(
        &frames,
        |frame| {
            progress.check()?;
            encoder.embed(&overlapping_crops(&frame.decode_color()?), progress)
        },
        |i, vectors| {
            of_row.extend(vectors.iter().map(|_| frames[i].index));
            rows.extend(vectors.into_iter().flatten());
            Ok(progress.report("frame_appearance", (i + 1) as f32 / frames.len() as f32)?)
        },
    )?;
    Ok(Some(FrameEmbeddings::new(encoder.dim(), of_row, &rows)))
}

/// Returns the whole picture, and crops of half its width and two thirds of its height that overlap
/// by half.
fn overlapping_crops(picture: &RgbImage) -> Vec<RgbImage> {
    let (width, height) = picture.dimensions();
    let (w, h) = ((width / 2).max(1), (height * 2 / 3).max(1));
    let places =
        [0, height - h].into_iter().flat_map(|y| [0, (width - w) / 2, width - w].map(|x| (x, y)));
    let cut = places.map(|(x, y)| imageops::crop_imm(picture, x, y, w, h).to_image());
    [picture.clone()].into_iter().chain(cut).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn crops_cover_the_picture() {
        let picture = RgbImage::from_fn(120, 90, |x, y| image::Rgb([x as u8, y as u8, 0]));
        let crops = overlapping_crops(&picture);
        let sizes: Vec<_> = crops.iter().map(RgbImage::dimensions).collect();
        assert_eq!(sizes, [[(120, 90)].as_slice(), &[(60, 60); 6]].concat());
        let corners: Vec<_> = crops[1..]
            .iter()
            .map(|crop| (crop.get_pixel(0, 0).0[0], crop.get_pixel(0, 0).0[1]))
            .collect();
        assert_eq!(corners, [(0, 0), (30, 0), (60, 0), (0, 30), (30, 30), (60, 30)]);
    }
}
