//! Names of mask sources and encoders in settings and reports.

/// Selects the working bundle in the folder of bundles, or else the built-in implementation.
pub const AUTO: &str = "auto";
/// Selects the built-in mask source or encoder, which needs no model.
pub const BUILTIN: &str = "builtin";
/// The name of the built-in mask source, which needs no model.
pub const BUILTIN_MASKS: &str = "rgbd";
/// The name of the built-in encoder, which needs no model.
pub const BUILTIN_ENCODER: &str = "attributes";
