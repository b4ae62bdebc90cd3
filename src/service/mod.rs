//! Use cases: the only place where pipelines meet storage and jobs. No HTTP here.

mod answering;
mod cache;
mod instances;
mod looking;
mod parse_settings;
mod parsing;
mod pictures;
mod questions;
mod report_files;
mod reports;
mod scenes;
mod uploads;

pub use answering::{Answer, BUILTIN_REASONER, Call, CoordinateFrame, Models, Shortlisted, Trace, Usage};
pub use instances::{InstanceList, InstanceView, ViewPicture};
pub use parse_settings::{ModelChoice, ParseModels, ParsePreset, ParseSettings, PartChoice};
pub use parsing::{PARSE_JOB, ParsedScan, parse_scan};
pub use questions::{Ablation, GroundRequest, Include, ParserChoice, ReasonerChoice, ShortlistRequest};
pub use reports::{ReportPictureLink, SceneReport};
pub use scenes::{Scene, SceneCounts, SceneList, SceneStatus};
pub use uploads::NewScene;

use crate::ingest::archive::UnpackLimits;
use crate::jobs::Jobs;
use crate::models::chat::ChatClient;
pub use crate::models::neural::LoadedModel;
use crate::models::neural::Models as NeuralModels;
use crate::store::Store;
use cache::ParseCache;
use std::sync::Arc;
use tokio::sync::{Mutex, Semaphore};

/// What uploads and questions may take.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    pub max_upload_bytes: u64,
    pub unpack: UnpackLimits,
    /// Questions being answered at once; more wait their turn, shortly.
    pub max_concurrent_questions: usize,
}

/// The use cases over one store. Cheap to clone.
#[derive(Clone)]
pub struct Service {
    store: Store,
    pub jobs: Jobs,
    limits: Limits,
    cache: Arc<ParseCache>,
    questions: Arc<Semaphore>,
    /// A chat model, where one is configured.
    vlm: Option<Arc<ChatClient>>,
    models: NeuralModels,
    /// Held while a scene starts or ceases to refer to its content, so that content is not removed under a new scene.
    content_references: Arc<Mutex<()>>,
}

impl Service {
    #[must_use]
    pub fn new(store: Store, jobs: Jobs, limits: Limits, vlm: Option<Arc<ChatClient>>, models: NeuralModels) -> Self {
        let questions = Arc::new(Semaphore::new(limits.max_concurrent_questions));
        Self { store, jobs, limits, cache: Arc::default(), questions, vlm, models, content_references: Arc::default() }
    }

    /// The neural models this server was started with.
    #[must_use]
    pub fn loaded_models(&self) -> &[LoadedModel] {
        &self.models.loaded
    }

    #[must_use]
    pub fn store(&self) -> &Store {
        &self.store
    }
}
