//! Resampling of pictures.

use fast_image_resize::images::{TypedImage, TypedImageRef};
use fast_image_resize::pixels::U8x3;
use fast_image_resize::{FilterType, ResizeAlg, ResizeOptions, Resizer};
use image::RgbImage;

/// Resampling filter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Filter {
    /// Triangle.
    Bilinear,
    /// Catmull-Rom.
    Bicubic,
}

/// Resizes a picture to `(width, height)` pixels like Pillow: with a filter that widens when
/// shrinking (antialias), and eight bits between the passes.
#[must_use]
pub fn resize(picture: &RgbImage, (width, height): (u32, u32), filter: Filter) -> RgbImage {
    if picture.dimensions() == (width, height) {
        return picture.clone();
    }
    let filter = match filter {
        Filter::Bilinear => FilterType::Bilinear,
        Filter::Bicubic => FilterType::CatmullRom,
    };
    let options = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(filter));
    let mut resized = RgbImage::new(width, height);
    // One pixel type only: the version for all types takes the compiler minutes.
    let source = TypedImageRef::<U8x3>::from_buffer(picture.width(), picture.height(), picture);
    let target = TypedImage::<U8x3>::from_buffer(width, height, &mut resized);
    let done = match (source, target) {
        (Ok(source), Ok(mut target)) => {
            Resizer::new().resize_typed(&source, &mut target, &options).is_ok()
        }
        _ => false,
    };
    debug_assert!(done, "resizing {:?} to {width}x{height}", picture.dimensions());
    resized
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;

    #[test]
    fn shrinking_averages_and_the_same_size_changes_nothing() {
        let stripes = RgbImage::from_fn(64, 8, |x, _| Rgb([255 * (x % 2) as u8; 3]));
        assert_eq!(resize(&stripes, (64, 8), Filter::Bilinear), stripes);
        for filter in [Filter::Bilinear, Filter::Bicubic] {
            let shrunk = resize(&stripes, (4, 4), filter);
            assert_eq!(shrunk.dimensions(), (4, 4));
            assert!(shrunk.pixels().all(|pixel| pixel[0].abs_diff(127) < 8), "{shrunk:?}");
        }
    }

    #[test]
    fn an_empty_picture_gives_a_black_one() {
        let empty = RgbImage::new(0, 0);
        assert_eq!(resize(&empty, (2, 2), Filter::Bilinear), RgbImage::new(2, 2));
    }
}
