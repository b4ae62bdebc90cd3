//! Use cases: the only place where pipelines meet storage and jobs. No HTTP here.

mod answering;
mod cache;
mod evidence;
mod instances;
mod looking;
mod naming;
mod parse_settings;
mod parsing;
mod pictures;
mod questions;
mod report_files;
mod reports;
mod reviewing;
mod scenes;
mod transcripts;
mod uploads;
mod vlm;

pub use answering::{Answer, BUILTIN_REASONER, Call, CoordinateFrame, Models, Shortlisted, Trace, Usage};
pub use instances::{InstanceList, InstanceView, ViewPicture};
pub use naming::NAMING_JOB;
pub use parse_settings::{ModelChoice, ParseModels, ParsePreset, ParseSettings, PartChoice};
pub use parsing::{PARSE_JOB, ParsedScan, parse_scan};
pub use questions::{GroundRequest, Include, ParserChoice, ReasonerChoice, ShortlistRequest};
pub use reports::{ReportPictureLink, SceneReport};
pub use scenes::{Scene, SceneCounts, SceneList, SceneStatus};
pub use transcripts::{AnswerPrompt, AnswerReply, PromptCall, PromptPart, ReplyCall};
pub use uploads::NewScene;
pub use vlm::{Vlm, VlmSettings};

pub use crate::grounding::vlm::{Ablation, EvidenceMode};
use crate::ingest::archive::UnpackLimits;
use crate::jobs::Jobs;
pub use crate::models::neural::LoadedModel;
use crate::models::neural::Models as NeuralModels;
use crate::store::Store;
use cache::Caches;
use std::sync::Arc;
use tokio::sync::{Mutex, Semaphore};

/// What uploads and questions may take.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    pub max_upload_bytes: u64,
    pub unpack: UnpackLimits,
    /// Questions being answered at once; more wait their turn, shortly.
    pub max_concurrent_questions: usize,
    /// Days for which prompts, replies and pictures of answers are kept; 0: none are.
    pub keep_evidence_days: u32,
}

/// The use cases over one store. Cheap to clone.
#[derive(Clone)]
pub struct Service {
    store: Store,
    pub jobs: Jobs,
    limits: Limits,
    caches: Arc<Caches>,
    questions: Arc<Semaphore>,
    /// A vision-language model, where one is configured.
    vlm: Option<Arc<Vlm>>,
    models: NeuralModels,
    /// Held while a scene starts or ceases to refer to its content, so that content is not removed under a new scene.
    content_references: Arc<Mutex<()>>,
}

impl Service {
    #[must_use]
    pub fn new(store: Store, jobs: Jobs, limits: Limits, vlm: Option<Vlm>, models: NeuralModels) -> Self {
        let questions = Arc::new(Semaphore::new(limits.max_concurrent_questions));
        Self { store, jobs, limits, caches: Arc::default(), questions, vlm: vlm.map(Arc::new), models, content_references: Arc::default() }
    }

    /// The neural models this server was started with.
    #[must_use]
    pub fn loaded_models(&self) -> &[LoadedModel] {
        &self.models.loaded
    }

    /// Writes down what was spent on the model until now: the last thing before the store closes.
    ///
    /// # Errors
    /// When the store fails.
    pub async fn settle(&self) -> Result<(), crate::error::Error> {
        match &self.vlm {
            Some(vlm) => vlm.note_spending(&self.store).await,
            None => Ok(()),
        }
    }

    /// The vision-language model's name.
    #[must_use]
    pub fn vlm_model(&self) -> Option<&str> {
        self.vlm.as_ref().map(|vlm| vlm.client.model())
    }

    #[must_use]
    pub fn store(&self) -> &Store {
        &self.store
    }
}
