//! What is measured: the pipelines in this process, or a running server.

mod in_process;
mod oracle;
mod seen_names;
mod server;

use super::configuration::Configuration;
use super::reply::Reply;
use super::suite::{Expression, Hints, SuiteScene};
pub use in_process::{InProcess, ModelLoader, ModelUse};
pub use oracle::{NamedBy, instances_of, see};
pub use server::Server;
use uniground_geometry::boxes::Aabb;
use uniground_render::RenderScene;

/// Something that answers expressions about scenes.
pub trait System: Sync {
    /// For the report: `in process`, or the server's address.
    fn name(&self) -> String;

    /// Changes whenever the system might answer otherwise; replies are kept under it.
    fn fingerprint(&self) -> &str;

    /// Whether it can do what a configuration asks for.
    ///
    /// # Errors
    /// Why it can not.
    fn accepts(&self, configuration: &Configuration) -> anyhow::Result<()>;

    /// Whether it still has the scene that had this [token](OpenScene::token).
    fn still_has(&self, token: &str) -> bool;

    /// Brings a scene in, ready for questions.
    ///
    /// # Errors
    /// Why the scene can not be used.
    fn enter(
        &self,
        scene: &SuiteScene,
        configuration: &Configuration,
    ) -> anyhow::Result<Box<dyn OpenScene>>;
}

/// A scene that can be asked about. All boxes in metres, world frame (Z up).
pub trait OpenScene: Sync {
    /// Answers one expression. `hints` are given in paper-compatible runs only.
    ///
    /// # Errors
    /// Why there is no answer; it counts as wrong.
    fn ask(
        &self,
        expression: &Expression,
        configuration: &Configuration,
        hints: Option<&Hints>,
    ) -> anyhow::Result<Reply>;

    /// The boxes of all instances: what no shortlist can do better than.
    fn boxes(&self) -> &[Aabb];

    /// By which the system knows the scene again.
    fn token(&self) -> &str;

    /// For pictures.
    fn render_scene(&self) -> &RenderScene;
}
