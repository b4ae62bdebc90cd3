//! What people say of a parse that is wrong: kept beside it, used by later answers, exported as
//! ground truth.

use crate::scene::InstanceId;
use serde::{Deserialize, Serialize};

/// What is to be different.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Change {
    /// It is called something else.
    Rename {
        /// Which instance.
        instance_id: InstanceId,
        /// One line of 1 to 100 characters: what people would call it, "red mug".
        #[cfg_attr(feature = "openapi", schema(min_length = 1, max_length = 100))]
        name: String,
    },
    /// They are no things at all: never an answer, never what an answer is told by.
    Dismiss {
        /// Which instances, at most 100.
        #[cfg_attr(feature = "openapi", schema(min_items = 1, max_items = 100))]
        instance_ids: Vec<InstanceId>,
    },
    /// They are one thing: a new instance of all their points, of which they are parts from now on.
    Merge {
        /// Two things or more, at most 100.
        #[cfg_attr(feature = "openapi", schema(min_items = 2, max_items = 100))]
        instance_ids: Vec<InstanceId>,
        /// What people would call it; left out, its measures tell.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        #[cfg_attr(feature = "openapi", schema(min_length = 1, max_length = 100))]
        name: Option<String>,
    },
    /// It is not one thing: its parts take its place.
    Split {
        /// Which thing.
        instance_id: InstanceId,
    },
}

/// A change somebody has made.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Correction {
    /// UUIDv7; in order of time, in which they take effect.
    pub id: String,
    /// What is different.
    pub change: Change,
    /// The instance that a merge has made.
    pub made: Option<InstanceId>,
    /// Name of the key it was made with; `null` for the server's own, and where no key is wanted.
    pub author: Option<String>,
    /// When it was made, RFC 3339 UTC.
    pub created_at: String,
    /// When it was taken back, RFC 3339 UTC; `null` while it holds.
    pub undone_at: Option<String>,
}

/// All corrections of a scene's current parse.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct CorrectionList {
    /// Newest first, those that were taken back included.
    pub corrections: Vec<Correction>,
}
