//! Parsers for the enum values of the command line, with a help text for each value.

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use serde::de::DeserializeOwned;
use std::num::ParseFloatError;
use uniground_core::models::neural::Provider;
use uniground_core::models::neural::layouts::Precision;
use uniground_types::keys::Scope;
use uniground_types::numbers;
use uniground_types::problem::FieldError;
use uniground_types::question::{EvidenceMode, FrameChoice, ReasonerChoice};
use uniground_types::scenes::ParseQuality;
use uniground_types::settings::{ParsePreset, check_metres_per_unit};

/// Parses an execution provider.
pub fn provider() -> impl TypedValueParser<Value = Provider> {
    word_parser(&[("cpu", ""), ("cuda", ""), ("tensorrt", ""), ("coreml", "")])
}

/// Parses a precision of networks.
pub fn precision() -> impl TypedValueParser<Value = Precision> {
    word_parser(&[
        ("fp32", ""),
        ("fp16", ""),
        ("q8", "8 bits"),
        ("int8", ""),
        ("uint8", ""),
        ("q4", "4 bits"),
        ("q4f16", ""),
        ("bnb4", ""),
    ])
}

/// Parses which parse a question waits for.
pub fn wait() -> impl TypedValueParser<Value = ParseQuality> {
    word_parser(&[("draft", "The first parse, which may be a draft"), ("full", "The full parse")])
}

pub fn preset() -> impl TypedValueParser<Value = ParsePreset> {
    word_parser(&[
        ("default", "Best accuracy over several rooms"),
        ("paper", "The values of the paper"),
    ])
}

pub fn reasoner() -> impl TypedValueParser<Value = ReasonerChoice> {
    word_parser(&[
        ("auto", "The vision-language model if one is configured, else the built-in reasoner"),
        ("vlm", "Always the vision-language model"),
        ("builtin", "Always the built-in reasoner, without a model"),
    ])
}

pub fn scope() -> impl TypedValueParser<Value = Scope> {
    word_parser(&[
        ("read", "View everything and ask questions"),
        ("write", "Also upload, parse and delete scenes, and submit batches"),
        ("admin", "Also create and revoke keys"),
    ])
}

pub fn evidence() -> impl TypedValueParser<Value = EvidenceMode> {
    word_parser(&[
        ("full", "Photographs of every candidate, as in the paper"),
        (
            "cached-names",
            "Cached names from a model and a smaller render; photographs only of candidates with \
             the same name",
        ),
        ("sheet", "One photograph each of 24 candidates, on contact sheets"),
        ("photographs", "Marked photographs in which it points at the object, then its decision"),
        ("two-step", "Contact sheets first, then photographs of the best three"),
    ])
}

pub fn frame() -> impl TypedValueParser<Value = FrameChoice> {
    word_parser(&[
        ("scene", "The scene's own frame: meters, Z up"),
        ("source", "The frame of the uploaded files"),
        ("map", "The frame of the scene's map (scene_to_map)"),
    ])
}

/// Parses an amount in US dollars.
///
/// # Errors
/// Returns an error for an invalid amount. `NaN` is rejected, because JSON cannot represent it and
/// would drop the limit.
pub fn usd(text: &str) -> Result<f64, String> {
    checked(text, |usd| numbers::check_zero_or_more("", usd))
}

/// Parses the length of one unit of a scan's files, meters.
///
/// # Errors
/// Returns an error for an invalid length.
pub fn meters_per_unit(text: &str) -> Result<f64, String> {
    checked(text, |metres| check_metres_per_unit("", Some(metres)))
}

fn checked(text: &str, check: impl FnOnce(f64) -> Result<(), FieldError>) -> Result<f64, String> {
    let number = text.parse().map_err(|error: ParseFloatError| error.to_string())?;
    check(number).map(|()| number).map_err(|error| error.detail)
}

/// Parses values in the spelling of the command line. The API writes them with underscores.
fn word_parser<T: DeserializeOwned + Clone + Send + Sync + 'static>(
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
    fn every_word_parses_to_a_value() {
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
    fn invalid_numbers_are_rejected() {
        for text in ["NaN", "inf", "-inf", "-1", "1e999", "", "much"] {
            assert!(usd(text).is_err() && meters_per_unit(text).is_err(), "{text:?}");
        }
        assert_eq!((usd("0"), usd("2.5"), meters_per_unit("0.001")), (Ok(0.0), Ok(2.5), Ok(0.001)));
        assert!(meters_per_unit("0").is_err());
    }
}
