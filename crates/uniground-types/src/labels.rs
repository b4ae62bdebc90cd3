//! Labels of scenes, for example a building, a floor or a customer.

use crate::problem::FieldError;
use std::collections::BTreeMap;

/// Labels of a scene: names and values.
pub type Labels = BTreeMap<String, String>;

const MOST: usize = 20;
const LONGEST_NAME: usize = 63;
const LONGEST_VALUE: usize = 100;

/// # Errors
/// Returns a [`FieldError`] below `at` if there are more than 20 labels, if a name is not 1 to 63
/// letters, digits, `.`, `_`, `-` and `/`, or if a value is not one line of 1 to 100 characters
/// without commas or surrounding blanks.
pub fn check_labels(at: &str, labels: &Labels) -> Result<(), FieldError> {
    if labels.len() > MOST {
        return Err(FieldError::new(
            at,
            format!("has {} labels, must have at most {MOST}", labels.len()),
        ));
    }
    for (name, value) in labels {
        let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"._-/".contains(&byte);
        if !(1..=LONGEST_NAME).contains(&name.len()) || !name.bytes().all(plain) {
            let detail = format!(
                "{name:?} is not a label name: use 1 to {LONGEST_NAME} letters, digits, '.', '_', \
                 '-' and '/'"
            );
            return Err(FieldError::new(at, detail));
        }
        if value.trim().is_empty()
            || value.trim() != value
            || value.chars().count() > LONGEST_VALUE
            || value.chars().any(|c| c.is_control() || c == ',')
        {
            let detail = format!(
                "{name} must be one line of 1 to {LONGEST_VALUE} characters without commas or \
                 surrounding blanks"
            );
            return Err(FieldError::new(at, detail));
        }
    }
    Ok(())
}

/// Parses labels from a query parameter or a flag: `building=A,floor=2`.
///
/// # Errors
/// Returns the errors of [`check_labels`], and an error for a part without `=` or a repeated name.
pub fn read_labels(at: &str, text: &str) -> Result<Labels, FieldError> {
    let mut labels = Labels::new();
    for part in text.split(',') {
        let Some((name, value)) = part.split_once('=') else {
            return Err(FieldError::new(
                at,
                format!("{part:?} is not a label: use name=value, like building=A,floor=2"),
            ));
        };
        if labels.insert(name.trim().to_owned(), value.trim().to_owned()).is_some() {
            return Err(FieldError::new(at, format!("{} is given twice", name.trim())));
        }
    }
    check_labels(at, &labels)?;
    Ok(labels)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_are_parsed_from_comma_separated_pairs() {
        let labels = read_labels("labels", "building=A, floor = 2,note=a=b").unwrap();
        assert_eq!(
            labels,
            Labels::from(
                [("building", "A"), ("floor", "2"), ("note", "a=b")]
                    .map(|(n, v)| (n.into(), v.into()))
            )
        );
    }

    #[test]
    fn invalid_labels_are_rejected() {
        let long = format!("x={}", "y".repeat(101));
        for wrong in ["", "building", "a=1,a=2", "two words=x", "x=", "x= ", &long, "ä=1", "x=a\nb"]
        {
            assert!(read_labels("labels", wrong).is_err(), "{wrong:?}");
        }
        assert!(check_labels("/labels", &Labels::from([("a".into(), " x".into())])).is_err());
        let many: Labels = (0..21).map(|i| (format!("l{i}"), "x".to_owned())).collect();
        assert!(check_labels("/labels", &many).is_err());
    }
}
