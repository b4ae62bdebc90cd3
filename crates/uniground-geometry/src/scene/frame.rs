//! Posed RGB-D frames: references on disk and decoded pictures, one at a time.

use super::{Camera, Confidence, FrameIndex, Intrinsics, Optics, depth_file};
use crate::Isometry3;
use camino::{Utf8Path, Utf8PathBuf};
use image::{DynamicImage, GrayImage, ImageReader, Limits, RgbImage};
use serde::{Deserialize, Serialize};
use std::io;

/// File locations and camera of one frame. Decoding happens in [`FrameRef::decode`].
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct FrameRef {
    /// Position in the scan's own list, from 0; skipped frames leave gaps.
    pub index: FrameIndex,
    /// Time of the color picture, seconds since 1970. `None` if the scan does not state it, or
    /// counts it from another start.
    #[serde(default)]
    pub time_s: Option<f64>,
    /// Path of the color picture.
    #[serde(rename = "colour")]
    pub color: Utf8PathBuf,
    /// Path of the depth picture: 16-bit gray, or floats.
    pub depth: Utf8PathBuf,
    /// At the resolution of the color picture.
    #[serde(rename = "colour_intrinsics")]
    pub color_intrinsics: Intrinsics,
    /// At the resolution of the depth picture. If the depth camera is beside the color camera:
    /// those of the depth picture reprojected into the color camera.
    pub depth_intrinsics: Intrinsics,
    /// Meters per unit of the depth image.
    pub depth_scale_m: f32,
    /// Camera-to-world, OpenCV camera axes, Z-up world, meters.
    pub camera_to_world: Isometry3<f32>,
    /// Corrections that turn the files into pinhole pictures.
    pub optics: Optics,
}

/// A frame that could not be read.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // Every message describes its variant.
pub enum FrameError {
    #[error("frame {frame}: {file}: {source}")]
    Unreadable {
        frame: FrameIndex,
        file: Utf8PathBuf,
        #[source]
        source: io::Error,
    },
    #[error("frame {frame}: {file} cannot be decoded: {source}")]
    Undecodable {
        frame: FrameIndex,
        file: Utf8PathBuf,
        #[source]
        source: image::ImageError,
    },
    #[error(
        "frame {frame}: {file} is not a depth picture: it must be 16-bit gray, floats (EXR, TIFF), or 8-bit gray with a `depth_scale_m` of 0.004 or more; this is {found}"
    )]
    NotDepth { frame: FrameIndex, file: Utf8PathBuf, found: String },
    #[error(
        "frame {frame}: {file} is {found_width}x{found_height}, but its intrinsics are for {width}x{height}"
    )]
    WrongSize {
        frame: FrameIndex,
        file: Utf8PathBuf,
        found_width: u32,
        found_height: u32,
        width: u32,
        height: u32,
    },
}

/// Depth along the optical axis, meters; 0 = no measurement. Row-major.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthImage {
    /// Number of columns.
    pub width: u32,
    /// Number of rows.
    pub height: u32,
    /// `width * height` values, top row first.
    pub depth_m: Vec<f32>,
}

impl DepthImage {
    /// Returns the depth at a pixel, meters; 0 where nothing was measured.
    #[must_use]
    pub fn at(&self, (column, row): (u32, u32)) -> f32 {
        self.depth_m[(row * self.width + column) as usize]
    }
}

/// A decoded frame. Color and depth can have different resolutions; both have the same pose.
#[derive(Debug, Clone)]
pub struct Frame {
    /// Position in the scan's own list, from 0; skipped frames leave gaps.
    pub index: FrameIndex,
    /// 8-bit sRGB.
    pub color: RgbImage,
    /// On its own grid, see [`color_on_depth_grid`](Self::color_on_depth_grid).
    pub depth: DepthImage,
    /// Projects into pixels of `color`.
    pub color_camera: Camera,
    /// Projects into pixels of `depth`.
    pub depth_camera: Camera,
}

impl FrameRef {
    /// Returns the same frame with the paths of its files changed.
    #[must_use]
    pub fn with_paths(mut self, path: impl Fn(&Utf8Path) -> Utf8PathBuf) -> Self {
        self.color = path(&self.color);
        self.depth = path(&self.depth);
        if let Some(confidence) = &mut self.optics.confidence {
            confidence.file = path(&confidence.file);
        }
        self
    }

    /// Returns the camera that projects world points into pixels of the color picture.
    #[must_use]
    pub fn color_camera(&self) -> Camera {
        Camera::new(self.color_intrinsics, &self.camera_to_world)
    }

    /// Returns the camera that projects world points into pixels of the depth picture.
    #[must_use]
    pub fn depth_camera(&self) -> Camera {
        Camera::new(self.depth_intrinsics, &self.camera_to_world)
    }

    /// Reads both pictures of this frame.
    ///
    /// # Errors
    /// Returns a [`FrameError`] that names the frame and the file.
    pub fn decode(&self) -> Result<Frame, FrameError> {
        Ok(Frame {
            index: self.index,
            color: self.decode_color()?,
            depth: self.decode_depth()?,
            color_camera: self.color_camera(),
            depth_camera: self.depth_camera(),
        })
    }

    /// Reads the color picture, rectified.
    ///
    /// # Errors
    /// Returns a [`FrameError`] that names the frame and the file.
    pub fn decode_color(&self) -> Result<RgbImage, FrameError> {
        let image = self.read_picture(&self.color)?.into_rgb8();
        self.expect_size(&self.color, image.dimensions(), &self.color_intrinsics)?;
        Ok(match &self.optics.color_lens {
            Some(lens) => lens.rectify(&image, &self.color_intrinsics),
            None => image,
        })
    }

    /// Reads the depth picture, rectified and seen from the color camera. Depth of low confidence
    /// is left out.
    ///
    /// # Errors
    /// Returns a [`FrameError`] that names the frame and the file.
    pub fn decode_depth(&self) -> Result<DepthImage, FrameError> {
        let Optics { color_lens: _, depth_lens, depth_sensor, confidence } = &self.optics;
        let camera = depth_sensor.map_or(self.depth_intrinsics, |sensor| sensor.intrinsics);
        let mut depth = depth_file::read(self, (camera.width, camera.height))?;
        self.expect_size(&self.depth, (depth.width, depth.height), &camera)?;
        if let Some(Confidence { file, at_least }) = confidence {
            self.remove_low_confidence(&mut depth, file, *at_least)?;
        }
        if let Some(lens) = depth_lens {
            depth = lens.rectify_depth(&depth, &camera);
        }
        Ok(match depth_sensor {
            Some(sensor) => sensor.register(&depth, &self.depth_intrinsics),
            None => depth,
        })
    }

    fn remove_low_confidence(
        &self,
        depth: &mut DepthImage,
        file: &Utf8Path,
        at_least: u8,
    ) -> Result<(), FrameError> {
        let unreadable = |source| FrameError::Unreadable {
            frame: self.index,
            file: relative_name(file),
            source,
        };
        let sure = if depth_file::is_compressed_floats(file).map_err(unreadable)? {
            // Pixels of the depth picture's own size.
            let bytes =
                depth_file::read_compressed(file, u64::from(depth.width) * u64::from(depth.height))
                    .map_err(unreadable)?;
            GrayImage::from_raw(depth.width, depth.height, bytes).unwrap_or_default()
        } else {
            self.read_picture(file)?.into_luma8()
        };
        let (width, height) = sure.dimensions();
        if width == 0 || height == 0 {
            return Ok(());
        }
        for (i, z) in depth.depth_m.iter_mut().enumerate() {
            let (u, v) = (i as u32 % depth.width, i as u32 / depth.width);
            let scaled = |at: u32, from: u32, to: u32| {
                (u64::from(at) * u64::from(to) / u64::from(from)) as u32
            };
            if sure.get_pixel(scaled(u, depth.width, width), scaled(v, depth.height, height)).0[0]
                < at_least
            {
                *z = 0.0;
            }
        }
        Ok(())
    }

    pub(super) fn read_picture(&self, file: &Utf8Path) -> Result<DynamicImage, FrameError> {
        let unreadable = |source| FrameError::Unreadable {
            frame: self.index,
            file: relative_name(file),
            source,
        };
        let mut reader = ImageReader::open(file)
            .map_err(unreadable)?
            .with_guessed_format()
            .map_err(unreadable)?;
        let mut limits = Limits::default();
        limits.max_alloc = Some(MAX_PICTURE_BYTES);
        reader.limits(limits);
        reader.decode().map_err(|source| FrameError::Undecodable {
            frame: self.index,
            file: relative_name(file),
            source,
        })
    }

    fn expect_size(
        &self,
        file: &Utf8Path,
        (found_width, found_height): (u32, u32),
        expected: &Intrinsics,
    ) -> Result<(), FrameError> {
        let &Intrinsics { width, height, .. } = expected;
        if (found_width, found_height) == (width, height) {
            return Ok(());
        }
        Err(FrameError::WrongSize {
            frame: self.index,
            file: relative_name(file),
            found_width,
            found_height,
            width,
            height,
        })
    }
}

/// Maximum memory for decoding a picture: 40 megapixels plus a margin.
const MAX_PICTURE_BYTES: u64 = 256 << 20;

/// Returns the last two path components: the name that the uploader knows, without the server's
/// folders.
pub(super) fn relative_name(file: &Utf8Path) -> Utf8PathBuf {
    let mut tail: Vec<_> = file.components().rev().take(2).collect();
    tail.reverse();
    tail.into_iter().collect()
}

impl Frame {
    /// Returns the position in the color picture of the ray through a depth pixel (column, row), in
    /// pixels. It can lie outside of the picture.
    #[must_use]
    pub fn color_position(&self, u: f32, v: f32) -> (f32, f32) {
        let (depth, color) = (&self.depth_camera.intrinsics, &self.color_camera.intrinsics);
        if depth == color {
            return (u, v);
        }
        (
            (u - depth.cx) / depth.fx * color.fx + color.cx,
            (v - depth.cy) / depth.fy * color.fy + color.cy,
        )
    }

    /// Returns the color of each depth pixel, row-major: the color image resampled (nearest) onto
    /// the depth grid.
    #[must_use]
    pub fn color_on_depth_grid(&self) -> Vec<[u8; 3]> {
        let (depth, color) = (&self.depth_camera.intrinsics, &self.color_camera.intrinsics);
        if depth == color {
            return self.color.pixels().map(|p| p.0).collect();
        }
        let clamp = |at: f32, len: u32| (at + 0.5).clamp(0.0, len as f32 - 1.0) as u32;
        let columns: Vec<u32> = (0..depth.width)
            .map(|u| clamp(self.color_position(u as f32, 0.0).0, color.width))
            .collect();
        (0..depth.height)
            .flat_map(|v| {
                let row = clamp(self.color_position(0.0, v as f32).1, color.height);
                columns.iter().map(move |&column| self.color.get_pixel(column, row).0)
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Frames are stored as JSON with every parse. A renamed field would make stored parses
    /// unreadable.
    #[test]
    fn stored_frames_keep_their_field_names() {
        let intrinsics = r#"{"width":4,"height":3,"fx":2.0,"fy":2.0,"cx":1.5,"cy":1.0}"#;
        let pose = r#"{"rotation":[0.0,0.0,0.0,1.0],"translation":[1.0,2.0,3.0]}"#;
        let stored = format!(
            r#"{{"index":7,"time_s":1305031102.25,"colour":"color/7.jpg","depth":"depth/7.png","colour_intrinsics":{intrinsics},"depth_intrinsics":{intrinsics},"depth_scale_m":0.001,"camera_to_world":{pose},"optics":{{"colour_lens":null,"depth_lens":null,"depth_sensor":null,"confidence":null}}}}"#
        );
        let frame: FrameRef = serde_json::from_str(&stored).unwrap();
        assert_eq!((frame.index, frame.color.as_str()), (FrameIndex(7), "color/7.jpg"));
        assert_eq!(serde_json::to_string(&frame).unwrap(), stored);
        // Frames of earlier versions have no times.
        let earlier = stored.replace("\"time_s\":1305031102.25,", "");
        assert_eq!(serde_json::from_str::<FrameRef>(&earlier).unwrap().time_s, None);
    }
}
