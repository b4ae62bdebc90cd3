//! How good is it? Annotated rooms, and measures of what stage 1 makes of them.
//!
//! Ground truth is read here and nowhere below: a parse can not know what it will be measured with.

pub mod annotated;
pub mod segmentation;
