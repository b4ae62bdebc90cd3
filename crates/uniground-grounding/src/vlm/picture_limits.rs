//! Limits of a model on the pictures of one request. Where a request has more pictures than the model
//! accepts, several are put on one, each under a tag with its number, and places in it are led back
//! to the pictures they lie in.

use super::PointForm;
use super::reply::SeenAt;
use super::visual_evidence::{encoded, shrink};
use crate::Seen;
use futures::channel::oneshot;
use image::{Rgb, RgbImage};
use uniground_models::chat::{AskError, ChatRequest, Part, Picture, Session};
use uniground_render::{Area, combine_pictures};

/// Longer side of a picture of several pictures without a limit of its own, pixels: larger ones are
/// reduced by most providers.
const COMBINED_PX: u32 = 2048;

/// What a model accepts in one request.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PictureLimits {
    /// Maximum number of pictures.
    pub count: Option<u32>,
    /// Maximum size of the longer side, pixels.
    pub side_px: Option<u32>,
}

/// The pictures of a request as they were sent.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SentPictures {
    sent: Vec<Picture>,
    /// The images of the prompt, in order.
    images: Vec<Image>,
}

/// Where an image of the prompt is in the pictures that were sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImagePart {
    /// Its part of a picture, pixels.
    pub area: Area,
    /// Width and height of that picture, pixels.
    pub picture_px: (u32, u32),
}

/// An image of the prompt.
#[derive(Debug, Clone, PartialEq)]
struct Image {
    name: String,
    /// Index of the picture that it was sent in.
    sent_in: usize,
    /// Its part of that picture, pixels.
    area: Area,
}

/// A place where a model sees an object.
#[derive(Debug, Clone, PartialEq)]
pub struct Sighting {
    /// The place in the picture that was sent.
    pub shown: Seen,
    /// The same place in the image that lies there, before images were combined; `None` for a
    /// place between them.
    pub original: Option<Seen>,
}

impl PictureLimits {
    /// Returns what x and y are counted in, for a prompt with this many images. `whole_image` is how
    /// the prompt refers to an image that was sent as it is.
    #[must_use]
    pub fn describe_whole(self, images: usize, whole_image: &'static str) -> &'static str {
        match self.combines(images) {
            true => "the whole picture that the image is part of",
            false => whole_image,
        }
    }

    /// Changes a request so that the model accepts its pictures, and says in its text where its
    /// images are. `call` is the number of the call in its session, for the names of pictures.
    #[must_use]
    pub fn apply(self, call: u32, mut request: ChatRequest) -> (ChatRequest, SentPictures) {
        let images = pictures_of(&request);
        let sent = if self.combines(images.len()) {
            let sent = self.combined(call, &images);
            let note = sent.describe();
            let others = request.user.into_iter().filter(|part| matches!(part, Part::Text(_)));
            let pictures = sent.sent.iter().cloned().map(Part::Picture);
            request.user = pictures.chain([Part::Text(note)]).chain(others).collect();
            sent
        } else {
            let sent =
                SentPictures::of(images.into_iter().map(|image| self.reduced(image)).collect());
            let mut reduced = sent.sent.iter();
            for part in &mut request.user {
                if let Part::Picture(picture) = part
                    && let Some(reduced) = reduced.next()
                {
                    picture.clone_from(reduced);
                }
            }
            sent
        };
        (request, sent)
    }

    fn combines(self, images: usize) -> bool {
        self.count.is_some_and(|count| images > count.max(1) as usize)
    }

    fn reduced(self, picture: Picture) -> Picture {
        match self.side_px {
            Some(px) if picture.width.max(picture.height) > px => {
                encoded(picture.name.clone(), &shrink(decoded(&picture), px))
            }
            _ => picture,
        }
    }

    /// Puts neighboring images on one picture, so that all pictures have about the same area.
    fn combined(self, call: u32, images: &[Picture]) -> SentPictures {
        let count = u64::from(self.count.unwrap_or(1).max(1));
        let area = |image: &Picture| u64::from(image.width) * u64::from(image.height) + 1;
        let whole: u64 = images.iter().map(area).sum();
        let (mut groups, mut before) = (vec![Vec::new(); count as usize], 0);
        for (number, image) in images.iter().enumerate() {
            let group = (before + area(image) / 2) * count / whole;
            groups[group as usize].push((number, image));
            before += area(image);
        }
        groups.retain(|group| !group.is_empty());
        let mut all = SentPictures::default();
        for group in groups {
            let tagged: Vec<(String, RgbImage)> = group
                .iter()
                .map(|(number, image)| (format!("Image {}", number + 1), decoded(image)))
                .collect();
            let combined = combine_pictures(&tagged, self.side_px.unwrap_or(COMBINED_PX));
            let sent_in = all.sent.len();
            all.images.extend(group.iter().zip(combined.areas).map(|((_, image), area)| Image {
                name: image.name.clone(),
                sent_in,
                area,
            }));
            all.sent
                .push(encoded(format!("call-{call}-images-{}", sent_in + 1), &combined.picture));
        }
        all
    }
}

impl SentPictures {
    /// Pictures that were sent one by one.
    #[must_use]
    pub fn of(sent: Vec<Picture>) -> Self {
        let image = |(sent_in, picture): (usize, &Picture)| Image {
            name: picture.name.clone(),
            sent_in,
            area: (0, 0, picture.width, picture.height),
        };
        Self { images: sent.iter().enumerate().map(image).collect(), sent }
    }

    /// Returns where an image, counted from 1, is.
    #[must_use]
    pub fn part(&self, image: usize) -> Option<ImagePart> {
        let &Image { sent_in, area, .. } = self.images.get(image.checked_sub(1)?)?;
        let picture = &self.sent[sent_in];
        Some(ImagePart { area, picture_px: (picture.width, picture.height) })
    }

    /// Returns the place that a model gave in an image. `None` for an image that was not sent, and
    /// for a place outside of its picture.
    pub(super) fn sighting(&self, told: &SeenAt, points: PointForm) -> Option<Sighting> {
        let SeenAt { image, at, area, name } = told;
        let sent_in = self.images.get(image.checked_sub(1)?)?.sent_in;
        let picture = &self.sent[sent_in];
        let size = (picture.width, picture.height);
        let area = area.and_then(|area| points.area_to_shares(area, size));
        let at = match area {
            Some([left, top, right, bottom]) => {
                [f32::midpoint(left, right), f32::midpoint(top, bottom)]
            }
            None => points.to_shares(*at, size)?,
        };
        let (width, height) = (picture.width as f32, picture.height as f32);
        let px = [at[0] * width, at[1] * height];
        // Models give places more reliably than numbers of images.
        let original = self
            .images
            .iter()
            .filter(|image| image.sent_in == sent_in)
            .find_map(|image| Some((image, shares_of(image.area, px)?)))
            .map(|(image, at)| {
                let corner =
                    |x: f32, y: f32| clamped_shares_of(image.area, [x * width, y * height]);
                let area = area.map(|[left, top, right, bottom]| {
                    let ([left, top], [right, bottom]) = (corner(left, top), corner(right, bottom));
                    [left, top, right, bottom]
                });
                Seen { picture: image.name.clone(), at, area, name: name.clone() }
            });
        let shown = Seen { picture: picture.name.clone(), at, area, name: name.clone() };
        Some(Sighting { shown, original })
    }

    /// Tells the model which images each picture holds.
    fn describe(&self) -> String {
        let held = |sent_in: usize| {
            let of: Vec<usize> = (0..self.images.len())
                .filter(|&at| self.images[at].sent_in == sent_in)
                .map(|at| at + 1)
                .collect();
            match of[..] {
                [one] => format!("picture {} is image {one}", sent_in + 1),
                [first, .., last] => {
                    format!("picture {} holds images {first} to {last}", sent_in + 1)
                }
                [] => format!("picture {} is empty", sent_in + 1),
            }
        };
        let held: Vec<String> = (0..self.sent.len()).map(held).collect();
        format!(
            "The images are combined in fewer pictures: {}. Each image is below its tag, such as \"Image 1\".",
            held.join(", ")
        )
    }
}

/// Sends a request within these limits and records the result. Returns the reply's text and the
/// pictures that were sent.
///
/// # Errors
/// As [`Session::ask`].
pub(super) async fn ask_within(
    limits: PictureLimits,
    session: &mut Session<'_>,
    purpose: &'static str,
    request: ChatRequest,
) -> Result<(String, SentPictures), AskError> {
    let call = session.calls_made() + 1;
    let (request, sent) = if limits == PictureLimits::default() {
        limits.apply(call, request)
    } else {
        // Decoding and drawing would block the async thread.
        let (done, applied) = oneshot::channel();
        let unchanged = request.clone();
        rayon::spawn(move || drop(done.send(limits.apply(call, request))));
        applied.await.unwrap_or_else(|_| PictureLimits::default().apply(call, unchanged))
    };
    Ok((session.ask(purpose, request).await?, sent))
}

/// Returns the pictures of a request, in order.
fn pictures_of(request: &ChatRequest) -> Vec<Picture> {
    let picture = |part: &Part| match part {
        Part::Picture(picture) => Some(picture.clone()),
        Part::Text(_) => None,
    };
    request.user.iter().filter_map(picture).collect()
}

/// Returns the pixels of a picture that was encoded here; gray where it was too large for that.
fn decoded(picture: &Picture) -> RgbImage {
    image::load_from_memory(&picture.jpeg).map_or_else(
        |_| {
            let side = |px: u32| px.clamp(1, COMBINED_PX);
            RgbImage::from_pixel(side(picture.width), side(picture.height), Rgb([128; 3]))
        },
        image::DynamicImage::into_rgb8,
    )
}

/// Returns a place in a picture as shares of a part of it; `None` outside of the part.
fn shares_of(area: Area, px: [f32; 2]) -> Option<[f32; 2]> {
    let shares = unlimited_shares_of(area, px);
    shares.iter().all(|share| (0.0..=1.0).contains(share)).then_some(shares)
}

/// Returns the shares of the nearest place within the area.
fn clamped_shares_of(area: Area, px: [f32; 2]) -> [f32; 2] {
    unlimited_shares_of(area, px).map(|share| share.clamp(0.0, 1.0))
}

fn unlimited_shares_of((left, top, width, height): Area, px: [f32; 2]) -> [f32; 2] {
    [(px[0] - left as f32) / width as f32, (px[1] - top as f32) / height as f32]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seen(image: usize, at: [f32; 2]) -> SeenAt {
        SeenAt { image, at, area: None, name: "mug".into() }
    }

    fn request(images: u32) -> ChatRequest {
        let picture = |number: u32| {
            let drawn = RgbImage::from_pixel(800, 400, Rgb([20 * number as u8, 90, 90]));
            Part::Picture(encoded(format!("candidate-{number}"), &drawn))
        };
        let text = Part::Text("Query: the mug".into());
        let user = (1..=images).map(picture).chain([text]).collect();
        ChatRequest { system: String::new(), user, schema: None }
    }

    fn limits(count: Option<u32>, side_px: Option<u32>) -> PictureLimits {
        PictureLimits { count, side_px }
    }

    fn texts(request: &ChatRequest) -> Vec<&str> {
        let text = |part: &'_ Part| matches!(part, Part::Text(_));
        let parts = request.user.iter().filter(|part| text(part));
        parts.map(|part| if let Part::Text(text) = part { text.as_str() } else { "" }).collect()
    }

    #[test]
    fn request_within_the_limits_is_unchanged() {
        for limits in [limits(None, None), limits(Some(3), None), limits(Some(9), Some(800))] {
            let (sent, pictures) = limits.apply(1, request(3));
            assert_eq!(sent, request(3));
            let place =
                pictures.sighting(&seen(2, [500.0, 250.0]), PointForm::Thousandths).unwrap();
            assert_eq!(
                (place.shown.picture.as_str(), place.shown.at),
                ("candidate-2", [0.5, 0.25])
            );
            assert_eq!(place.original, Some(place.shown));
        }
    }

    #[test]
    fn large_pictures_are_reduced() {
        let (sent, pictures) = limits(None, Some(512)).apply(1, request(2));
        for picture in pictures_of(&sent) {
            assert_eq!((picture.width, picture.height), (512, 256));
            assert_eq!(decoded(&picture).dimensions(), (512, 256));
        }
        // Pixels are those of the picture that was sent.
        let place = pictures.sighting(&seen(1, [256.0, 64.0]), PointForm::Pixels).unwrap();
        assert_eq!(place.shown.at, [0.5, 0.25]);
    }

    #[test]
    fn more_images_than_the_limit_are_combined() {
        for count in 1..=9 {
            let (sent, pictures) = limits(Some(count), None).apply(1, request(10));
            let of_sent = pictures_of(&sent);
            assert_eq!(of_sent.len(), count as usize);
            assert_eq!(pictures.images.len(), 10);
            assert!(of_sent.iter().all(|p| p.width.max(p.height) <= COMBINED_PX));
            let [note, query] = texts(&sent)[..] else { panic!("{:?}", texts(&sent)) };
            assert!(note.starts_with("The images are combined"), "{note}");
            assert_eq!(query, "Query: the mug");
            assert_eq!(of_sent[0].name, "call-1-images-1");
        }
        let (sent, _) = limits(Some(2), None).apply(1, request(4));
        let note = "The images are combined in fewer pictures: picture 1 holds images 1 to 2, picture 2 holds images 3 to 4. Each image is \
                    below its tag, such as \"Image 1\".";
        assert_eq!(texts(&sent)[0], note);
    }

    #[test]
    fn place_in_a_combined_picture_leads_back_to_its_image() {
        let (sent, pictures) = limits(Some(1), Some(1000)).apply(1, request(6));
        let whole = &pictures_of(&sent)[0];
        let picture = decoded(whole);
        for (image, number) in pictures.images.iter().zip(1..) {
            let (left, top, width, height) = image.area;
            let px = [left as f32 + 0.25 * width as f32, top as f32 + 0.5 * height as f32];
            let red = picture.get_pixel(px[0] as u32, px[1] as u32).0[0];
            assert!(red.abs_diff(20 * number) < 8, "{red}");
            // Also where the model gives the number of another image.
            for told in [usize::from(number), 1, 6] {
                let place = pictures.sighting(&seen(told, px), PointForm::Pixels).unwrap();
                let original = place.original.unwrap();
                assert_eq!(
                    (place.shown.picture.as_str(), original.picture),
                    ("call-1-images-1", image.name.clone())
                );
                assert!(
                    (original.at[0] - 0.25).abs() < 1e-3 && (original.at[1] - 0.5).abs() < 1e-3
                );
            }
        }
        // A box that reaches into other images is cut off at the image in which its middle is.
        for image in &pictures.images {
            let (left, top, width, height) = image.area;
            let [left, top] = [left as f32 - 9.0, top as f32 - 9.0];
            let area = Some([left, top, left + width as f32 + 18.0, top + height as f32 + 18.0]);
            let told = SeenAt { area, ..seen(1, [0.0, 0.0]) };
            let original = pictures.sighting(&told, PointForm::Pixels).unwrap().original.unwrap();
            let expected = (image.name.clone(), Some([0.0, 0.0, 1.0, 1.0]));
            assert_eq!((original.picture, original.area), expected);
        }
        // So is a box beyond the picture.
        let area = Some([-50.0, -50.0, 5000.0, 5000.0]);
        let beyond = SeenAt { area, ..seen(1, [9000.0, 0.0]) };
        let place = pictures.sighting(&beyond, PointForm::Pixels).unwrap();
        assert_eq!((place.shown.area, place.shown.at), (Some([0.0, 0.0, 1.0, 1.0]), [0.5, 0.5]));
        // A tag is no place in an image.
        let on_tag = pictures.sighting(&seen(1, [3.0, 3.0]), PointForm::Pixels).unwrap();
        assert_eq!(on_tag.original, None);
        assert_eq!(pictures.sighting(&seen(7, [3.0, 3.0]), PointForm::Pixels), None);
        assert_eq!(pictures.sighting(&seen(0, [3.0, 3.0]), PointForm::Pixels), None);
    }
}
