//! Preprocessing of pictures, from `preprocessor_config.json`.

use super::super::ModelError;
use super::super::bundle::{Interpolation, Resize};
use super::side_files::SideFiles;
use serde_json::Value;

/// How a picture becomes the input of a network.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Preprocessing {
    /// Width and height, pixels.
    pub size: [u32; 2],
    pub resize: Resize,
    pub interpolation: Interpolation,
    /// Subtracted from values in `0..=1`.
    pub mean: [f32; 3],
    /// Divisor after subtracting `mean`.
    pub std: [f32; 3],
}

/// Largest deviation of a factor from 1/255 that is its rounding.
const RESCALE_TOLERANCE: f64 = 1e-4;

impl Preprocessing {
    /// # Errors
    /// Returns [`ModelError::Bundle`], which names the field that is missing or not supported.
    pub fn read(side: &SideFiles) -> Result<Self, ModelError> {
        let fields = &side.pictures;
        let wrong = |why: String| ModelError::Bundle { file: side.pictures_file.clone(), why };
        if fields.is_null() {
            return Err(wrong(
                "the file is missing; it states the size and the normalization of pictures".into(),
            ));
        }
        let (size, resize) = size_of(fields).map_err(wrong)?;
        let interpolation = match fields["resample"].as_u64() {
            Some(2) | None => Interpolation::Bilinear,
            Some(3) => Interpolation::Bicubic,
            Some(other) => {
                return Err(wrong(format!(
                    "resample is {other}, expected 2 (bilinear) or 3 (bicubic)"
                )));
            }
        };
        let is_on = |field: &str| fields[field].as_bool().unwrap_or(true);
        // Without rescaling, mean and std are those of values in 0..=255.
        let unit = if is_on("do_rescale") { 1.0 } else { 255.0 };
        let rescaled_by = fields["rescale_factor"].as_f64().unwrap_or(1.0 / 255.0) * 255.0;
        if unit == 1.0 && (rescaled_by - 1.0).abs() > RESCALE_TOLERANCE {
            return Err(wrong(format!(
                "rescale_factor is {}, expected 1/255",
                fields["rescale_factor"]
            )));
        }
        let three = |field: &str, neutral: f32| {
            if !is_on("do_normalize") {
                return Ok([neutral; 3]);
            }
            let values: Option<Vec<f32>> = fields[field]
                .as_array()
                .map(|array| array.iter().filter_map(|v| Some(v.as_f64()? as f32)).collect());
            values.and_then(|values| <[f32; 3]>::try_from(values).ok()).ok_or_else(|| {
                wrong(format!("{field} is {}, expected three numbers", fields[field]))
            })
        };
        Ok(Self {
            size,
            resize,
            interpolation,
            mean: three("image_mean", 0.0)?.map(|v| v / unit),
            std: three("image_std", 1.0)?.map(|v| v / unit),
        })
    }
}

/// Returns width and height in one of the forms that processors write: a number, `{height, width}`,
/// or one edge.
fn pair(value: &Value) -> Option<[u32; 2]> {
    let number = |value: &Value| value.as_u64().and_then(|n| u32::try_from(n).ok());
    let both = number(value)
        .or_else(|| number(&value["shortest_edge"]))
        .or_else(|| number(&value["longest_edge"]));
    match both {
        Some(edge) => Some([edge, edge]),
        None => Some([number(&value["width"])?, number(&value["height"])?]),
    }
}

fn size_of(fields: &Value) -> Result<([u32; 2], Resize), String> {
    let size = &fields["size"];
    let unreadable = |field: &str| format!("{field} is {}, expected a size", fields[field]);
    if fields["do_center_crop"].as_bool() == Some(true) {
        let crop = pair(&fields["crop_size"]).ok_or_else(|| unreadable("crop_size"))?;
        // A picture that is resized to a larger edge than it is cropped to loses its border.
        return match pair(size) {
            Some(resized) if resized != crop => {
                Err(format!("size {size} differs from crop_size {}", fields["crop_size"]))
            }
            _ => Ok((crop, Resize::ShortestCenterCrop)),
        };
    }
    if size["longest_edge"].is_u64() {
        let padded = pair(&fields["pad_size"]).or_else(|| pair(size));
        return Ok((padded.ok_or_else(|| unreadable("size"))?, Resize::LongestPad));
    }
    if size["shortest_edge"].is_u64() {
        return Err("size has only shortest_edge, and pictures are not cropped to a square".into());
    }
    Ok((pair(size).ok_or_else(|| unreadable("size"))?, Resize::Squash))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn read(pictures: Value) -> Result<Preprocessing, String> {
        let side = SideFiles {
            folder: "here".into(),
            config: Value::Null,
            pictures,
            pictures_file: "preprocessor_config.json".into(),
            tokenizer: Value::Null,
            special_tokens: Value::Null,
        };
        Preprocessing::read(&side).map_err(|e| e.to_string())
    }

    #[test]
    fn sizes_are_read_in_every_form() {
        let with = |mut fields: Value| {
            fields["image_mean"] = json!([0.5, 0.5, 0.5]);
            fields["image_std"] = json!([0.5, 0.5, 0.5]);
            read(fields).map(|p| (p.size, p.resize))
        };
        let cropped = json!({"do_center_crop": true, "size": {"shortest_edge": 224}, "crop_size": {"height": 224, "width": 224}, "resample": 3});
        assert_eq!(with(cropped), Ok(([224, 224], Resize::ShortestCenterCrop)));
        let older = json!({"do_center_crop": true, "size": 224, "crop_size": 224});
        assert_eq!(with(older), Ok(([224, 224], Resize::ShortestCenterCrop)));
        let squashed = json!({"size": {"height": 384, "width": 256}});
        assert_eq!(with(squashed), Ok(([256, 384], Resize::Squash)));
        let padded =
            json!({"size": {"longest_edge": 1024}, "pad_size": {"height": 1024, "width": 1024}});
        assert_eq!(with(padded), Ok(([1024, 1024], Resize::LongestPad)));
        let border = json!({"do_center_crop": true, "size": {"shortest_edge": 256}, "crop_size": {"height": 224, "width": 224}});
        assert!(with(border).unwrap_err().contains("differs from crop_size"));
        assert!(with(json!({"size": {"shortest_edge": 224}})).is_err());
        assert!(with(json!({})).unwrap_err().contains("size is null"));
    }

    #[test]
    fn normalization_follows_its_switches() {
        let size = json!({"height": 64, "width": 64});
        let raw = read(json!({"size": size, "do_normalize": false})).unwrap();
        assert_eq!((raw.mean, raw.std), ([0.0; 3], [1.0; 3]));
        let bytes = read(json!({"size": size, "do_rescale": false, "image_mean": [51.0, 51.0, 51.0], "image_std": [255.0, 255.0, 255.0]})).unwrap();
        assert_eq!((bytes.mean, bytes.std), ([0.2; 3], [1.0; 3]));
        let missing = read(json!({"size": size})).unwrap_err();
        assert!(missing.contains("image_mean is null"), "{missing}");
        let factor = json!({"size": size, "rescale_factor": 0.007_843, "image_mean": [0, 0, 0], "image_std": [1, 1, 1]});
        assert!(read(factor).unwrap_err().contains("rescale_factor"));
        assert!(read(Value::Null).unwrap_err().contains("missing"));
    }
}
