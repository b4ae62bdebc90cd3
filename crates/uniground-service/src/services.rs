//! Builds all services in one place, each with its dependencies.

use crate::error::Error;
use crate::parses::ParseCache;
use crate::room_index::RoomNames;
use crate::single_flight_cache::SingleFlightCache;
use crate::stats::FigureCache;
use crate::uploads::{Explain, default_problem};
use crate::{
    AnswerService, ApproachService, BatchRunner, BatchService, Capacity, ChangeService,
    CorrectionService, DoctorService, ExportService, GroundingService, GrowthService,
    HealthService, ImportService, InstanceService, Keyring, Limits, MAX_COMPARISONS,
    MAX_CONCURRENT_SCENE_SCANS, MAX_UPLOADS, MaintenanceService, MediaService, NamingService,
    ParseMode, ParseRunner, ParseService, ParsedScenes, QuestionPermits, RoomSearch, SceneLookup,
    SceneService, ServiceLocks, StatsService, Transcripts, UploadService, Vlm, WebhookService,
};
use camino::Utf8PathBuf;
use rayon::ThreadPool;
use std::io;
use std::sync::Arc;
use tokio::sync::{Mutex, Semaphore};
use uniground_endpoints::inference::Probe;
use uniground_geometry::background;
use uniground_grounding::PictureCache;
use uniground_isolation::ScanReader;
use uniground_jobs::Jobs;
use uniground_models::neural::{LoadedModel, Models};
use uniground_storage::Store;

/// The dependencies of the services.
pub struct Dependencies {
    pub store: Store,
    pub jobs: Jobs,
    pub keyring: Keyring,
    pub limits: Limits,
    /// The vision-language model, if one is configured.
    pub vlm: Option<Vlm>,
    pub models: Models,
    /// Parses compute in a pool of their own, whose threads have a low priority. Questions use
    /// rayon's global pool.
    pub parse_pool: ThreadPool,
    /// Full parses after drafts have a second one, so that drafts of other scenes get their share.
    pub full_parse_pool: ThreadPool,
    pub parse_mode: ParseMode,
    /// Decodes uploads.
    pub reader: ScanReader,
    /// Scans below this folder may be imported. `None` disables imports.
    pub import_root: Option<Utf8PathBuf>,
    /// The probe of the inference server, if one runs the networks.
    pub inference: Option<Probe>,
    /// Describes to the caller why an upload was rejected.
    pub explain: Explain,
}

impl Dependencies {
    /// Returns the dependencies for offline work on a store that no server uses: no models, no
    /// imports, and uploads decoded in this process.
    ///
    /// # Errors
    /// [`Error::Store`]; [`Error::Io`] if the system cannot start more threads.
    pub async fn offline(store: Store, limits: Limits) -> Result<Self, Error> {
        Ok(Self {
            jobs: Jobs::new(store.jobs.clone(), 0),
            keyring: Keyring::open(&store, None).await?,
            store,
            limits,
            vlm: None,
            models: Models::default(),
            parse_pool: background::low_priority_pool()
                .map_err(|error| Error::Io(io::Error::other(error)))?,
            full_parse_pool: background::low_priority_pool()
                .map_err(|error| Error::Io(io::Error::other(error)))?,
            parse_mode: ParseMode::default(),
            reader: ScanReader::in_process(),
            import_root: None,
            inference: None,
            explain: default_problem,
        })
    }
}

/// The use cases, one service per noun of the API. Cheap to clone.
#[derive(Clone)]
pub struct Services {
    pub keyring: Keyring,
    pub jobs: Jobs,
    pub answers: Arc<AnswerService>,
    pub approach: Arc<ApproachService>,
    pub batch_runner: Arc<BatchRunner>,
    pub batches: Arc<BatchService>,
    pub changes: Arc<ChangeService>,
    pub corrections: Arc<CorrectionService>,
    pub doctor: Arc<DoctorService>,
    pub exports: Arc<ExportService>,
    pub grounding: Arc<GroundingService>,
    pub growth: Arc<GrowthService>,
    pub health: Arc<HealthService>,
    pub imports: Arc<ImportService>,
    pub instances: Arc<InstanceService>,
    pub maintenance: Arc<MaintenanceService>,
    pub media: Arc<MediaService>,
    pub naming: Arc<NamingService>,
    pub parse_runner: Arc<ParseRunner>,
    pub parsed_scenes: Arc<ParsedScenes>,
    pub parses: Arc<ParseService>,
    pub rooms: Arc<RoomSearch>,
    pub scene_lookup: Arc<SceneLookup>,
    pub scenes: Arc<SceneService>,
    pub stats: Arc<StatsService>,
    pub transcripts: Arc<Transcripts>,
    pub uploads: Arc<UploadService>,
    pub webhooks: Arc<WebhookService>,
    vlm: Option<Arc<Vlm>>,
    models: Models,
}

impl Services {
    /// Builds every service. Calls are counted in the metrics of `jobs`.
    #[must_use]
    #[expect(clippy::too_many_lines, reason = "one line for each dependency of each service")]
    pub fn new(dependencies: Dependencies) -> Self {
        let Dependencies {
            store,
            jobs,
            keyring,
            limits,
            vlm,
            models,
            parse_pool,
            full_parse_pool,
            parse_mode,
            reader,
            import_root,
            inference,
            explain,
        } = dependencies;
        let metrics = jobs.metrics().clone();
        let keyring = keyring.with_metrics(metrics.clone());
        let (vlm, parse_pool, full_parse_pool) =
            (vlm.map(Arc::new), Arc::new(parse_pool), Arc::new(full_parse_pool));
        let inference = inference.map(Arc::new);
        let permits = Arc::new(Semaphore::new(limits.max_concurrent_questions));
        let scan_permits = Arc::new(Semaphore::new(MAX_CONCURRENT_SCENE_SCANS));
        let upload_permits = Arc::new(Semaphore::new(MAX_UPLOADS));
        let comparison_permits = Arc::new(Semaphore::new(MAX_COMPARISONS));
        let (growth_lock, drawing_lock) = (Arc::new(Mutex::new(())), Arc::new(Mutex::new(())));
        let (parse_cache, picture_cache) =
            (Arc::<ParseCache>::default(), Arc::<PictureCache>::default());
        let room_names = Arc::<RoomNames>::default();
        let (last_health, figures) = (SingleFlightCache::default(), FigureCache::default());
        let transcripts = Arc::new(Transcripts {
            blobs: store.blobs.clone(),
            limits,
            answer_repository: store.answers.clone(),
        });
        let service_locks = Arc::new(ServiceLocks { named_locks: store.locks.clone() });
        let question_permits = QuestionPermits { permits: permits.clone() };
        let parsed_scenes = Arc::new(ParsedScenes {
            blobs: store.blobs.clone(),
            name_repository: store.names.clone(),
            vlm: vlm.clone(),
            parse_repository: store.parses.clone(),
            models: models.clone(),
            scene_repository: store.scenes.clone(),
            jobs: jobs.clone(),
            parse_cache: parse_cache.clone(),
            correction_repository: store.corrections.clone(),
            picture_cache: picture_cache.clone(),
            service_locks: service_locks.clone(),
            question_permits: question_permits.clone(),
        });
        let scene_lookup = Arc::new(SceneLookup {
            service_locks: service_locks.clone(),
            scene_repository: store.scenes.clone(),
            jobs: jobs.clone(),
            parse_repository: store.parses.clone(),
            models: models.clone(),
        });
        let answer_service = Arc::new(AnswerService {
            answer_repository: store.answers.clone(),
            transcripts: transcripts.clone(),
            parsed_scenes: parsed_scenes.clone(),
            scene_lookup: scene_lookup.clone(),
        });
        let room_search = Arc::new(RoomSearch {
            room_index_repository: store.room_index.clone(),
            parse_repository: store.parses.clone(),
            service_locks: service_locks.clone(),
            parsed_scenes: parsed_scenes.clone(),
            scene_repository: store.scenes.clone(),
            question_permits: question_permits.clone(),
            room_names: room_names.clone(),
            models: models.clone(),
        });
        let naming_service = Arc::new(NamingService {
            vlm: vlm.clone(),
            scene_lookup: scene_lookup.clone(),
            jobs: jobs.clone(),
            name_repository: store.names.clone(),
            job_repository: store.jobs.clone(),
            keyring: keyring.clone(),
            parsed_scenes: parsed_scenes.clone(),
        });
        let grounding_service = Arc::new(GroundingService {
            keyring: keyring.clone(),
            scene_repository: store.scenes.clone(),
            room_search: room_search.clone(),
            scene_lookup: scene_lookup.clone(),
            ids: store.ids.clone(),
            scan_permits: scan_permits.clone(),
            parsed_scenes: parsed_scenes.clone(),
            metrics: metrics.clone(),
            blobs: store.blobs.clone(),
            naming_service: naming_service.clone(),
            vlm: vlm.clone(),
            answer_repository: store.answers.clone(),
            transcripts: transcripts.clone(),
            limits,
            service_locks: service_locks.clone(),
        });
        let approach_service = Arc::new(ApproachService {
            scene_lookup: scene_lookup.clone(),
            parsed_scenes: parsed_scenes.clone(),
            grounding_service: grounding_service.clone(),
        });
        let capacity = Arc::new(Capacity { health_probe: store.health.clone(), limits });
        let batch_runner = Arc::new(BatchRunner {
            metrics: metrics.clone(),
            batch_repository: store.batches.clone(),
            keyring: keyring.clone(),
            capacity: capacity.clone(),
            answer_repository: store.answers.clone(),
            vlm: vlm.clone(),
            grounding_service: grounding_service.clone(),
        });
        let batch_service = Arc::new(BatchService {
            batch_repository: store.batches.clone(),
            jobs: jobs.clone(),
            capacity: capacity.clone(),
        });
        let change_service = Arc::new(ChangeService {
            scene_repository: store.scenes.clone(),
            scene_lookup: scene_lookup.clone(),
            comparison_permits: comparison_permits.clone(),
            parsed_scenes: parsed_scenes.clone(),
        });
        let correction_service = Arc::new(CorrectionService {
            correction_repository: store.corrections.clone(),
            scene_lookup: scene_lookup.clone(),
            parsed_scenes: parsed_scenes.clone(),
            parse_repository: store.parses.clone(),
        });
        let parse_service = Arc::new(ParseService {
            models: models.clone(),
            parse_mode,
            scene_repository: store.scenes.clone(),
            scene_lookup: scene_lookup.clone(),
            service_locks: service_locks.clone(),
            capacity: capacity.clone(),
            jobs: jobs.clone(),
            parsed_scenes: parsed_scenes.clone(),
            job_repository: store.jobs.clone(),
            blobs: store.blobs.clone(),
        });
        let doctor_service = Arc::new(DoctorService {
            integrity_repository: store.integrity.clone(),
            content_repository: store.contents.clone(),
            blobs: store.blobs.clone(),
            parse_repository: store.parses.clone(),
            orphan_repository: store.orphans.clone(),
            job_repository: store.jobs.clone(),
            parsed_scenes: parsed_scenes.clone(),
            parse_service: parse_service.clone(),
        });
        let media_service = Arc::new(MediaService {
            scene_lookup: scene_lookup.clone(),
            parsed_scenes: parsed_scenes.clone(),
            parse_cache: parse_cache.clone(),
            drawing_lock: drawing_lock.clone(),
            blobs: store.blobs.clone(),
        });
        let instance_service = Arc::new(InstanceService {
            scene_lookup: scene_lookup.clone(),
            parsed_scenes: parsed_scenes.clone(),
            question_permits: question_permits.clone(),
            media_service: media_service.clone(),
        });
        let export_service = Arc::new(ExportService {
            scene_lookup: scene_lookup.clone(),
            parsed_scenes: parsed_scenes.clone(),
            instance_service: instance_service.clone(),
            media_service: media_service.clone(),
        });
        let import_service = Arc::new(ImportService {
            import_root: import_root.clone(),
            scene_repository: store.scenes.clone(),
            upload_permits: upload_permits.clone(),
            capacity: capacity.clone(),
            jobs: jobs.clone(),
            blobs: store.blobs.clone(),
            ids: store.ids.clone(),
            service_locks: service_locks.clone(),
            parse_service: parse_service.clone(),
            scene_lookup: scene_lookup.clone(),
            key_repository: store.keys.clone(),
            content_repository: store.contents.clone(),
            limits,
            reader: reader.clone(),
        });
        let growth_service = Arc::new(GrowthService {
            scene_repository: store.scenes.clone(),
            blobs: store.blobs.clone(),
            parse_repository: store.parses.clone(),
            upload_permits: upload_permits.clone(),
            scene_lookup: scene_lookup.clone(),
            parsed_scenes: parsed_scenes.clone(),
            capacity: capacity.clone(),
            jobs: jobs.clone(),
            import_service: import_service.clone(),
            growth_lock: growth_lock.clone(),
            service_locks: service_locks.clone(),
            parse_service: parse_service.clone(),
            reader: reader.clone(),
            limits,
        });
        let health_service = Arc::new(HealthService {
            last_health: last_health.clone(),
            health_probe: store.health.clone(),
            inference: inference.clone(),
            jobs: jobs.clone(),
            vlm: vlm.clone(),
        });
        let maintenance_service = Arc::new(MaintenanceService {
            parse_cache: parse_cache.clone(),
            recovery: store.recovery.clone(),
            blobs: store.blobs.clone(),
            orphan_repository: store.orphans.clone(),
            room_index_repository: store.room_index.clone(),
            parse_repository: store.parses.clone(),
            service_locks: service_locks.clone(),
            parsed_scenes: parsed_scenes.clone(),
            reserve: store.reserve.clone(),
            limits,
            retention_repository: store.retention.clone(),
            content_repository: store.contents.clone(),
        });
        let parse_runner = Arc::new(ParseRunner {
            blobs: store.blobs.clone(),
            parse_repository: store.parses.clone(),
            correction_repository: store.corrections.clone(),
            parsed_scenes: parsed_scenes.clone(),
            health_probe: store.health.clone(),
            ids: store.ids.clone(),
            scene_repository: store.scenes.clone(),
            scene_lookup: scene_lookup.clone(),
            models: models.clone(),
            parse_pool: parse_pool.clone(),
            full_parse_pool: full_parse_pool.clone(),
            jobs: jobs.clone(),
            capacity: capacity.clone(),
            metrics: metrics.clone(),
            reader: reader.clone(),
            service_locks: service_locks.clone(),
        });
        let scene_service = Arc::new(SceneService {
            scene_repository: store.scenes.clone(),
            scene_lookup: scene_lookup.clone(),
            reserve: store.reserve.clone(),
            answer_repository: store.answers.clone(),
            orphan_repository: store.orphans.clone(),
            jobs: jobs.clone(),
            transcripts: transcripts.clone(),
            service_locks: service_locks.clone(),
        });
        let stats_service = Arc::new(StatsService {
            figures: figures.clone(),
            metrics: metrics.clone(),
            vlm: vlm.clone(),
            limits,
            health_service: health_service.clone(),
            permits: permits.clone(),
            upload_permits: upload_permits.clone(),
            parse_cache: parse_cache.clone(),
            picture_cache: picture_cache.clone(),
            statistics_repository: store.statistics.clone(),
            blobs: store.blobs.clone(),
            spending_repository: store.spending.clone(),
            jobs: jobs.clone(),
        });
        let upload_service = Arc::new(UploadService {
            upload_repository: store.uploads.clone(),
            service_locks: service_locks.clone(),
            keyring: keyring.clone(),
            explain,
            blobs: store.blobs.clone(),
            scene_repository: store.scenes.clone(),
            capacity: capacity.clone(),
            import_service: import_service.clone(),
            limits,
            jobs: jobs.clone(),
            upload_permits: upload_permits.clone(),
        });
        let webhook_service = Arc::new(WebhookService {
            webhook_repository: store.webhooks.clone(),
            service_locks: service_locks.clone(),
            named_locks: store.locks.clone(),
            jobs: jobs.clone(),
            batch_service: batch_service.clone(),
        });
        Self {
            answers: answer_service,
            approach: approach_service,
            batch_runner,
            batches: batch_service,
            changes: change_service,
            corrections: correction_service,
            doctor: doctor_service,
            exports: export_service,
            grounding: grounding_service,
            growth: growth_service,
            health: health_service,
            imports: import_service,
            instances: instance_service,
            maintenance: maintenance_service,
            media: media_service,
            naming: naming_service,
            parse_runner,
            parsed_scenes,
            parses: parse_service,
            rooms: room_search,
            scene_lookup,
            scenes: scene_service,
            stats: stats_service,
            transcripts,
            uploads: upload_service,
            webhooks: webhook_service,
            keyring,
            jobs,
            vlm,
            models,
        }
    }

    /// Returns the neural models that this server was started with.
    #[must_use]
    pub fn loaded_models(&self) -> &[LoadedModel] {
        &self.models.loaded
    }

    /// Returns the vision-language model, if one is configured.
    #[must_use]
    pub fn vlm(&self) -> Option<&Vlm> {
        self.vlm.as_deref()
    }

    /// Returns the name of the vision-language model.
    #[must_use]
    pub fn vlm_model(&self) -> Option<&str> {
        self.vlm.as_ref().map(|vlm| vlm.name())
    }
}
