//! What scenes are filed under: a building, a floor, a customer.

use crate::problem::FieldError;
use std::collections::BTreeMap;

/// Labels of a scene: names and values.
pub type Labels = BTreeMap<String, String>;

const MOST: usize = 20;
const LONGEST_NAME: usize = 63;
const LONGEST_VALUE: usize = 100;

/// # Errors
/// A [`FieldError`] below `at`: more than 20 labels; a name that is not 1 to 63 letters, digits,
/// `.`, `_`, `-` and `/`; a value that is not one line of 1 to 100 characters without commas or
/// blanks around it.
pub fn check_labels(at: &str, labels: &Labels) -> Result<(), FieldError> {
    if labels.len() > MOST {
        return Err(FieldError::new(
            at,
            format!("has {} labels, at most {MOST} are kept", labels.len()),
        ));
    }
    for (name, value) in labels {
        let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"._-/".contains(&byte);
        if !(1..=LONGEST_NAME).contains(&name.len()) || !name.bytes().all(plain) {
            let detail = format!(
                "{name:?} is no name of a label: 1 to {LONGEST_NAME} letters, digits, '.', '_', '-' and '/'"
            );
            return Err(FieldError::new(at, detail));
        }
        if value.trim().is_empty()
            || value.trim() != value
            || value.chars().count() > LONGEST_VALUE
            || value.chars().any(|c| c.is_control() || c == ',')
        {
            let detail = format!(
                "{name} must be one line of 1 to {LONGEST_VALUE} characters without commas or blanks around it"
            );
            return Err(FieldError::new(at, detail));
        }
    }
    Ok(())
}

/// Labels as parameters and flags have them: `building=A,floor=2`.
///
/// # Errors
/// As [`check_labels`]; a part without `=`, and a name that stands twice.
pub fn read_labels(at: &str, text: &str) -> Result<Labels, FieldError> {
    let mut labels = Labels::new();
    for part in text.split(',') {
        let Some((name, value)) = part.split_once('=') else {
            return Err(FieldError::new(at, format!("{part:?} is no label: building=A,floor=2")));
        };
        if labels.insert(name.trim().to_owned(), value.trim().to_owned()).is_some() {
            return Err(FieldError::new(at, format!("{} stands there twice", name.trim())));
        }
    }
    check_labels(at, &labels)?;
    Ok(labels)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_are_read_as_they_are_written() {
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
    fn what_is_no_label_is_refused() {
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
