//! Questions of a batch. An item stores only its own fields. Fields that all items share are stored
//! with the batch.

use crate::error::Error;
use serde::{Deserialize, Deserializer};
use serde_json::value::RawValue;
use serde_json::{Map, Value};
use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};
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

/// Checks references between the items of a batch while they arrive. Keeps four bytes per item.
#[derive(Default)]
pub struct ItemReferences {
    scenes: HashMap<String, u32>,
    /// The scene of each item, as a number.
    scene_of_item: Vec<u32>,
}

impl ItemReferences {
    /// Adds the next item with its own fields.
    ///
    /// # Errors
    /// A reference to an item that is not an earlier one about the same scene; a session.
    pub fn add_item(&mut self, scene_id: &str, fields: &Map<String, Value>) -> Result<(), Error> {
        let item = self.scene_of_item.len();
        let next = self.scenes.len() as u32;
        let scene = match self.scenes.get(scene_id) {
            Some(scene) => *scene,
            None => *self.scenes.entry(scene_id.to_owned()).or_insert(next),
        };
        self.scene_of_item.push(scene);
        let Some(context) = fields.get("context") else { return Ok(()) };
        check_no_session(context, &format!("/items/{item}"))?;
        let Some(reference) = context.get("item").filter(|reference| !reference.is_null()) else {
            return Ok(());
        };
        let earlier = reference
            .as_u64()
            .and_then(|index| usize::try_from(index).ok())
            .filter(|index| *index < item);
        let why = match earlier {
            Some(earlier) if self.scene_of_item[earlier] == scene => return Ok(()),
            Some(earlier) => format!("item {earlier} is about another scene"),
            None => format!("must be the index of an earlier item, and this is item {item}"),
        };
        Err(Error::invalid(format!("/items/{item}/context/item"), why))
    }
}

/// Checks the context that all items of a batch share.
///
/// # Errors
/// A reference to an item, or a session.
pub fn check_shared_context(defaults: &Map<String, Value>) -> Result<(), Error> {
    let Some(context) = defaults.get("context") else { return Ok(()) };
    check_no_session(context, "/defaults")?;
    if context.get("item").is_some_and(|reference| !reference.is_null()) {
        let why = "only an item can refer to an earlier item";
        return Err(Error::invalid("/defaults/context/item", why.to_owned()));
    }
    Ok(())
}

fn check_no_session(context: &Value, pointer: &str) -> Result<(), Error> {
    if context.get("session").is_some_and(|session| !session.is_null()) {
        let why = "items run in parallel, so a batch has no sessions: refer to an earlier item with context.item";
        return Err(Error::invalid(format!("{pointer}/context/session"), why.to_owned()));
    }
    Ok(())
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

    #[test]
    fn references_must_point_to_earlier_items_of_the_same_scene() {
        let mut references = ItemReferences::default();
        let mut add = |scene: &str, own: Value| {
            references.add_item(scene, &fields(own)).map_err(|error| match error {
                Error::Invalid { pointer, .. } => pointer,
                other => panic!("{other}"),
            })
        };
        assert_eq!(add("a", json!({"query": "the sofa"})), Ok(()));
        assert_eq!(add("b", json!({"context": {"instance": 3}})), Ok(()));
        assert_eq!(add("a", json!({"context": {"item": 0}})), Ok(()));
        for (own, field) in [
            (json!({"context": {"item": 1}}), "item"),
            (json!({"context": {"item": 4}}), "item"),
            (json!({"context": {"item": -1}}), "item"),
            (json!({"context": {"item": "0"}}), "item"),
            (json!({"context": {"session": "s"}}), "session"),
        ] {
            let pointer = add("a", own).unwrap_err();
            assert!(pointer.ends_with(&format!("/context/{field}")), "{pointer}");
        }
        // What is no context at all fails as an item.
        assert_eq!(add("a", json!({"context": 3})), Ok(()));
        assert_eq!(add("a", json!({"context": {"item": null, "session": null}})), Ok(()));
        for shared in [json!({"context": {"item": 0}}), json!({"context": {"session": "s"}})] {
            assert!(check_shared_context(&fields(shared)).is_err());
        }
        assert!(check_shared_context(&fields(json!({"context": {"instance": 3}}))).is_ok());
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
