//! Questions of a batch. An item stores only its own fields. Fields that all items share are stored
//! with the batch.

use crate::error::Error;
use serde::{Deserialize, Deserializer};
use serde_json::value::RawValue;
use serde_json::{Map, Value};
use std::borrow::Cow;
use std::collections::BTreeMap;
use uniground_types::question::GroundRequest;

/// The field of the scene. Every item stores it separately from the other fields.
pub const SCENE_ID: &str = "scene_id";

/// Fields that the items of a batch share.
#[derive(Debug, Default)]
pub struct BatchDefaults(BTreeMap<String, Box<RawValue>>);

impl BatchDefaults {
    /// Reads the stored defaults. A batch without defaults stores whole questions in its items.
    pub fn from_stored(json: Option<&str>) -> Result<Self, Error> {
        Ok(Self(json.map(serde_json::from_str).transpose()?.unwrap_or_default()))
    }

    /// Returns the whole question of an item, with its own fields before the shared ones. The
    /// fields are merged as text, so that numbers keep their digits.
    pub fn merge<'a>(&self, request: &'a str) -> Result<Cow<'a, str>, Error> {
        if self.0.is_empty() {
            return Ok(request.into());
        }
        let own: BTreeMap<String, &RawValue> = serde_json::from_str(request)?;
        let mut all: BTreeMap<&str, &RawValue> =
            self.0.iter().map(|(name, value)| (name.as_str(), value.as_ref())).collect();
        all.extend(own.iter().map(|(name, value)| (name.as_str(), *value)));
        Ok(serde_json::to_string(&all)?.into())
    }

    /// Returns the words of an item's question, or an empty string if it has none.
    pub fn query_of(&self, request: &str) -> String {
        /// The question's words, of any JSON type. Other fields of the item are ignored.
        #[derive(Default, Deserialize)]
        struct ItemQuery<'a> {
            #[serde(borrow, default, deserialize_with = "present")]
            query: Option<&'a RawValue>,
        }
        fn present<'de, D: Deserializer<'de>>(value: D) -> Result<Option<&'de RawValue>, D::Error> {
            <&RawValue>::deserialize(value).map(Some)
        }
        let own: ItemQuery<'_> = serde_json::from_str(request).unwrap_or_default();
        let query = own.query.or_else(|| self.0.get("query").map(Box::as_ref));
        query.and_then(|query| serde_json::from_str(query.get()).ok()).unwrap_or_default()
    }
}

/// Removes the scene from an item's fields. Returns `shared` if the item names none.
pub fn take_scene(fields: &mut Map<String, Value>, shared: &str) -> String {
    let own = fields.remove(SCENE_ID);
    own.map_or_else(|| shared.to_owned(), |id| id.as_str().unwrap_or_default().to_owned())
}

/// Parses the question of an item.
pub fn question_of(request: &str) -> Result<GroundRequest, Error> {
    let mut reader = serde_json::Deserializer::from_str(request);
    let question: GroundRequest =
        serde_path_to_error::deserialize(&mut reader).map_err(|error| {
            let pointer: String = error
                .path()
                .iter()
                .map(|segment| format!("/{segment}"))
                .filter(|s| s != "/?")
                .collect();
            Error::invalid(pointer, error.inner().to_string())
        })?;
    question.check()?;
    Ok(question)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use serde_json::json;

    fn fields(value: Value) -> Map<String, Value> {
        serde_json::from_value(value).unwrap()
    }

    /// Returns the form in which questions were stored before batches had defaults.
    fn stored_question(defaults: &Map<String, Value>, own: Map<String, Value>) -> String {
        let mut all = defaults.clone();
        all.extend(own);
        Value::Object(all).to_string()
    }

    fn stored_defaults(defaults: &Map<String, Value>) -> BatchDefaults {
        BatchDefaults::from_stored(Some(&Value::Object(defaults.clone()).to_string())).unwrap()
    }

    #[test]
    fn item_fields_override_defaults() {
        let defaults = fields(
            json!({"query": "the sofa", "top_k": 3, "min_confidence": 0.1, "\"odd\"\n": [1, {"a": null}]}),
        );
        for own in [
            json!({}),
            json!({"query": "the lamp"}),
            json!({"query": null, "top_k": 1e300, "min_confidence": 0.300_000_000_000_000_04}),
            json!({"query": 3, "another": "\u{e9}\u{1}"}),
        ] {
            let (defaults, own) = (&defaults, fields(own));
            let request = Value::Object(own.clone()).to_string();
            assert_eq!(
                stored_defaults(defaults).merge(&request).unwrap(),
                stored_question(defaults, own.clone())
            );
            let query = serde_json::from_str::<Map<String, Value>>(&stored_question(defaults, own))
                .unwrap()["query"]
                .as_str()
                .map(str::to_owned);
            assert_eq!(stored_defaults(defaults).query_of(&request), query.unwrap_or_default());
        }
        assert!(stored_defaults(&defaults).merge("no JSON").is_err());
    }

    /// Batches of earlier versions store whole questions. They are returned unchanged, without
    /// parsing.
    #[test]
    fn items_without_defaults_are_returned_unchanged() {
        let none = BatchDefaults::from_stored(None).unwrap();
        assert!(matches!(
            none.merge("{ \"query\" : 1.50 }").unwrap(),
            Cow::Borrowed("{ \"query\" : 1.50 }")
        ));
        let texts = [("{\"query\": \"a\"}", "a"), ("{\"query\": 1}", ""), ("{}", ""), ("", "")];
        assert!(texts.iter().all(|(request, query)| none.query_of(request) == *query));
    }

    #[test]
    fn items_without_a_scene_use_the_shared_scene() {
        for (own, scene) in [
            (json!({"query": "a"}), "shared"),
            (json!({"scene_id": "own"}), "own"),
            (json!({"scene_id": 3}), ""),
            (json!({"scene_id": null}), ""),
        ] {
            let mut own = fields(own);
            assert_eq!(take_scene(&mut own, "shared"), scene);
            assert!(!own.contains_key(SCENE_ID));
        }
    }

    proptest! {
        /// However the fields are divided between shared and own ones, the merged question equals
        /// the text of an item that stores all of them.
        #[test]
        fn merging_reproduces_the_complete_question(
            shared in proptest::collection::btree_map("[a-c\"\\\\]{0,2}", "\\PC{0,8}", 0..4),
            own in proptest::collection::btree_map("[a-c\"\\\\]{0,2}", any::<f64>(), 0..4),
        ) {
            let shared: Map<String, Value> = shared.into_iter().map(|(name, text)| (name, text.into())).collect();
            let own: Map<String, Value> = own.into_iter().map(|(name, number)| (name, number.into())).collect();
            let request = Value::Object(own.clone()).to_string();
            prop_assert_eq!(stored_defaults(&shared).merge(&request).unwrap().into_owned(), stored_question(&shared, own));
        }
    }
}
