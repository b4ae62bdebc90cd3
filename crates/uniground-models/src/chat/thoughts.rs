//! Separates a reasoning model's answer from its thoughts. Some servers leave the thoughts in the
//! reply, between markers that differ from model to model.

/// Markers after which the answer begins, in lower case.
const ANSWER_MARKERS: [&str; 4] =
    ["<|channel|>final<|message|>", "<channel|>", "<|start_response|>", "<|content|>"];
/// What some templates leave of the markers of the final channel.
const BARE_CHANNELS: (&str, &str) = ("analysis", "assistantfinal");
/// Words in the markers around thoughts.
const THINKING: [&str; 5] = ["think", "thought", "reason", "reflect", "scratchpad"];
/// Brackets around markers.
const OPENING: [char; 5] = ['<', '[', '\u{25c1}', '\u{27e8}', '\u{3010}'];
const CLOSING: [char; 5] = ['>', ']', '\u{25b7}', '\u{27e9}', '\u{3011}'];
/// Longest marker, characters between its brackets.
const MARKER_CHARS: usize = 24;

/// Returns the text after a model's thoughts, or `None` if the reply broke off within them. A reply
/// without thoughts is returned unchanged.
#[must_use]
pub fn after_thoughts(text: &str) -> Option<&str> {
    let lower = text.to_ascii_lowercase();
    let after = |marker: &str| lower.rfind(marker).map(|at| at + marker.len());
    let (begins, ends) = BARE_CHANNELS;
    let bare = after(ends).filter(|_| lower.trim_start().starts_with(begins));
    let closed = markers(&lower).filter(|marker| marker.closes).map(|marker| marker.end).last();
    let start =
        ANSWER_MARKERS.into_iter().filter_map(after).chain(bare).chain(closed).max().unwrap_or(0);
    let (answer, lower) = (&text[start..], &lower[start..]);
    let is_thought = |at: usize| {
        ["<|channel|>analysis", "<|channel>thought"]
            .iter()
            .any(|mark| lower[at..].starts_with(mark))
    };
    let begun = markers(lower).find(|marker| !marker.closes).map(|marker| marker.start);
    let channel = lower.match_indices("<|channel").map(|(at, _)| at).find(|at| is_thought(*at));
    match begun.into_iter().chain(channel).min() {
        None => Some(without_end_tokens(answer)),
        Some(at) if answer[..at].trim().is_empty() => None,
        Some(at) => Some(&answer[..at]),
    }
}

/// Removes the tokens that end a reply, such as `<|end|>`.
fn without_end_tokens(text: &str) -> &str {
    let mut text = text;
    while text.trim_end().ends_with("|>")
        && let Some(at) = text.rfind("<|")
    {
        text = &text[..at];
    }
    text
}

/// A marker around thoughts, with the positions of its first byte and after its last.
struct Marker {
    start: usize,
    end: usize,
    closes: bool,
}

/// Finds the markers around thoughts in a text in lower case.
fn markers(lower: &str) -> impl Iterator<Item = Marker> + '_ {
    lower.char_indices().filter(|(_, c)| OPENING.contains(c)).filter_map(|(start, open)| {
        let inside = &lower[start + open.len_utf8()..];
        let (length, close) =
            inside.char_indices().take(MARKER_CHARS).find(|(_, c)| CLOSING.contains(c))?;
        let name = &inside[..length];
        let word = name.trim_start_matches(|c: char| !c.is_alphanumeric());
        let marks = !name.contains(char::is_whitespace)
            && THINKING.iter().any(|thinking| name.contains(thinking));
        marks.then(|| Marker {
            start,
            end: start + open.len_utf8() + length + close.len_utf8(),
            closes: name.contains('/') || word.starts_with("end"),
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const THOUGHT: &str = "Let me look.\nPredicted ID: 2 could be it.\nHmm, no.\n";
    const ANSWER: &str = "Predicted ID: 1\nExplanation: it fits";

    #[test]
    fn answers_follow_thoughts_between_any_markers() {
        for (open, close) in [
            ("<think>", "</think>"),
            ("", "</think>"),
            ("\u{25c1}think\u{25b7}", "\u{25c1}/think\u{25b7}"),
            ("[THINK]", "[/THINK]"),
            ("<seed:think>", "</seed:think>\n\n"),
            ("<reasoning>", "</reasoning>\n"),
            ("<|START_THINKING|>", "<|END_THINKING|><|START_RESPONSE|>"),
            (
                "<|channel|>analysis<|message|>",
                "<|end|><|start|>assistant<|channel|>final<|message|>",
            ),
            ("<|channel>thought\n", "<channel|>"),
            ("analysis", "assistantfinal"),
        ] {
            let reply = format!("{open}{THOUGHT}{close}{ANSWER}");
            assert_eq!(after_thoughts(&reply).map(str::trim), Some(ANSWER), "{reply}");
            if !open.is_empty() && open != "analysis" {
                assert_eq!(after_thoughts(&format!("{open}{THOUGHT}")), None, "{open}");
            }
        }
        assert_eq!(after_thoughts(&format!("{ANSWER}<think>{THOUGHT}")), Some(ANSWER));
        assert_eq!(after_thoughts(&format!("{ANSWER}<|END_RESPONSE|>\n")), Some(ANSWER));
    }

    #[test]
    fn replies_without_thoughts_are_unchanged() {
        for text in [
            ANSWER,
            "",
            "[1] the mug <left of> the [thinking cap in the corner of] room",
            "\u{25c1}",
        ] {
            assert_eq!(after_thoughts(text), Some(text));
        }
    }

    proptest! {
        #[test]
        fn any_text_is_accepted(text in "[<>\\[\\]/|a-z \u{25c1}\u{25b7}]{0,60}(think|</think>|end)?") {
            let _ = after_thoughts(&text);
        }
    }
}
