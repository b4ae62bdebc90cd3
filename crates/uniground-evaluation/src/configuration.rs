//! The varied settings of a run: one [`Configuration`] per cell of the table, parsed from
//! `axis=value,value;axis=…`.

use anyhow::{Context, bail, ensure};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use uniground_grounding::direction::DirectionConvention;
use uniground_models::choice::{AUTO, BUILTIN, BUILTIN_ENCODER, BUILTIN_MASKS};
use uniground_types::question::{
    Ablation, CandidateSource, EvidenceMode, ParserChoice, PromptVersion, QueryText, ReasonerChoice,
};
use uniground_types::settings::{ParsePreset, ParseSettings};

/// The source of instances. Each source isolates one bottleneck.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Source {
    /// Stage 1 on the scan: the whole system.
    #[default]
    Parsed,
    /// Annotated boxes and names: measures only language and spatial reasoning.
    Oracle,
    /// Annotated boxes with the encoder's names: measures the loss from names.
    OracleBoxes,
    /// The candidates stored in a task folder (`ref.json`).
    Recorded,
}

/// An additional source of names, besides the encoder.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Names {
    /// No additional names.
    #[default]
    Own,
    /// Names that an annotator gave to objects from pictures alone (`<scene>.names.json`), assigned
    /// to the instances that cover them. They resemble the names of a good model, without its
    /// mistakes about what a tile shows.
    Seen,
}

/// One cell: all settings that a reply depends on, besides the scene and the expression.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Configuration {
    pub source: Source,
    #[serde(default)]
    pub names: Names,
    pub preset: ParsePreset,
    /// Settings of a parse that override the preset, as in a parse request.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub settings: Option<Value>,
    /// `rgbd`, or the name of a segmenter's bundle.
    pub masks: String,
    /// `attributes`, or the name of a dual encoder's bundle.
    pub encoder: String,
    pub parser: ParserChoice,
    pub reasoner: ReasonerChoice,
    #[serde(default)]
    pub candidates: CandidateSource,
    #[serde(default)]
    pub query_text: QueryText,
    #[serde(default)]
    pub prompt: PromptVersion,
    pub ablation: Ablation,
    pub evidence: EvidenceMode,
    pub top_k: u32,
    pub convention: DirectionConvention,
    pub paper_compatible: bool,
}

impl Default for Configuration {
    fn default() -> Self {
        Self {
            source: Source::Parsed,
            names: Names::Own,
            preset: ParsePreset::Default,
            settings: None,
            masks: BUILTIN_MASKS.into(),
            encoder: BUILTIN_ENCODER.into(),
            parser: ParserChoice::Builtin,
            // By default, a run makes no paid calls.
            reasoner: ReasonerChoice::Builtin,
            candidates: CandidateSource::Fused,
            query_text: QueryText::Mean,
            prompt: PromptVersion::Revised,
            ablation: Ablation::Full,
            evidence: EvidenceMode::Full,
            top_k: 5,
            convention: DirectionConvention::Paper,
            paper_compatible: false,
        }
    }
}

const MAX_TOP_K: u32 = 100;
/// Maximum number of cells. More are assumed to be a mistake.
const MAX_CELLS: usize = 1000;

/// Returns all combinations of the values in `matrix` over `base`, in the order written. The last
/// axis varies fastest.
///
/// # Errors
/// Returns an error for an unknown axis or value (with the known ones), an axis given twice, too
/// many cells, or a parser that is equivalent to another one.
pub fn expand_matrix(
    matrix: &str,
    base: &Configuration,
) -> anyhow::Result<Vec<(String, Configuration)>> {
    let mut cells = vec![(String::new(), base.clone())];
    let mut seen: Vec<&str> = Vec::new();
    for part in matrix.split(';').map(str::trim).filter(|part| !part.is_empty()) {
        let (axis, values) =
            part.split_once('=').with_context(|| format!("{part:?}: expected axis=value,value"))?;
        let axis = axis.trim();
        ensure!(!seen.contains(&axis), "the axis {axis} is given twice");
        seen.push(axis);
        let values = split_values(values);
        ensure!(!values.is_empty(), "the axis {axis} has no values");
        ensure!(
            (1..values.len()).all(|i| !values[..i].contains(&values[i])),
            "the axis {axis} repeats a value"
        );
        ensure!(
            cells.len() * values.len() <= MAX_CELLS,
            "the matrix has more than {MAX_CELLS} cells"
        );
        let mut varied = Vec::with_capacity(cells.len() * values.len());
        for (name, configuration) in cells {
            for value in &values {
                let mut configuration = configuration.clone();
                set_axis(&mut configuration, axis, value)?;
                let joint = if name.is_empty() { "" } else { ", " };
                varied.push((format!("{name}{joint}{axis}={value}"), configuration));
            }
        }
        cells = varied;
    }
    for (name, configuration) in &cells {
        let asks_nobody = configuration.parser == ParserChoice::Auto
            && configuration.reasoner == ReasonerChoice::Builtin;
        ensure!(
            !asks_nobody,
            "{name}: parser=auto uses no model with reasoner=builtin; use parser=builtin or parser=vlm"
        );
    }
    if let [(name, _)] = cells.as_mut_slice()
        && name.is_empty()
    {
        "default".clone_into(name);
    }
    Ok(cells)
}

/// Splits values at commas. Commas within brackets belong to a list.
fn split_values(values: &str) -> Vec<&str> {
    let mut depth = 0;
    let between = |c: char| {
        depth += i32::from(c == '[') - i32::from(c == ']');
        c == ',' && depth == 0
    };
    values.split(between).map(str::trim).filter(|value| !value.is_empty()).collect()
}

/// Overrides one setting of the parse, such as `parsing.merging.max_hop`. The value is JSON; words
/// need no quotes.
fn set_parse(configuration: &mut Configuration, axis: &str, value: &str) -> anyhow::Result<()> {
    let leaf = serde_json::from_str(value).unwrap_or_else(|_| Value::from(value));
    let mut place =
        configuration.settings.get_or_insert_with(|| Value::Object(serde_json::Map::new()));
    for name in axis.split('.') {
        let object = place.as_object_mut().with_context(|| {
            format!("{axis}: another axis already sets the object that contains it")
        })?;
        place = object.entry(name).or_insert_with(|| Value::Object(serde_json::Map::new()));
    }
    *place = leaf;
    ParseSettings::from_request(configuration.preset, configuration.settings.clone())
        .map_err(|error| anyhow::anyhow!("{axis}={value}: {}: {}", error.pointer, error.detail))?;
    Ok(())
}

fn set_axis(configuration: &mut Configuration, axis: &str, value: &str) -> anyhow::Result<()> {
    match axis {
        _ if axis.starts_with("import.") || axis.starts_with("parsing.") => {
            set_parse(configuration, axis, value)?;
        }
        "source" => {
            configuration.source =
                parse_word(axis, value, "parsed, oracle, oracle-boxes, recorded")?;
        }
        "names" => configuration.names = parse_word(axis, value, "own, seen")?,
        "candidates" => {
            configuration.candidates = parse_word(axis, value, "fused, encoder, reasoner")?;
        }
        "query_text" => configuration.query_text = parse_word(axis, value, "full, target, mean")?,
        "prompt" => configuration.prompt = parse_word(axis, value, "paper, revised")?,
        "preset" => configuration.preset = parse_word(axis, value, "default, paper")?,
        "parser" => configuration.parser = parse_word(axis, value, "auto, builtin, vlm")?,
        "reasoner" => configuration.reasoner = parse_word(axis, value, "auto, builtin, vlm")?,
        "ablation" => {
            configuration.ablation =
                parse_word(axis, value, "full, no_global, no_candidate, simple_prompt")?;
        }
        "evidence" => {
            configuration.evidence =
                parse_word(axis, value, "full, cached_names, sheet, two_step, photographs")?;
        }
        "convention" => configuration.convention = parse_word(axis, value, "paper, viewer")?,
        "masks" => configuration.masks = parse_bundle(axis, value, BUILTIN_MASKS)?,
        "encoder" => configuration.encoder = parse_bundle(axis, value, BUILTIN_ENCODER)?,
        "top_k" => match value.parse() {
            Ok(top_k) if (1..=MAX_TOP_K).contains(&top_k) => configuration.top_k = top_k,
            _ => bail!("top_k={value}: expected 1 to {MAX_TOP_K}"),
        },
        _ => bail!(
            "{axis}: unknown; the axes are source, names, preset, masks, encoder, parser, reasoner, candidates, query_text, prompt, ablation, evidence, top_k, convention, and every setting of a parse, like parsing.merging.max_hop"
        ),
    }
    Ok(())
}

/// Returns a bundle's name, or the name of the built-in implementation, so that a figure states
/// what it was measured with.
fn parse_bundle(axis: &str, value: &str, builtin: &str) -> anyhow::Result<String> {
    ensure!(
        value != AUTO,
        "{axis}={AUTO} is not allowed, because results must name the model: use {builtin} or a bundle's name"
    );
    Ok(if value == BUILTIN { builtin } else { value }.to_owned())
}

/// Parses a value in the spelling of the HTTP API.
fn parse_word<T: DeserializeOwned>(axis: &str, value: &str, known: &str) -> anyhow::Result<T> {
    serde_json::from_value(value.into())
        .map_err(|_| anyhow::anyhow!("{axis}={value}: expected one of {known}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use uniground_types::settings::Normalisation;

    #[test]
    fn matrix_expands_to_all_combinations_in_order() {
        let cells =
            expand_matrix("source=oracle,parsed; top_k=3,5", &Configuration::default()).unwrap();
        let names: Vec<&str> = cells.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(
            names,
            [
                "source=oracle, top_k=3",
                "source=oracle, top_k=5",
                "source=parsed, top_k=3",
                "source=parsed, top_k=5"
            ]
        );
        assert_eq!((cells[1].1.source, cells[1].1.top_k), (Source::Oracle, 5));
        let plain = super::expand_matrix("", &Configuration::default()).unwrap();
        assert_eq!(plain, [("default".to_owned(), Configuration::default())]);
    }

    #[test]
    fn every_setting_of_a_parse_is_an_axis() {
        let matrix = "parsing.merging.thresholds=[0.9,0.5],[0.7]; parsing.refine_borders=false; parsing.merging.normalisation=literal";
        let cells = expand_matrix(matrix, &Configuration::default()).unwrap();
        assert_eq!(cells.len(), 2);
        let settings =
            ParseSettings::from_request(ParsePreset::Default, cells[0].1.settings.clone())
                .unwrap()
                .parsing;
        assert_eq!(settings.merging.thresholds, [0.9, 0.5]);
        assert_eq!(
            (settings.merging.normalisation, settings.refine_borders),
            (Normalisation::Literal, false)
        );
    }

    #[test]
    fn builtin_masks_and_encoder_are_recorded_by_name() {
        let cells =
            expand_matrix("masks=builtin,mine;encoder=builtin", &Configuration::default()).unwrap();
        let used: Vec<(&str, &str)> =
            cells.iter().map(|(_, c)| (c.masks.as_str(), c.encoder.as_str())).collect();
        assert_eq!(used, [(BUILTIN_MASKS, BUILTIN_ENCODER), ("mine", BUILTIN_ENCODER)]);
    }

    #[test]
    fn unknown_axes_and_values_are_rejected_with_the_known_ones() {
        for (matrix, expected) in [
            ("sources=oracle", "the axes are source"),
            ("source=magic", "expected one of parsed, oracle"),
            ("top_k=0", "expected 1 to 100"),
            ("top_k", "expected axis=value"),
            ("top_k=3;top_k=5", "given twice"),
            ("source=", "has no values"),
            ("encoder=builtin,auto", "results must name the model"),
            ("parser=auto", "uses no model with reasoner=builtin"),
            ("parsing.merging.max_hop=9", "max_hop: must be 1 to 4"),
            ("parsing.merge.max_hop=1", "unknown field `merge`"),
        ] {
            let error = expand_matrix(matrix, &Configuration::default()).unwrap_err().to_string();
            assert!(error.contains(expected), "{matrix}: {error}");
        }
    }
}
