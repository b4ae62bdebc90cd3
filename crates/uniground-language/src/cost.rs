//! Counts the cost of reading a question in steps: one for every comparison of words with a table.
//! Counted in tests only. They check that a question of maximum length is cheap to read, whatever
//! its words.

#[cfg(not(test))]
pub(super) const fn count() {}

#[cfg(test)]
thread_local! {
    static STEPS: std::cell::Cell<u64> = const { std::cell::Cell::new(0) };
}

#[cfg(test)]
pub(super) fn count() {
    STEPS.with(|steps| steps.set(steps.get() + 1));
}

#[cfg(test)]
mod tests {
    use super::STEPS;
    use crate::parse;
    use proptest::prelude::*;

    /// Maximum number of characters of a question in the API.
    const MAX_CHARS: usize = 1000;

    /// Returns the number of steps to read a text of `chars` characters that repeats a pattern.
    fn steps(pattern: &str, chars: usize) -> u64 {
        let text: String = pattern.chars().cycle().take(chars).collect();
        let before = STEPS.get();
        let _ = parse(&text);
        STEPS.get() - before
    }

    /// Words of every role in a question, to be combined with marks between them.
    const WORDS: [&str; 44] = [
        "a",
        "the",
        "mug",
        "red",
        "table",
        "left",
        "on",
        "in",
        "of",
        "and",
        "or",
        "not",
        "with",
        "it",
        "that",
        "what",
        "where",
        "something",
        "to",
        "sit",
        "i",
        "you",
        "need",
        "put",
        "is",
        "are",
        "there",
        "no",
        "sorry",
        "mean",
        "one",
        "between",
        "behind",
        "closest",
        "second",
        "largest",
        "facing",
        "when",
        "look",
        "for",
        "xyzzyx",
        "refridgerater",
        "'s",
        "robot",
    ];
    const MARKS: [&str; 14] =
        [" ", " ", " ", " ", ",", ", ", ".", "?", ";", ": ", "(", ") ", "'", "\n"];

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(400))]
        /// A bound linear in the length holds at every length. Lengths are not compared with each
        /// other: a short text can end before the words that cost most.
        #[test]
        fn parsing_cost_is_linear_in_query_length(parts in prop::collection::vec((prop::sample::select(&WORDS[..]), prop::sample::select(&MARKS[..])), 1..12)) {
            let pattern: String = parts.iter().flat_map(|(word, mark)| [*word, *mark]).collect();
            for chars in [MAX_CHARS / 8, MAX_CHARS / 4, MAX_CHARS / 2, MAX_CHARS] {
                let (steps, bound) = (steps(&pattern, chars), 20_000 + 380 * chars as u64);
                prop_assert!(steps < bound, "{pattern:?}: {steps} steps for {chars} characters");
            }
        }
    }

    #[test]
    fn repeated_punctuation_stays_below_the_step_limit() {
        for mark in [
            ",",
            ".",
            "(",
            ")",
            ";",
            ":",
            "?",
            "'",
            "\"",
            "-",
            "a,",
            "a, ",
            "what,",
            "what x, ",
            "i need to,",
            "put it,",
            "no,",
        ] {
            let steps = steps(mark, MAX_CHARS);
            assert!(steps < 400_000, "{mark:?}: {steps} steps");
        }
    }
}
