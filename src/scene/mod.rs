//! The vocabulary of a scan: clouds, cameras, frames, instances. Everything above speaks in these types.
//!
//! Canonical inside: metres, right-handed world with Z up, OpenCV cameras (x right, y down, z forward),
//! poses are camera-to-world. [`ingest`](crate::ingest) converts once; nobody swaps axes again.

mod bundle;
mod camera;
mod cloud;
mod embeddings;
mod export;
mod frame;
mod instance;
mod npy;
mod parsed;

pub use bundle::{ImportReport, PoseConvention, SceneBundle};
pub use camera::{Camera, Intrinsics, Pixel};
pub use cloud::PointCloud;
pub use embeddings::{Embeddings, Norms};
pub use export::{id_colour, write_cloud_ply, write_instances_ply};
pub use frame::{DepthImage, Frame, FrameError, FrameIndex, FrameRef, stream_frames};
pub use instance::{Instance, InstanceId, NameGuess, Structure, Support, View};
pub use parsed::{ParseReport, ParsedScene, StageReport};
