//! Checks a vision-language model with three pictures of known content: whether it sees them, reads
//! the numbers on them, tells left from right, and points at the right place.

use image::{Rgb, RgbImage};
use serde_json::{Value, json};
use std::fmt;
use uniground_grounding::vlm::{ImagePart, PictureLimits, PointForm};
use uniground_models::chat::{
    ChatFailure, ChatModel, ChatReply, ChatRequest, Part, Picture, after_thoughts,
};
use uniground_render::{Mark, draw_marks, encode_jpeg};

/// What a check found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    /// What was checked, for people.
    pub what: &'static str,
    pub is_right: bool,
    /// What was found, and what to do if it is wrong.
    pub detail: String,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let word = if self.is_right { "yes" } else { "NO" };
        write!(f, "{}: {word}. {}", self.what, self.detail)
    }
}

/// The number on the tag of the first picture.
const NUMBER: u32 = 47;
/// The shapes of the second picture.
const LEFT: &str = "red";
const RIGHT: &str = "blue";
/// Where the green disc of the third picture is: shares of its width and height.
const DISC: [f64; 2] = [0.72, 0.30];
const WIDE: [u32; 2] = [900, 450];
/// Largest distance of a point from the middle of the disc, as a share of the picture.
const POINT_TOLERANCE: f64 = 0.06;

/// What follows from points in a form that cannot be set.
const WRONG_PLACE: &str =
    "What it sees outside of the list of candidates will be looked for in the wrong place.";

const BACKGROUND: Rgb<u8> = Rgb([225, 222, 215]);
const SYSTEM: &str = "You are a helpful assistant that describes images exactly.";
const LABELS: [&str; 4] = ["Number", "Left", "Right", "Green"];

/// Shows the model the pictures, in one call.
///
/// # Errors
/// Returns the failure of the call.
pub async fn check_pictures(
    model: &dyn ChatModel,
    json: bool,
    points: PointForm,
    limits: PictureLimits,
) -> Result<(Vec<Finding>, ChatReply), ChatFailure> {
    let (request, disc) = request(json, points, limits);
    let reply = model.ask(&request).await?;
    Ok((judge(&reply.text, points, disc), reply))
}

/// Where the disc is in the picture that was sent.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Disc {
    /// Shares of the picture's width and height.
    at: [f64; 2],
    /// Width and height of the picture, pixels.
    size: [f64; 2],
    /// Largest distance of a point from the middle, as a share of the picture.
    tolerance: f64,
}

/// Returns the request, and where the disc is in its pictures.
fn request(json: bool, points: PointForm, limits: PictureLimits) -> (ChatRequest, Disc) {
    let pictures = [tagged(), two_shapes(), two_discs()];
    let mut user: Vec<Part> = pictures.into_iter().map(Part::Picture).collect();
    let format = match json {
        true => "Answer with one JSON object with the fields \"Number\" (an integer), \"Left\", \"Right\" (words) and \"Green\" (\"x, y\")."
            .to_owned(),
        false => "Answer with exactly these four lines:\n\
                  Number: <number>\nLeft: <colour>\nRight: <colour>\nGreen: <x, y>"
            .to_owned(),
    };
    user.push(Part::Text(format!(
        "Number: which number is on the tag in image 1?\n\
         Left, Right: which colour has the shape at the left of image 2, and the one at its right?\n\
         Green: where is the middle of the green disc in image 3? {}.\n\n{format}",
        points.describe(limits.describe_whole(3, "that image"))
    )));
    let text = json!({"type": "string"});
    let schema = json!({
        "type": "object", "additionalProperties": false, "required": LABELS,
        "properties": {"Number": {"type": "integer"}, "Left": text, "Right": text, "Green": text},
    });
    let schema = json.then_some(("check", schema));
    let (request, sent) = limits.apply(1, ChatRequest { system: SYSTEM.into(), user, schema });
    (request, sent.part(3).map_or(Disc::ALONE, Disc::within))
}

impl Disc {
    /// In a picture of its own.
    const ALONE: Self =
        Self { at: DISC, size: [WIDE[0] as f64, WIDE[1] as f64], tolerance: POINT_TOLERANCE };

    /// In a part of a picture of several.
    fn within(ImagePart { area: (left, top, width, height), picture_px }: ImagePart) -> Self {
        let [left, top, width, height] = [left, top, width, height].map(f64::from);
        let size = [f64::from(picture_px.0), f64::from(picture_px.1)];
        let at = [(left + DISC[0] * width) / size[0], (top + DISC[1] * height) / size[1]];
        let share = (width / size[0]).max(height / size[1]);
        Self { at, size, tolerance: POINT_TOLERANCE * share }
    }
}

fn picture(name: &str, image: &RgbImage) -> Picture {
    let (width, height) = image.dimensions();
    Picture { name: name.into(), jpeg: encode_jpeg(image).into(), width, height }
}

/// A brown box with a tag, as the service marks things on photographs.
fn tagged() -> Picture {
    let mut image = RgbImage::from_fn(640, 480, |x, y| {
        let is_box = (220..420).contains(&x) && (180..360).contains(&y);
        if is_box { Rgb([140, 95, 60]) } else { BACKGROUND }
    });
    draw_marks(&mut image, &[Mark { label: NUMBER.to_string(), at: [0.5, 0.56], margin: 0.14 }]);
    picture("tag", &image)
}

fn two_shapes() -> Picture {
    let image = RgbImage::from_fn(640, 480, |x, y| {
        if (90..230).contains(&x) && (170..310).contains(&y) {
            Rgb([205, 35, 35])
        } else if is_in_disc([x, y], [480.0, 240.0], 75.0) {
            Rgb([35, 60, 200])
        } else {
            BACKGROUND
        }
    });
    picture("left-and-right", &image)
}

fn two_discs() -> Picture {
    let [width, height] = WIDE.map(f64::from);
    let image = RgbImage::from_fn(WIDE[0], WIDE[1], |x, y| {
        if is_in_disc([x, y], [DISC[0] * width, DISC[1] * height], 26.0) {
            Rgb([30, 150, 55])
        } else if is_in_disc([x, y], [0.2 * width, 0.75 * height], 40.0) {
            Rgb([235, 200, 40])
        } else {
            BACKGROUND
        }
    });
    picture("discs", &image)
}

fn is_in_disc(at: [u32; 2], middle: [f64; 2], radius: f64) -> bool {
    let [dx, dy] = [0, 1].map(|axis: usize| f64::from(at[axis]) - middle[axis]);
    dx.hypot(dy) <= radius
}

fn judge(text: &str, points: PointForm, disc: Disc) -> Vec<Finding> {
    let told = LABELS.map(|label| value(text, label));
    let [number, left, right, green] = told.each_ref().map(|told| told.as_deref());
    let said = |told: Option<&str>| told.map_or("nothing".to_owned(), |told| format!("{told:?}"));
    let has = |told: Option<&str>, word: &str| {
        told.is_some_and(|told| told.to_ascii_lowercase().contains(word))
    };
    let reads = number.and_then(|told| numbers(told).first().copied()) == Some(f64::from(NUMBER));
    let is_straight = has(left, LEFT) && has(right, RIGHT);
    let is_swapped = has(left, RIGHT) && has(right, LEFT);
    let place = green
        .map_or_else(|| Err("It gave no point.".into()), |told| judge_point(told, points, disc));
    let keeps_format = told.iter().all(Option::is_some);
    vec![
        Finding {
            what: "sees pictures",
            is_right: reads || is_straight || is_swapped || place.is_ok(),
            detail: match reads || is_straight || is_swapped || place.is_ok() {
                true => "It describes what they show.".into(),
                false => format!(
                    "It describes none of them: is it a model for text, or does its server drop images? It said {}.",
                    shortened(text)
                ),
            },
        },
        Finding {
            what: "keeps to a format",
            is_right: keeps_format,
            detail: if keeps_format {
                "It gave every field.".into()
            } else {
                let missing: Vec<&str> = LABELS
                    .into_iter()
                    .zip(&told)
                    .filter_map(|(label, told)| told.is_none().then_some(label))
                    .collect();
                format!("It left out {}. Try --vlm-json, or a larger model.", missing.join(", "))
            },
        },
        Finding {
            what: "reads numbers",
            is_right: reads,
            detail: format!("The tag says {NUMBER}, it said {}.", said(number)),
        },
        Finding {
            what: "tells left from right",
            is_right: is_straight,
            detail: match is_swapped {
                true => "It swaps them: questions with directions will go wrong.".into(),
                false => format!(
                    "{LEFT} is left and {RIGHT} right; it said {} and {}.",
                    said(left),
                    said(right)
                ),
            },
        },
        match place {
            Ok(detail) => Finding { what: "points at places", is_right: true, detail },
            Err(detail) => Finding { what: "points at places", is_right: false, detail },
        },
    ]
}

/// Returns how far a point is from the disc, or in which other form it was given.
fn judge_point(told: &str, points: PointForm, disc: Disc) -> Result<String, String> {
    let [x, y] = numbers(told)[..] else {
        return Err(format!("It said {told:?}, expected two numbers."));
    };
    let Disc { at, size: [width, height], tolerance } = disc;
    let distance = |x: f64, y: f64| (x - at[0]).hypot(y - at[1]);
    let (asked, expected, size) = match points {
        PointForm::Thousandths => ("thousandths", at.map(|share| share * 1000.0), [1000.0; 2]),
        PointForm::Pixels => ("pixels", [at[0] * width, at[1] * height], [width, height]),
    };
    let off = distance(x / size[0], y / size[1]);
    if off <= tolerance {
        return Ok(format!("It points in {asked}, {:.1} % off.", off * 100.0));
    }
    let forms = [
        ("thousandths", [x / 1000.0, y / 1000.0], "Set --vlm-points thousandths."),
        ("pixels", [x / width, y / height], "Set --vlm-points pixels."),
        ("shares of 1", [x, y], WRONG_PLACE),
        ("percent", [x / 100.0, y / 100.0], WRONG_PLACE),
        ("thousandths with x and y swapped", [y / 1000.0, x / 1000.0], WRONG_PLACE),
    ];
    let form = forms.into_iter().find(|(_, [x, y], _)| distance(*x, *y) <= tolerance);
    Err(match form {
        Some((form, _, help)) => {
            format!("It points in {form} ({told}) where {asked} are asked for. {help}")
        }
        None => format!("The disc is at {:.0}, {:.0}; it said {told}.", expected[0], expected[1]),
    })
}

/// Returns the numbers in a text, at most four.
fn numbers(text: &str) -> Vec<f64> {
    text.split(|c: char| !(c.is_ascii_digit() || c == '.'))
        .filter_map(|part| part.trim_matches('.').parse().ok())
        .take(4)
        .collect()
}

/// Returns a field of a reply in lines or JSON.
fn value(text: &str, label: &str) -> Option<String> {
    let text = after_thoughts(text)?;
    let object = text
        .find('{')
        .zip(text.rfind('}'))
        .and_then(|(start, end)| serde_json::from_str::<Value>(text.get(start..=end)?).ok());
    if let Some(Value::Object(fields)) = object {
        let (_, found) = fields.into_iter().find(|(name, _)| name.eq_ignore_ascii_case(label))?;
        return match found {
            Value::String(text) => Some(text),
            Value::Null => None,
            other => Some(other.to_string()),
        };
    }
    let is_decoration = |c: char| c.is_whitespace() || "*#-_`|>".contains(c);
    text.lines().find_map(|line| {
        let line = line.trim_start_matches(is_decoration);
        let start = line.get(..label.len())?;
        let rest = line[label.len()..].trim_start_matches(is_decoration).strip_prefix(':')?;
        let told = rest.trim_matches(is_decoration);
        (start.eq_ignore_ascii_case(label) && !told.is_empty()).then(|| told.to_owned())
    })
}

fn shortened(text: &str) -> String {
    const MAX_CHARS: usize = 120;
    let line = text.split_whitespace().collect::<Vec<_>>().join(" ");
    let mut short: String = line.chars().take(MAX_CHARS).collect();
    if short.len() < line.len() {
        short.push('…');
    }
    format!("{short:?}")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns which checks are right, in their order.
    fn right(text: &str) -> Vec<bool> {
        judge(text, PointForm::Thousandths, Disc::ALONE)
            .into_iter()
            .map(|finding| finding.is_right)
            .collect()
    }

    #[test]
    fn right_replies_are_recognized_in_any_form() {
        let lines = "<think>Number: 3</think>\nNumber: 47\nLeft: red\nRight: Blue\nGreen: 715, 305";
        let markdown =
            "**Number:** 47\n**Left:** a red square\n**Right:** blue\n**Green:** (722, 296)";
        let json = "```json\n{\"number\": 47, \"Left\": \"red\", \"Right\": \"blue\", \"Green\": [720, 300]}\n```";
        for text in [lines, markdown, json] {
            assert_eq!(right(text), [true; 5], "{text}");
        }
    }

    #[test]
    fn each_weakness_is_told_apart() {
        let text = |number: &str, left: &str, right: &str, green: &str| {
            format!("Number: {number}\nLeft: {left}\nRight: {right}\nGreen: {green}")
        };
        let pixels = text("47", "blue", "red", "648, 135");
        assert!(judge(&pixels, PointForm::Pixels, Disc::ALONE)[4].is_right);
        let found = judge(&pixels, PointForm::Thousandths, Disc::ALONE);
        assert!(!found[3].is_right && found[3].detail.contains("swaps"), "{found:?}");
        assert!(!found[4].is_right && found[4].detail.contains("pixels"), "{found:?}");
        for (green, form) in [
            ("0.72, 0.30", "shares of 1"),
            ("72, 30", "percent"),
            ("300, 720", "swapped"),
            ("100, 100", "The disc is at 720, 300"),
            ("in the middle", "expected two numbers"),
        ] {
            let found =
                judge(&text("74", "red", "blue", green), PointForm::Thousandths, Disc::ALONE);
            assert!(found[4].detail.contains(form), "{green}: {found:?}");
            assert!(found[0].is_right && !found[2].is_right, "{found:?}");
        }
        let blind = judge("I cannot see images.", PointForm::Thousandths, Disc::ALONE);
        assert!(blind.iter().all(|finding| !finding.is_right), "{blind:?}");
        assert!(
            blind[0].detail.contains("drop images") && blind[1].detail.contains("Number, Left")
        );
    }

    /// The pictures show what the check expects.
    #[test]
    fn pictures_are_drawn() {
        let (request, place) = request(true, PointForm::Thousandths, PictureLimits::default());
        assert_eq!(place, Disc::ALONE);
        let pictures = request.user.iter().filter(|part| matches!(part, Part::Picture(_))).count();
        assert_eq!((pictures, request.user.len()), (3, 4));
        let disc = WIDE.map(f64::from);
        let middle = [0, 1].map(|axis| (DISC[axis] * disc[axis]) as u32);
        assert!(is_in_disc(middle, [DISC[0] * disc[0], DISC[1] * disc[1]], 2.0));
    }

    /// With one picture for all images, the place is that of the disc in this picture.
    #[test]
    fn combined_pictures_are_judged_by_their_own_places() {
        let limits = PictureLimits { count: Some(1), side_px: None };
        let (request, disc) = request(false, PointForm::Pixels, limits);
        let Some(Part::Picture(picture)) = request.user.first() else { panic!("no picture") };
        let drawn = image::load_from_memory(&picture.jpeg).unwrap().into_rgb8();
        let [x, y] = [0, 1].map(|axis: usize| disc.at[axis] * disc.size[axis]);
        let Rgb([red, green, _]) = *drawn.get_pixel(x as u32, y as u32);
        assert!(green > 120 && red < 60, "{red} {green}");
        let text =
            |x: f64, y: f64| format!("Number: 47\nLeft: red\nRight: blue\nGreen: {x:.0}, {y:.0}");
        assert!(judge(&text(x, y), PointForm::Pixels, disc)[4].is_right);
        assert!(!judge(&text(x - 60.0, y), PointForm::Pixels, disc)[4].is_right);
    }
}
