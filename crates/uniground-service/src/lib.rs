//! Use cases: the only place where pipelines meet storage and jobs. No HTTP here. One folder for
//! every noun of the API.
//!
//! What happens to a question or a scan is the pipelines' business (`uniground-core`); here
//! stands who may ask, where things are kept, what it costs and what is remembered.

mod announcing;
mod answers;
mod approach;
mod batches;
mod corrections;
mod doctor;
pub mod error;
mod health;
mod housekeeping;
mod instances;
mod keys;
mod lately;
mod names;
pub mod packing;
mod parses;
mod retention;
mod room_index;
pub mod sample;
mod scenes;
mod stats;
mod turns;
mod uploads;
mod vlm;
pub mod webhook;

pub use answers::LineFormat;
pub use batches::{BatchJob, Body, Results, Submission};
pub use corrections::GroundTruth;
pub use doctor::{Finding, Trouble};
pub use health::Health;
pub use instances::{EvidenceFile, written};
pub use keys::{Allowance, Caller, Denied, Done, Keyring, LINK_PARAMETER, LinkSecret};
pub use names::NamingJob;
pub use parses::{Download, ParseFile, ParseJob};
pub use retention::{Beside, Removed};
pub use scenes::{ExportFile, NewFrames, NewScene};
pub use uploads::{Algorithm, Checksum, NewUpload, Part};
pub use vlm::{Vlm, VlmSettings, WhenNamed};

use crate::error::Error;
use camino::Utf8PathBuf;
use lately::Lately;
use parses::ParseCache;
use rayon::ThreadPool;
use room_index::RoomNames;
use stats::Numbers;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{Mutex, OwnedSemaphorePermit, Semaphore};
use tokio::task::spawn_blocking;
use tokio::time::timeout;
use uniground_endpoints::inference::Probe;
use uniground_geometry::background;
use uniground_geometry::progress::{Cancelled, Progress};
use uniground_grounding::PictureCache;
use uniground_ingest::archive::UnpackLimits;
use uniground_isolation::ScanReader;
use uniground_jobs::{JobFailure, Jobs};
use uniground_models::neural::{LoadedModel, Models};
use uniground_models::with_causes;
use uniground_storage::Store;
use uniground_telemetry::memory::Memory;
use uniground_telemetry::metrics::Metrics;
use uniground_types::stats::Retention;
use uploads::{Telling, unexplained};

/// What uploads and questions may take.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    pub max_upload_bytes: u64,
    /// Uploads in parts that may be unfinished at once.
    pub max_unfinished_uploads: u32,
    pub unpack: UnpackLimits,
    /// Room on the disk that uploads, parses and batches leave to the rest.
    pub keep_free_bytes: u64,
    /// Memory the process may come to hold; `None`: what the system lets it have.
    pub max_memory_bytes: Option<u64>,
    /// Questions being answered at once; more wait their turn, shortly.
    pub max_concurrent_questions: usize,
    pub retention: Retention,
}

/// The use cases over one store. Cheap to clone.
#[derive(Clone)]
pub struct Service {
    store: Store,
    pub jobs: Jobs,
    pub keys: Keyring,
    limits: Limits,
    parses: Arc<ParseCache>,
    pictures: Arc<PictureCache>,
    questions: Arc<Semaphore>,
    /// One for each scene of many that is looked into.
    glances: Arc<Semaphore>,
    uploads: Arc<Semaphore>,
    /// How a refused upload is told why.
    tell: Telling,
    /// Where parses compute: a pool of its own whose threads give way. Questions keep rayon's
    /// global pool.
    parsing: Arc<ThreadPool>,
    /// A vision-language model, where one is configured.
    vlm: Option<Arc<Vlm>>,
    models: Models,
    /// Held while frames are laid beside a scene: that is heavy.
    growing: Arc<Mutex<()>>,
    /// Held while something is drawn or made for who looks at a scene: questions have their own
    /// places.
    drawing: Arc<Mutex<()>>,
    /// Reads what was uploaded.
    reader: ScanReader,
    comparisons: Arc<Semaphore>,
    /// Scans below it may be imported; `None`: nothing may.
    import_root: Option<Utf8PathBuf>,
    /// Where an inference server runs the networks.
    inference: Option<Arc<Probe>>,
    health: Lately<Health>,
    numbers: Numbers,
    room_names: Arc<RoomNames>,
    metrics: Arc<Metrics>,
}

/// Uploads received at once.
const MAX_UPLOADS: usize = 16;
/// Comparisons of two scans that are computed at once.
const MAX_COMPARISONS: usize = 2;
/// Scenes looked into at once, whoever asks about many: they take few of the places at work on
/// questions, and few connections of the database.
const MAX_GLANCES: usize = 2;
/// How long a question waits for its turn before the server calls itself overloaded.
const PATIENCE: Duration = Duration::from_secs(2);

impl Service {
    /// `parsing` is the pool parses compute in. The service counts where its jobs count.
    #[must_use]
    pub fn new(
        store: Store,
        jobs: Jobs,
        keys: Keyring,
        limits: Limits,
        vlm: Option<Vlm>,
        models: Models,
        parsing: ThreadPool,
    ) -> Self {
        Self {
            metrics: jobs.metrics().clone(),
            store,
            keys: keys.counted_by(jobs.metrics().clone()),
            jobs,
            limits,
            parses: Arc::default(),
            pictures: Arc::default(),
            questions: Arc::new(Semaphore::new(limits.max_concurrent_questions)),
            glances: Arc::new(Semaphore::new(MAX_GLANCES)),
            uploads: Arc::new(Semaphore::new(MAX_UPLOADS)),
            tell: unexplained,
            parsing: Arc::new(parsing),
            vlm: vlm.map(Arc::new),
            models,
            growing: Arc::default(),
            drawing: Arc::default(),
            reader: ScanReader::in_process(),
            comparisons: Arc::new(Semaphore::new(MAX_COMPARISONS)),
            import_root: None,
            inference: None,
            health: Lately::default(),
            numbers: Numbers::default(),
            room_names: Arc::default(),
        }
    }

    /// Over the folder of a server that does not run: to look after what is stored, without models.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn at_rest(store: Store, limits: Limits) -> Result<Self, Error> {
        let keys = Keyring::open(store.clone(), None).await?;
        let pool = background::pool().map_err(|error| Error::Io(std::io::Error::other(error)))?;
        Ok(Self::new(
            store.clone(),
            Jobs::new(store, 0),
            keys,
            limits,
            None,
            Models::default(),
            pool,
        ))
    }

    /// Uploads are read this way; in this process where nothing else is said.
    #[must_use]
    pub fn reading_with(self, reader: ScanReader) -> Self {
        Self { reader, ..self }
    }

    /// The neural models this server was started with.
    #[must_use]
    pub fn loaded_models(&self) -> &[LoadedModel] {
        &self.models.loaded
    }

    /// The vision-language model, where one is configured.
    #[must_use]
    pub fn vlm(&self) -> Option<&Vlm> {
        self.vlm.as_deref()
    }

    /// The vision-language model's name.
    #[must_use]
    pub fn vlm_model(&self) -> Option<&str> {
        self.vlm.as_ref().map(|vlm| vlm.name())
    }

    /// Whether there is room for something more of a size, and some for the rest: what runs goes
    /// on, questions are answered and kept.
    fn check_disk(&self, bytes: u64) -> Result<(), Error> {
        let free = self.store.health.free_bytes()?;
        if free < self.limits.keep_free_bytes.saturating_add(bytes) {
            Err(Error::DiskNearlyFull { free })
        } else {
            Ok(())
        }
    }

    /// Whether there is memory for something that takes so much. Where the system does not tell, it
    /// is believed; blocks.
    fn check_memory(&self, wanted: u64) -> Result<(), Error> {
        let Some(Memory { resident, most }) = Memory::now() else { return Ok(()) };
        let most = self.limits.max_memory_bytes.unwrap_or(most);
        if resident.saturating_add(wanted) > most {
            Err(Error::MemoryShort { wanted, resident, most })
        } else {
            Ok(())
        }
    }

    /// Waits for one of the bounded places at work on questions; not for long.
    async fn turn(&self) -> Result<OwnedSemaphorePermit, Error> {
        let turn = timeout(PATIENCE, self.questions.clone().acquire_owned()).await;
        turn.ok().and_then(Result::ok).ok_or(Error::Overloaded)
    }

    /// Computes for a question, off the async threads, when its turn has come.
    async fn compute<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> Result<T, Error> + Send + 'static,
    ) -> Result<T, Error> {
        let permit = self.turn().await?;
        let span = tracing::Span::current();
        spawn_blocking(move || {
            let _permit = permit;
            span.in_scope(work)
        })
        .await?
    }
}

/// How a job ends that stumbled over an error of ours.
fn job_failure(error: Error) -> JobFailure {
    match error.code() {
        "cancelled" => JobFailure::Cancelled,
        code => JobFailure::Failed {
            code: code.to_owned(),
            detail: error.to_string(),
            cause: with_causes(&error),
            transient: error.may_pass(),
        },
    }
}

/// Ends when a job is to stop.
async fn until_cancelled(progress: &Progress) -> Cancelled {
    const LOOK_EVERY: Duration = Duration::from_millis(100);
    loop {
        if let Err(cancelled) = progress.check() {
            return cancelled;
        }
        tokio::time::sleep(LOOK_EVERY).await;
    }
}
