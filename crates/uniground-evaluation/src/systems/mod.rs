//! Systems under evaluation: the pipelines in this process, or a running server.

mod in_process;
mod oracle;
mod seen_names;
mod server;

use super::configuration::Configuration;
use super::reply::Reply;
use super::suite::{Expression, Hints, SuiteScene};
pub use in_process::{InProcess, ModelLoader, ModelUse};
pub use oracle::{NamedBy, embed_and_name, instances_of};
pub use server::Server;
use uniground_geometry::boxes::Aabb;
use uniground_render::RenderScene;

/// A system that answers expressions about scenes.
pub trait System: Sync {
    /// Returns its name for the report: `in process`, or the server's address.
    fn name(&self) -> String;

    /// Returns a string that changes whenever answers may change. Replies are stored under it.
    fn fingerprint(&self) -> &str;

    /// Checks that the system supports a configuration.
    ///
    /// # Errors
    /// Returns the reason if it does not.
    fn check_configuration(&self, configuration: &Configuration) -> anyhow::Result<()>;

    /// Returns whether it still has the scene with this [token](OpenScene::token).
    fn has_scene(&self, token: &str) -> bool;

    /// Prepares a scene for questions.
    ///
    /// # Errors
    /// Returns the reason why the scene cannot be used.
    fn open_scene(
        &self,
        scene: &SuiteScene,
        configuration: &Configuration,
    ) -> anyhow::Result<Box<dyn OpenScene>>;
}

/// A scene that is ready for questions. All boxes in meters, world frame (Z up).
pub trait OpenScene: Sync {
    /// Answers one expression. `hints` are given in paper-compatible runs only.
    ///
    /// # Errors
    /// Returns the reason why there is no answer. It counts as wrong.
    fn ask(
        &self,
        expression: &Expression,
        configuration: &Configuration,
        hints: Option<&Hints>,
    ) -> anyhow::Result<Reply>;

    /// Returns the boxes of all instances, the upper bound for any shortlist.
    fn boxes(&self) -> &[Aabb];

    /// Returns a token by which the system recognizes the scene.
    fn token(&self) -> &str;

    /// Returns the scene for rendering pictures.
    fn render_scene(&self) -> &RenderScene;
}
