//! The first of two calls of the photographs mode: the model finds the object in photographs whose
//! things are numbered (docs/METHOD.md, section 4, "Photographs first").

use super::marked_photographs::MarkedPhotographs;
use super::picture_limits::{SentPictures, ask_within};
use super::prompt::{SYSTEM, quoted};
use super::prompt_context::PromptContext;
use super::reply::{self, SeenAt};
use super::{Options, PointForm};
use crate::Seen;
use serde_json::json;
use uniground_geometry::scene::InstanceId;
use uniground_models::chat::{AskError, ChatRequest, Part, Session};

/// Maximum number of marked things that a reply may name.
const MOST_IDS: usize = 5;
/// Name of an anchor that the reply gives without one.
const ANCHOR: &str = "anchor";

/// Where the model sees the object.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Finding {
    /// Marked things that may be the object, the likeliest first.
    pub ids: Vec<InstanceId>,
    /// Marked things that the question relates it to, with what they are.
    pub anchors: Vec<(InstanceId, String)>,
    /// A place in a photograph where the object is visible without a number of its own.
    pub seen: Option<Seen>,
}

/// Asks which marked things the question may mean.
///
/// # Errors
/// [`AskError`]: the call failed.
pub async fn find(
    context: &PromptContext,
    marked: &MarkedPhotographs,
    options: Options,
    session: &mut Session<'_>,
) -> Result<Finding, AskError> {
    let request = request(context, marked, options);
    let (text, sent) = ask_within(options.limits, session, "find", request).await?;
    Ok(read(&text, marked, &sent, options.points))
}

pub(super) fn request(
    context: &PromptContext,
    marked: &MarkedPhotographs,
    options: Options,
) -> ChatRequest {
    let count = marked.photographs.len();
    let pictures = marked.photographs.iter().map(|photograph| photograph.picture.clone());
    let mut user: Vec<Part> = pictures.map(Part::Picture).collect();
    let images = match count {
        1 => "Image 1 is a photograph of a room".to_owned(),
        _ => format!("Images 1 to {count} are photographs of one room"),
    };
    let format = if options.json {
        "Answer with one JSON object with the fields \"Could be\" (list of numbers), \"Anchors\" \
             (list of \"number -> what it is\"), \"Seen at\" (\"image number, \
         left, top, right, bottom, short name\", or null)."
            .to_owned()
    } else {
        "Answer with exactly these three lines:\n\
         Could be: <number, number, ... or none>\n\
         Anchors: <number -> what it is, ... or none>\n\
         Seen at: <image number, left, top, right, bottom, short name; or none>"
            .to_owned()
    };
    let text = format!(
        "{images}. Things in it are numbered: a tag lies on its thing, or beside it with a line to a dot on it. A thing has the same number in \
         every photograph. Some things have no number.\n\n\
         Find what the query asks for.\n\
         1. \"Could be\": the numbers of the things that it may mean, the likeliest first, at most {MOST_IDS}. Give every thing of the kind \
         that it asks for, even if another fits its words about place better: places are checked later. Of a thing with several numbers give \
         the two that lie on most of it. If some have the colour that the query says, leave out those of plainly another \
         colour; if none has it, give all of the kind. Leave out things that it only stands on or next to.\n\
         2. \"Anchors\": the numbers of the things that the query mentions to say where it is. Not {}floors and ceilings.\n\
         3. \"Seen at\": only if what it asks for is visible and has no number of its own, or shares one with another thing: the number of the \
         image and the box around it; {}.\n\n\
         {format}\n\n\
         Query: {}",
        if context.mentions_wall { "" } else { "walls, " },
        options.points.describe(options.limits.describe_whole(count, "that image")),
        quoted(&context.query)
    );
    user.push(Part::Text(text));
    let schema = options.json.then(|| ("finding", schema()));
    ChatRequest { system: SYSTEM.into(), user, schema }
}

fn schema() -> serde_json::Value {
    let list = |of: &str| json!({"type": "array", "items": {"type": of}});
    let properties = json!({
        "Could be": list("integer"), "Anchors": list("string"), "Seen at": {"type": ["string", "null"]},
    });
    let required = ["Could be", "Anchors", "Seen at"];
    json!({"type": "object", "additionalProperties": false, "required": required, "properties": properties})
}

/// Reads a reply in lines or JSON. Numbers of things that are not marked are ignored.
fn read(text: &str, marked: &MarkedPhotographs, sent: &SentPictures, points: PointForm) -> Finding {
    let told = reply::labeled(text, &["could be", "anchors", "seen at"]);
    let value = |at: usize| told[at].as_deref().unwrap_or_default();
    let ids = |value: &str| {
        let mut ids = reply::numbers(value, |id| marked.marked.contains(&InstanceId(id)));
        ids.truncate(MOST_IDS);
        ids.into_iter().map(InstanceId).collect::<Vec<_>>()
    };
    let mut names = reply::names_in(value(1));
    let name = |id: InstanceId| (id, names.remove(&id.0).unwrap_or_else(|| ANCHOR.into()));
    let seen = |seen: SeenAt| sent.sighting(&seen, points)?.original;
    Finding {
        ids: ids(value(0)),
        anchors: ids(value(1)).into_iter().map(name).collect(),
        seen: reply::read_seen_at(value(2)).and_then(seen),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::vlm::Photograph;
    use uniground_geometry::scene::FrameIndex;
    use uniground_models::chat::Picture;
    use uniground_types::answer::LeftOut;

    fn marked() -> MarkedPhotographs {
        let photograph = |number: u32| Photograph {
            frame: FrameIndex(number),
            taken_px: (640, 480),
            picture: Picture {
                name: format!("marked-{number}"),
                jpeg: Vec::new().into(),
                width: 640,
                height: 480,
            },
        };
        MarkedPhotographs {
            photographs: (1..=3).map(photograph).collect(),
            marked: [3, 7, 12, 20, 21, 22, 23].map(InstanceId).into(),
            left_out: LeftOut::default(),
        }
    }

    fn read_reply(text: &str) -> Finding {
        let marked = marked();
        let sent = marked.photographs.iter().map(|photograph| photograph.picture.clone());
        read(text, &marked, &SentPictures::of(sent.collect()), PointForm::Thousandths)
    }

    /// A picture and a place in it.
    type Place = (String, [f32; 2]);

    fn found(text: &str) -> (Vec<u32>, Vec<u32>, Option<Place>) {
        let Finding { ids, anchors, seen } = read_reply(text);
        let ids = ids.into_iter().map(|id| id.0).collect();
        let anchors = anchors.into_iter().map(|(id, _)| id.0).collect();
        (ids, anchors, seen.map(|seen| (seen.picture, seen.at)))
    }

    #[test]
    fn reply_in_lines_is_read() {
        let text = "Could be: 12, 7\nAnchors: 3 (the door)\nSeen at: none";
        assert_eq!(found(text), (vec![12, 7], vec![3], None));
        let text = "<think>Could be: 3</think>\n**Could be:** none\n**Anchors:** none\n**Seen at:** Image 2, 500, 250, red mug";
        assert_eq!(found(text), (vec![], vec![], Some(("marked-2".into(), [0.5, 0.25]))));
        // Numbers of no marked thing, repetitions, and more than five are ignored.
        let text = "Could be: 99, 12, 12, 20, 21, 22, 23, 7\nAnchors: 99";
        assert_eq!(found(text), (vec![12, 20, 21, 22, 23], vec![], None));
    }

    #[test]
    fn anchors_keep_their_names() {
        let anchors = |text: &str| read_reply(text).anchors;
        let named = |id, name: &str| [(InstanceId(id), name.to_owned())];
        let door = named(3, "white door");
        assert_eq!(anchors("Anchors: 3 -> white door, 99 -> ghost"), door);
        assert_eq!(anchors(r#"{"Anchors": ["3 -> white door"], "Could be": []}"#), door);
        assert_eq!(anchors("Anchors: 7"), named(7, ANCHOR));
    }

    #[test]
    fn reply_in_json_is_read() {
        let text = r#"```json
{"Could be": [12, "7"], "Anchors": [], "Seen at": "3, 100, 900, clock"}
```"#;
        assert_eq!(found(text), (vec![12, 7], vec![], Some(("marked-3".into(), [0.1, 0.9]))));
        let text = r#"{"could_be": [], "anchors": [3], "seen_at": null}"#;
        assert_eq!(found(text), (vec![], vec![3], None));
    }

    #[test]
    fn reply_without_fields_finds_nothing() {
        for text in ["", "I cannot see the images.", "Seen at: image 9, 1, 2, mug", "{\"a\": 1}"] {
            assert_eq!(found(text), (vec![], vec![], None), "{text}");
        }
    }
}
