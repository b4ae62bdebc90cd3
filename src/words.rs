//! Words of the command line for values of the pipelines and the API, with a line of help each.

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use serde::de::DeserializeOwned;
use std::num::ParseFloatError;
use uniground_core::models::neural::Provider;
use uniground_types::keys::Scope;
use uniground_types::numbers;
use uniground_types::problem::FieldError;
use uniground_types::question::{EvidenceMode, FrameChoice, ReasonerChoice};
use uniground_types::settings::{ParsePreset, check_metres_per_unit};

/// Parses an execution provider.
pub fn provider() -> impl TypedValueParser<Value = Provider> {
    words(&[("cpu", ""), ("cuda", ""), ("tensorrt", ""), ("coreml", "")])
}

pub fn preset() -> impl TypedValueParser<Value = ParsePreset> {
    words(&[
        ("default", "What measures best over several rooms"),
        ("paper", "Every value the paper states"),
    ])
}

pub fn reasoner() -> impl TypedValueParser<Value = ReasonerChoice> {
    words(&[
        ("auto", "A vision-language model when one is configured, else the built-in reasoner"),
        ("vlm", ""),
        ("builtin", ""),
    ])
}

pub fn scope() -> impl TypedValueParser<Value = Scope> {
    words(&[
        ("read", "Look at everything, and ask"),
        ("write", "Also upload, parse and delete scenes, and submit batches"),
        ("admin", "Also make and revoke keys"),
    ])
}

pub fn evidence() -> impl TypedValueParser<Value = EvidenceMode> {
    words(&[
        ("full", "Photographs of every candidate with every question, as in the paper"),
        (
            "cached-names",
            "Names that a model gave once, and a smaller render; photographs only of candidates the question can not tell apart by name",
        ),
        ("sheet", "One photograph each of 24 candidates, on contact sheets"),
        ("two-step", "Contact sheets first, then photographs of the three that remain"),
    ])
}

pub fn frame() -> impl TypedValueParser<Value = FrameChoice> {
    words(&[
        ("scene", "The scene's own: metres, Z up"),
        ("source", "Those of the files the scan was read from"),
        ("map", "Those of the map that the scene lies in (scene_to_map)"),
    ])
}

/// Parses an amount in US dollars.
///
/// # Errors
/// Returns an error for an invalid amount. `NaN` is refused: JSON cannot represent it, so it would
/// be left out, and the limit with it.
pub fn usd(text: &str) -> Result<f64, String> {
    checked(text, |usd| numbers::check_zero_or_more("", usd))
}

/// Parses the length of one unit of a scan's files, meters.
///
/// # Errors
/// Returns an error for an invalid length.
pub fn metres_per_unit(text: &str) -> Result<f64, String> {
    checked(text, |metres| check_metres_per_unit("", Some(metres)))
}

fn checked(text: &str, check: impl FnOnce(f64) -> Result<(), FieldError>) -> Result<f64, String> {
    let number = text.parse().map_err(|error: ParseFloatError| error.to_string())?;
    check(number).map(|()| number).map_err(|error| error.detail)
}

/// Parses words in the spelling of the command line. The API writes them with underscores.
fn words<T: DeserializeOwned + Clone + Send + Sync + 'static>(
    known: &[(&'static str, &'static str)],
) -> impl TypedValueParser<Value = T> {
    let value = |(word, help): &(&'static str, &'static str)| {
        if help.is_empty() {
            PossibleValue::new(*word)
        } else {
            PossibleValue::new(*word).help(*help)
        }
    };
    PossibleValuesParser::new(known.iter().map(value))
        .try_map(|word| serde_json::from_value(word.replace('-', "_").into()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::{Arg, Command};

    #[test]
    fn every_word_stands_for_a_value() {
        fn check<T: Clone + Send + Sync + 'static>(parser: impl TypedValueParser<Value = T>) {
            let words: Vec<String> = parser
                .possible_values()
                .unwrap()
                .map(|value| value.get_name().to_owned())
                .collect();
            for word in words {
                let command = Command::new("x").arg(Arg::new("word").value_parser(parser.clone()));
                let read = command.try_get_matches_from(["x", &word]);
                assert!(read.is_ok_and(|read| read.get_one::<T>("word").is_some()), "{word}");
            }
        }
        check(provider());
        check(preset());
        check(reasoner());
        check(evidence());
        check(frame());
        check(scope());
    }

    #[test]
    fn numbers_that_are_none_are_refused() {
        for text in ["NaN", "inf", "-inf", "-1", "1e999", "", "much"] {
            assert!(usd(text).is_err() && metres_per_unit(text).is_err(), "{text:?}");
        }
        assert_eq!((usd("0"), usd("2.5"), metres_per_unit("0.001")), (Ok(0.0), Ok(2.5), Ok(0.001)));
        assert!(metres_per_unit("0").is_err());
    }
}
