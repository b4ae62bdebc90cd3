//! Runs the pipelines in this process, without a server or a store.

use super::oracle::{NamedBy, choose_views, embed_and_name, give_name, instances_of};
use super::seen_names::name_as_seen;
use super::{OpenScene, System};
use crate::annotations::Annotations;
use crate::configuration::{Configuration, Names, Source};
use crate::digest;
use crate::reply::{Reply, SHORTLIST_DEPTH};
use crate::sealed::OracleRun;
use crate::suite::{Expression, Hints, SuiteScene};
use anyhow::{Context, ensure};
use camino::{Utf8Path, Utf8PathBuf};
use sha2::{Digest, Sha256};
use std::collections::HashMap;
use std::fs;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;
use tokio::runtime::Runtime;
use uniground_endpoints::chat::ChatClient;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{
    Embeddings, FrameEmbeddings, FrameRef, Instance, InstanceId, ParsedScene, PointCloud,
};
use uniground_grounding::memory_scene::{MemoryScene, SceneAlbum};
use uniground_grounding::pipeline::{self, Answered, Ask, Review, WithoutModel, shortlist_of};
use uniground_grounding::vlm::{Options, PictureLimits, PointForm};
use uniground_grounding::{Question, ShortlistScoring};
use uniground_ingest::ScanFolder;
use uniground_language::{AutoParser, BuiltinParser, QueryParser, VlmParser};
use uniground_models::attributes;
use uniground_models::chat::{Budget, ChatModel, total_usage};
use uniground_models::neural::{Models as NeuralModels, Role};
use uniground_parsing::checkpoints::Checkpoints;
use uniground_parsing::masks::is_builtin;
use uniground_parsing::scan::{ParsedScan, parse_scan};
use uniground_render::RenderScene;
use uniground_types::answer::Models;
use uniground_types::question::{ParserChoice, ReasonerChoice};
use uniground_types::settings::{ImportSettings, LevellingChoice, ParseSettings};

/// How a run uses a model.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ModelUse {
    /// Maximum cost of the whole run, US dollars.
    pub max_usd: Option<f64>,
    /// Whether to request JSON with a schema.
    pub json: bool,
    /// How the model gives places in pictures.
    pub points: PointForm,
    /// What the model accepts in one request.
    pub limits: PictureLimits,
}

/// Loads the networks of a mask source and an encoder, given their names.
pub type ModelLoader = Box<dyn Fn(&str, &str) -> anyhow::Result<NeuralModels> + Send + Sync>;

/// The system in this executable.
pub struct InProcess {
    fingerprint: String,
    /// Digest of the executable's bytes.
    program: String,
    /// Folder where finished stages of parses are stored for later runs.
    parses: Option<Utf8PathBuf>,
    vlm: Option<Arc<Reviewer>>,
    load_models: ModelLoader,
    /// Loaded models, by the names of masks and encoder.
    loaded: Mutex<HashMap<(String, String), NeuralModels>>,
}

struct LocalScene {
    instances: Arc<[Instance]>,
    boxes: Vec<Aabb>,
    /// Source of the instances.
    masks: String,
    album: Arc<SceneAlbum>,
    /// The folder of the photographs. A temporary folder is removed on drop.
    _folder: Option<ScanFolder>,
    vlm: Option<Arc<Reviewer>>,
}

impl InProcess {
    /// Creates the system. `models` names the folder of model bundles and `load_models` loads from
    /// it. `recorded` is the place where the model's answers are recorded, if any. `usage` is how
    /// the model is used.
    ///
    /// # Errors
    /// Returns an error when the executable cannot be read: its bytes identify the answers.
    pub fn new(
        models: &Utf8Path,
        load_models: ModelLoader,
        vlm: Option<ChatClient>,
        recorded: Option<&Utf8Path>,
        usage: ModelUse,
    ) -> anyhow::Result<Self> {
        let executable = std::env::current_exe()?;
        let bytes = fs::read(&executable).with_context(|| executable.display().to_string())?;
        let program = digest::short_digest(&bytes);
        // Answers without this record are not part of it, so its path is part of the fingerprint.
        let fingerprint = format!(
            "{program} {models} {} {}",
            vlm.as_ref().map_or("", |client| client.name()),
            recorded.map_or("", Utf8Path::as_str)
        );
        let vlm = vlm.map(|client| Reviewer::new(client, usage)).transpose()?.map(Arc::new);
        Ok(Self { fingerprint, program, parses: None, vlm, load_models, loaded: Mutex::default() })
    }

    /// Stores finished stages of parses below a folder. Later runs with other questions, models or
    /// settings of stage 2 reuse them. They are only valid for this executable.
    #[must_use]
    pub fn with_parse_cache(self, folder: &Utf8Path) -> Self {
        Self { parses: Some(folder.to_owned()), ..self }
    }

    /// Returns the stored stages of one scan's parses.
    fn checkpoints(&self, scan: &Utf8Path, import: &ImportSettings) -> anyhow::Result<Checkpoints> {
        let Some(parses) = &self.parses else { return Ok(Checkpoints::disabled()) };
        let mut hasher = Sha256::new();
        digest::add_path(scan, &mut hasher).with_context(|| scan.to_string())?;
        let content = digest::short_hex(hasher);
        let own = parses.join(&self.program);
        let folder = own.join(&content);
        fs::create_dir_all(&folder).with_context(|| folder.to_string())?;
        // Stages of other builds cannot be reused.
        for entry in parses.read_dir_utf8()?.flatten().filter(|entry| entry.path() != own) {
            fs::remove_dir_all(entry.path()).with_context(|| entry.path().to_string())?;
        }
        Ok(Checkpoints::in_folder(&folder, &serde_json::to_string(&(content, import))?))
    }

    /// Returns the models of a configuration, loaded once.
    fn models(&self, configuration: &Configuration) -> anyhow::Result<NeuralModels> {
        let mut loaded = self.loaded.lock().unwrap_or_else(PoisonError::into_inner);
        let (masks, encoder) = (configuration.masks.clone(), configuration.encoder.clone());
        if let Some(models) = loaded.get(&(masks.clone(), encoder.clone())) {
            return Ok(models.clone());
        }
        let models = (self.load_models)(&masks, &encoder)?;
        loaded.insert((masks, encoder), models.clone());
        Ok(models)
    }
}

impl System for InProcess {
    fn name(&self) -> String {
        "in process".into()
    }

    fn fingerprint(&self) -> &str {
        &self.fingerprint
    }

    fn check_configuration(&self, configuration: &Configuration) -> anyhow::Result<()> {
        for (axis, wanted) in [
            ("parser=vlm", configuration.parser == ParserChoice::Vlm),
            ("reasoner=vlm", configuration.reasoner == ReasonerChoice::Vlm),
        ] {
            ensure!(
                !wanted || self.vlm.is_some(),
                "{axis}: no vision-language model is configured"
            );
        }
        // Checks before the run starts that the models exist and are complete.
        self.models(configuration).map(drop)
    }

    fn has_scene(&self, _: &str) -> bool {
        true // The fingerprint and the content cover everything that a reply depends on.
    }

    fn open_scene(
        &self,
        scene: &SuiteScene,
        configuration: &Configuration,
    ) -> anyhow::Result<Box<dyn OpenScene>> {
        let annotated =
            |permission| scene.annotations.as_ref().map(|sealed| sealed.as_instances(permission));
        let missing = |what: &str| format!("the scene {} has no {what}", scene.id);
        let models = self.models(configuration)?;
        let mut settings =
            ParseSettings::from_request(configuration.preset, configuration.settings.clone())?;
        // The annotations are in the world of the files.
        settings.import.levelling = LevellingChoice::Off;
        // The scene is prepared once for all reasoners and parsers. If a model may decide, it needs
        // photographs.
        let with_views = self.vlm.is_some();
        let known = |annotations: &Annotations, names| {
            build_known_instances(annotations, scene, names, &models, &settings, with_views)
        };
        let OpenedScene {
            mut instances,
            cloud,
            extent,
            masks,
            embeddings,
            frame_embeddings,
            frames,
            folder,
        } = match configuration.source {
            Source::Parsed => {
                let scan = scene.scan.as_deref().with_context(|| missing("scan"))?;
                let folder = ScanFolder::open(scan)?;
                let ParsedScan { scene, models, frames, .. } = parse_scan(
                    &folder.path,
                    &settings,
                    &models,
                    &self.checkpoints(scan, &settings.import)?,
                    &Progress::silent(),
                )?;
                let ParsedScene { instances, cloud, extent, embeddings, frame_embeddings, .. } =
                    scene;
                OpenedScene {
                    instances,
                    cloud,
                    extent,
                    masks: models.masks,
                    embeddings,
                    frame_embeddings,
                    frames,
                    folder: Some(folder),
                }
            }
            Source::Oracle => known(
                annotated(OracleRun(())).with_context(|| missing("annotations"))?,
                NamedBy::Annotated,
            )?,
            Source::OracleBoxes => known(
                annotated(OracleRun(())).with_context(|| missing("annotations"))?,
                NamedBy::Encoder,
            )?,
            Source::Recorded => known(
                scene.recorded.as_ref().with_context(|| missing("recorded candidates"))?,
                NamedBy::Encoder,
            )?,
        };
        if configuration.names == Names::Seen {
            name_as_seen(
                &mut instances,
                annotated(OracleRun(())).with_context(|| missing("annotations"))?,
            );
        }
        let encoder = models
            .label(Role::Encoder)
            .filter(|_| embeddings.is_some())
            .unwrap_or_else(|| attributes::NAME.into());
        let album = SceneAlbum::new(
            extent,
            RenderScene::with_building(cloud, &instances),
            models.encoder.zip(embeddings),
            encoder,
            frames,
        )
        .with_builtin_masks(is_builtin(&masks))
        .with_segmenter(models.segmenters.first().cloned())
        .with_frame_embeddings(frame_embeddings);
        Ok(Box::new(LocalScene {
            boxes: instances.iter().map(|i| i.aabb).collect(),
            instances: instances.into(),
            masks,
            album: Arc::new(album),
            _folder: folder,
            vlm: self.vlm.clone(),
        }))
    }
}

/// A prepared scene, independent of the source of its instances.
struct OpenedScene {
    instances: Vec<Instance>,
    cloud: PointCloud,
    extent: Aabb,
    masks: String,
    embeddings: Option<Embeddings>,
    /// Embeddings of photographs that may show objects that are not instances. `None` where
    /// everything is annotated.
    frame_embeddings: Option<FrameEmbeddings>,
    frames: Vec<FrameRef>,
    /// The folder of the frames.
    folder: Option<ScanFolder>,
}

/// Builds instances from known boxes, with the scan's cloud if there is one, and with an encoder's
/// embeddings and names.
fn build_known_instances(
    known: &Annotations,
    scene: &SuiteScene,
    names: NamedBy,
    models: &NeuralModels,
    settings: &ParseSettings,
    with_views: bool,
) -> anyhow::Result<OpenedScene> {
    let folder = scene.scan.as_deref().map(ScanFolder::open).transpose()?;
    let bundle = match &folder {
        Some(folder) => Some(uniground_ingest::load(
            &uniground_ingest::open(&folder.path)?,
            &settings.import,
            &Progress::silent(),
        )?),
        None => None,
    };
    let (cloud, frames) =
        bundle.map_or_else(Default::default, |bundle| (bundle.cloud, bundle.frames));
    let corners: Vec<_> = known.objects.iter().flat_map(|o| o.aabb.corners()).collect();
    let extent = Aabb::around(cloud.positions.iter().chain(&corners))
        .with_context(|| format!("the scene {} is empty", scene.id))?;
    let mut instances = instances_of(known, &cloud, names);
    let embeddings = match &models.encoder {
        Some(encoder) if names == NamedBy::Encoder => Some(embed_and_name(
            known,
            &mut instances,
            &cloud,
            &frames,
            encoder,
            &settings.parsing,
        )?),
        _ => None,
    };
    if with_views {
        choose_views(known, &mut instances, &cloud, &frames, &settings.parsing)?;
    }
    Ok(OpenedScene {
        instances,
        cloud,
        extent,
        masks: "none".into(),
        embeddings,
        frame_embeddings: None,
        frames,
        folder,
    })
}

impl OpenScene for LocalScene {
    fn ask(
        &self,
        expression: &Expression,
        configuration: &Configuration,
        hints: Option<&Hints>,
    ) -> anyhow::Result<Reply> {
        // In a paper-compatible run, annotated anchors are added to the scene.
        let instances = match hints.filter(|h| !h.anchors.is_empty()) {
            Some(hints) => self.with_anchors(&hints.anchors).into(),
            None => self.instances.clone(),
        };
        let question = Question {
            query: expression.query.clone(),
            top_k: configuration.evidence.candidate_limit(configuration.top_k) as usize,
            convention: configuration.convention,
            observer: None,
            target_name: hints.and_then(|hints| hints.target_name.clone()),
            candidates: configuration.candidates,
            query_text: configuration.query_text,
            min_confidence: 0.0,
            within: None,
            most_confidence: 1.0,
        };
        let source = self.album.scene(instances);
        let start = Instant::now();
        let answered = answer(&source, self.vlm.as_deref(), question, configuration)?;
        let latency_ms = start.elapsed().as_secs_f64() * 1e3;
        let Answered { grounding, parsed, parser, encoder, reasoner, calls, .. } = answered;
        let scoring = ShortlistScoring {
            from: configuration.candidates,
            query_text: configuration.query_text,
            calibrated: false,
        };
        let shortlist = shortlist_of(
            source.as_ref(),
            &expression.query,
            &parsed,
            scoring,
            false,
            SHORTLIST_DEPTH as usize,
        )?;
        Ok(Reply {
            status: grounding.status,
            answer: grounding.answer,
            aabb: grounding.aabb,
            oriented_box: grounding.oriented_box,
            confidence: grounding.confidence,
            candidates: grounding.candidates,
            shortlist: shortlist.candidates.iter().map(|c| c.aabb).collect(),
            models: Models { masks: self.masks.clone(), encoder, parser, names: None, reasoner },
            usage: total_usage(&calls),
            latency_ms,
        })
    }

    fn boxes(&self) -> &[Aabb] {
        &self.boxes
    }

    fn token(&self) -> &'static str {
        ""
    }

    fn render_scene(&self) -> &RenderScene {
        &self.album.render_scene
    }
}

impl LocalScene {
    fn with_anchors(&self, anchors: &[(String, Aabb)]) -> Vec<Instance> {
        let mut instances = self.instances.to_vec();
        let objects = Annotations::from_boxes(anchors);
        for mut anchor in instances_of(&objects, &PointCloud::default(), NamedBy::Annotated) {
            let name = anchor.given_name.take().unwrap_or_default();
            anchor.id = InstanceId(instances.len() as u32 + 1);
            give_name(&mut anchor, &name);
            instances.push(anchor);
        }
        instances
    }
}

/// Runs the question pipeline with a configuration. A failed model call is not an answer of the
/// configuration: it is reported, counted as wrong, and repeated in the next run.
fn answer(
    source: &Arc<MemoryScene>,
    vlm: Option<&Reviewer>,
    question: Question,
    configuration: &Configuration,
) -> anyhow::Result<Answered> {
    let model = vlm.map(|vlm| VlmParser { model: vlm.model.clone(), budgets: vlm.budgets.clone() });
    let parser: Arc<dyn QueryParser> =
        match (configuration.parser.resolve_for(configuration.reasoner), model) {
            (ParserChoice::Vlm, Some(model)) => Arc::new(model),
            (ParserChoice::Auto, Some(model)) => Arc::new(AutoParser(model)),
            (ParserChoice::Builtin, _) | (_, None) => Arc::new(BuiltinParser),
        };
    let review =
        vlm.filter(|_| configuration.reasoner != ReasonerChoice::Builtin).map(|vlm| Review {
            model: vlm.model.clone(),
            budgets: vlm.budgets.clone(),
            options: Options {
                ablation: configuration.ablation,
                evidence: configuration.evidence,
                prompt: configuration.prompt,
                json: vlm.json,
                points: vlm.points,
                limits: vlm.limits,
            },
            without_model: WithoutModel::Fail,
        });
    let ask = Ask {
        question,
        parser,
        without_parser: WithoutModel::Fail,
        allow_builtin_encoder: false,
        review,
    };
    let answered = pipeline::answer(source, ask);
    match vlm {
        Some(vlm) => vlm.runtime.block_on(answered),
        // Without a model, the future never waits.
        None => futures::executor::block_on(answered),
    }
    .context("the question was not answered")
}

/// A vision-language model, its budget in this run, and an async runtime, because evaluation runs
/// on threads without one.
struct Reviewer {
    model: Arc<dyn ChatModel>,
    budgets: Vec<Budget>,
    json: bool,
    points: PointForm,
    limits: PictureLimits,
    runtime: Runtime,
}

impl Reviewer {
    fn new(
        client: ChatClient,
        ModelUse { max_usd, json, points, limits }: ModelUse,
    ) -> anyhow::Result<Self> {
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
        let budgets = max_usd.map(|usd| Budget::new("this run", usd)).into_iter().collect();
        Ok(Self { model: Arc::new(client), budgets, json, points, limits, runtime })
    }
}
