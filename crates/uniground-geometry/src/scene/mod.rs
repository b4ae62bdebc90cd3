//! The vocabulary of a scan: clouds, cameras, frames, instances. All higher crates use these types.
//!
//! Canonical conventions: meters, right-handed world with Z up, OpenCV cameras (x right, y down, z
//! forward), camera-to-world poses. [`ingest`](uniground_ingest) converts once. No other code swaps
//! axes.

mod bundle;
mod camera;
mod cell_mask;
mod cloud;
mod corrected;
mod coverage;
mod depth_file;
mod embeddings;
mod even_points;
mod export;
mod float_pictures;
mod frame;
mod frame_embeddings;
mod free_space;
mod instance;
mod npy;
mod optics;
mod owners;
mod parsed;
mod stream_frames;
mod viewing_distance;

pub use bundle::{Addition, SceneBundle};
pub use camera::{Camera, Intrinsics, Pixel};
pub use cell_mask::CellMask;
pub use cloud::PointCloud;
pub use corrected::{correct, merge_views, parts_of};
pub use coverage::{CoverageBuilder, RoomCoverage, SeenShare, UnseenVolume};
pub use depth_file::{LEAST_UNIT_OF_BYTES_M, is_compressed_floats};
pub use embeddings::{Embeddings, Norms};
pub use even_points::{evenly_spread_order, write_even_points};
pub use export::write as write_ply;
pub use export::{id_color, read_instance_of_point, write_cloud_ply, write_instances_ply};
pub use float_pictures::{float_picture_size, is_float_picture};
pub use frame::{DepthImage, Frame, FrameError, FrameRef};
pub use frame_embeddings::FrameEmbeddings;
pub use free_space::{FreeSpaceVotes, count_free_space};
pub use instance::Instance;
pub use optics::{Confidence, DepthSensor, Lens, Optics};
pub use owners::Owners;
pub use parsed::ParsedScene;
pub use stream_frames::stream_frames;
pub use uniground_types::scene::{
    FrameIndex, ImportReport, InstanceId, Level, Levelling, ModelNetwork, ModelTime, NameGuess,
    ParseReport, PoseConvention, SourceToScene, StageReport, Structure, Support, View, ViewMask,
};
pub use viewing_distance::viewing_distance_m;
