//! The sample scan built into this program: a living room, rendered for this project.

/// A zip archive.
pub const LIVING_ROOM: &[u8] = include_bytes!("../../../examples/living_room.zip");
/// The name of scenes made from it.
pub const NAME: &str = "living room";
