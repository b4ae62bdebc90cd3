//! Pagination of lists.

use serde::Deserialize;
use uniground_service::error::Error;
use utoipa::IntoParams;
use uuid::Uuid;

/// Pagination parameters.
#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct Page {
    /// Number of entries per page, 1 to 100. Default: 20.
    #[serde(default = "default_limit")]
    #[param(minimum = 1, maximum = 100, default = 20)]
    limit: u32,
    /// `next_cursor` of the previous page.
    cursor: Option<String>,
}

/// Default number of entries per page.
pub const DEFAULT_LIMIT: u32 = 20;

fn default_limit() -> u32 {
    DEFAULT_LIMIT
}

impl Page {
    /// Returns the checked limit and cursor. The cursor must be an id.
    pub fn validate(self) -> Result<(u32, Option<String>), Error> {
        validate(self.limit, self.cursor)
    }
}

/// Checks the limit and the cursor of lists with more parameters.
pub fn validate(limit: u32, cursor: Option<String>) -> Result<(u32, Option<String>), Error> {
    if !(1..=100).contains(&limit) {
        return Err(Error::invalid("limit", "must be 1 to 100"));
    }
    if cursor.as_ref().is_some_and(|cursor| !is_id(cursor)) {
        return Err(Error::invalid("cursor", "must be the next_cursor of the previous page"));
    }
    Ok((limit, cursor))
}

/// Returns whether a text is an id in its stored form. UUIDs in braces or capitals are rejected,
/// because ids are compared as text.
fn is_id(text: &str) -> bool {
    text.parse().is_ok_and(|id: Uuid| id.to_string() == text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_stored_ids_are_valid_cursors() {
        let id = "01a1ff70-0000-7000-8000-00000000000a";
        assert!(validate(1, Some(id.into())).is_ok());
        let others = [
            format!("{{{id}}}"),
            format!("urn:uuid:{id}"),
            id.to_uppercase(),
            id.replace('-', ""),
            String::new(),
            "{}".into(),
        ];
        for other in others {
            let refused = validate(1, Some(other.clone()));
            assert!(
                matches!(&refused, Err(Error::Invalid { pointer, .. }) if pointer == "cursor"),
                "{other:?}: {refused:?}"
            );
        }
    }
}
