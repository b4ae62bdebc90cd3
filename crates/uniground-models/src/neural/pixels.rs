//! Converts pictures to tensors: resized as in the network's training, then normalized, channel by
//! channel.

use super::bundle::{Interpolation, Resize};
use image::{RgbImage, imageops};
use uniground_geometry::resize::{Filter, resize};

/// A picture of the size that a network requires.
pub struct Fitted {
    pub picture: RgbImage,
    /// Network pixels per picture pixel, along x and y.
    pub scale: (f32, f32),
}

/// Resizes a picture to `size` (width, height). Padding is not part of the result.
#[must_use]
pub fn resize_to_fit(
    picture: &RgbImage,
    size: [u32; 2],
    resize: Resize,
    interpolation: Interpolation,
) -> Fitted {
    let (w, h) = picture.dimensions();
    let rounded = |k: f64| ((f64::from(w) * k + 0.5) as u32, (f64::from(h) * k + 0.5) as u32);
    let (new_w, new_h) = match resize {
        Resize::Squash => (size[0], size[1]),
        Resize::ShortestCenterCrop => {
            let k = (f64::from(size[0]) / f64::from(w)).max(f64::from(size[1]) / f64::from(h));
            // The longer side is cut off, not rounded, as in torchvision and Transformers.
            let cut_off = |side: u32| (f64::from(side) * k + 1e-6) as u32;
            (cut_off(w).max(size[0]), cut_off(h).max(size[1]))
        }
        Resize::LongestPad => {
            let (new_w, new_h) =
                rounded((f64::from(size[0]) / f64::from(w)).min(f64::from(size[1]) / f64::from(h)));
            (new_w.clamp(1, size[0]), new_h.clamp(1, size[1]))
        }
    };
    let resized = resample(picture, (new_w, new_h), interpolation);
    let picture = match resize {
        Resize::ShortestCenterCrop => imageops::crop_imm(
            &resized,
            (new_w - size[0]) / 2,
            (new_h - size[1]) / 2,
            size[0],
            size[1],
        )
        .to_image(),
        Resize::Squash | Resize::LongestPad => resized,
    };
    Fitted { picture, scale: (new_w as f32 / w as f32, new_h as f32 / h as f32) }
}

/// Resamples like Pillow. The networks were exported with Pillow's results, and some of them are
/// sensitive to the difference.
fn resample(picture: &RgbImage, size: (u32, u32), interpolation: Interpolation) -> RgbImage {
    let filter = match interpolation {
        Interpolation::Bilinear => Filter::Bilinear,
        Interpolation::Bicubic => Filter::Bicubic,
    };
    resize(picture, size, filter)
}

/// Appends `(value / divisor - mean) / std`, channel by channel, into a plane of `size`. Pixels
/// that the picture does not cover are 0.
pub fn append_planes(
    picture: &RgbImage,
    size: [u32; 2],
    divisor: f32,
    mean: [f32; 3],
    std: [f32; 3],
    values: &mut Vec<f32>,
) {
    let (width, height) = (size[0] as usize, size[1] as usize);
    let start = values.len();
    values.resize(start + 3 * width * height, 0.0);
    let row_bytes = picture.width() as usize * 3;
    for (channel, plane) in values[start..].chunks_exact_mut(width * height).enumerate() {
        let table: Vec<f32> =
            (0..=255_u8).map(|v| (f32::from(v) / divisor - mean[channel]) / std[channel]).collect();
        for (row, pixels) in
            plane.chunks_exact_mut(width).zip(picture.as_raw().chunks_exact(row_bytes))
        {
            for (value, pixel) in row.iter_mut().zip(pixels.as_chunks::<3>().0) {
                *value = table[usize::from(pixel[channel])];
            }
        }
    }
}
