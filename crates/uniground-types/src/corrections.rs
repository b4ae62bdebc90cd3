//! Corrections of a parse by users. Later answers use them, and exports include them as ground
//! truth.

use crate::scene::InstanceId;
use serde::{Deserialize, Serialize};

/// A correction of the parse.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Change {
    /// Renames an instance.
    Rename {
        /// Id of the instance.
        instance_id: InstanceId,
        /// The new name, one line of 1 to 100 characters: "red mug".
        #[cfg_attr(feature = "openapi", schema(min_length = 1, max_length = 100))]
        name: String,
    },
    /// Dismisses instances that are not objects. Answers do not use them.
    Dismiss {
        /// Ids of the instances, 1 to 100.
        #[cfg_attr(feature = "openapi", schema(min_items = 1, max_items = 100))]
        instance_ids: Vec<InstanceId>,
    },
    /// Merges instances into a new instance with all their points. The merged instances become its
    /// parts.
    Merge {
        /// Ids of the instances, 2 to 100.
        #[cfg_attr(feature = "openapi", schema(min_items = 2, max_items = 100))]
        instance_ids: Vec<InstanceId>,
        /// Name of the new instance, 1 to 100 characters. If omitted, it is named automatically.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        #[cfg_attr(feature = "openapi", schema(min_length = 1, max_length = 100))]
        name: Option<String>,
    },
    /// Splits an instance: its parts replace it.
    Split {
        /// Id of the instance.
        instance_id: InstanceId,
    },
}

/// A stored correction.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct Correction {
    /// UUIDv7, so ids sort by time. Corrections apply in this order.
    pub id: String,
    /// The correction.
    pub change: Change,
    /// Id of the instance that a merge created.
    pub made: Option<InstanceId>,
    /// Name of the key that made it. `null` for the server's own key, and without authentication.
    pub author: Option<String>,
    /// Creation time, RFC 3339 UTC.
    pub created_at: String,
    /// Time when it was undone, RFC 3339 UTC. `null` while it applies.
    pub undone_at: Option<String>,
}

/// All corrections of a scene's current parse.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "openapi", derive(utoipa::ToSchema))]
pub struct CorrectionList {
    /// Corrections, newest first, including undone ones.
    pub corrections: Vec<Correction>,
}
