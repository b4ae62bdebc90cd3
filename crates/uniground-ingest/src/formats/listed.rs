//! Deserializes lists of frames in JSON files.

use crate::MAX_FRAMES;
use serde::de::{Deserialize, Deserializer, Error, SeqAccess, Visitor};
use std::fmt;
use std::marker::PhantomData;

/// Deserializes a list with one entry per frame. Stops with an error at the maximum number of
/// frames, before the rest takes memory.
pub(super) fn deserialize_frames<'de, D: Deserializer<'de>, T: Deserialize<'de>>(
    deserializer: D,
) -> Result<Vec<T>, D::Error> {
    deserializer.deserialize_seq(BoundedFrameList(PhantomData))
}

struct BoundedFrameList<T>(PhantomData<T>);

impl<'de, T: Deserialize<'de>> Visitor<'de> for BoundedFrameList<T> {
    type Value = Vec<T>;

    fn expecting(&self, formatter: &mut fmt::Formatter) -> fmt::Result {
        formatter.write_str("a list of frames")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut entries: A) -> Result<Vec<T>, A::Error> {
        let mut frames = Vec::new();
        while let Some(frame) = entries.next_element()? {
            if frames.len() == MAX_FRAMES {
                return Err(A::Error::custom(format!(
                    "more than {MAX_FRAMES} frames, which is the limit: leave some out"
                )));
            }
            frames.push(frame);
        }
        Ok(frames)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(serde::Deserialize)]
    struct Listing {
        #[serde(deserialize_with = "deserialize_frames")]
        frames: Vec<u32>,
    }

    fn listing(frames: usize, rest: &str) -> Result<Listing, serde_json::Error> {
        serde_json::from_str(&format!("{{\"frames\":[{}{rest}]}}", vec!["1"; frames].join(",")))
    }

    #[test]
    fn lists_up_to_the_maximum_are_read() {
        assert_eq!(listing(MAX_FRAMES, "").unwrap().frames.len(), MAX_FRAMES);
    }

    #[test]
    fn a_longer_list_is_refused_before_the_rest_is_parsed() {
        let error = listing(MAX_FRAMES, ",2,this is no JSON").err().unwrap().to_string();
        assert!(error.starts_with("more than 54000 frames"), "{error}");
    }

    #[test]
    fn a_value_that_is_not_a_list_is_refused() {
        let error = serde_json::from_str::<Listing>(r#"{"frames": 3}"#).err().unwrap().to_string();
        assert!(error.contains("expected a list of frames"), "{error}");
    }
}
