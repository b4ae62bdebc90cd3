//! Words that name a mask source or an encoder in settings and reports.

/// The bundle that works of those in the folder of bundles, or else what is built in.
pub const AUTO: &str = "auto";
/// The mask source or encoder that needs no model.
pub const BUILTIN: &str = "builtin";
/// The name of the mask source that needs no model.
pub const BUILTIN_MASKS: &str = "rgbd";
/// The name of the encoder that needs no model.
pub const BUILTIN_ENCODER: &str = "attributes";
