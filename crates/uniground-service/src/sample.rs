//! The scan this program carries: a living room, rendered for this project.

/// A zip archive.
pub const LIVING_ROOM: &[u8] = include_bytes!("../../../examples/living_room.zip");
/// What scenes of it are called.
pub const NAME: &str = "living room";
