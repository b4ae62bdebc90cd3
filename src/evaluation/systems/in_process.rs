//! The pipelines themselves, without a server or a store.

use super::asker::{Album, Asker, Room};
use super::oracle::{Names, give_name, instances_of, see, view};
use super::{OpenScene, System};
use crate::config::{BundlesConfig, ModelsConfig};
use crate::evaluation::annotations::Annotations;
use crate::evaluation::configuration::{Configuration, Source};
use crate::evaluation::digest;
use crate::evaluation::reply::{Reply, SHORTLIST_DEPTH};
use crate::evaluation::sealed::OracleRun;
use crate::evaluation::suite::{Expression, Hints, SuiteScene};
use crate::geometry::boxes::Aabb;
use crate::grounding::query::{self, BuiltinParser, QueryParser};
use crate::grounding::{self, Appearance, Question, SceneView, ShortlistScoring};
use crate::ingest::{self, Unpacked};
use crate::models::attributes;
use crate::models::chat::ChatClient;
use crate::models::neural::{DualEncoder, Models as NeuralModels, Role};
use crate::progress::Progress;
use crate::render::Scenery;
use crate::scene::{Embeddings, Instance, InstanceId, ParsedScene, PointCloud};
use crate::scene_parsing::checkpoints::Checkpoints;
use crate::service::{self, Models, ParseSettings, ParsedScan, ParserChoice, ReasonerChoice, Usage, parse_scan};
use anyhow::{Context, ensure};
use camino::Utf8Path;
use std::collections::HashMap;
use std::fs;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

/// How a model is asked in a run.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ModelUse {
    /// Most the whole run may cost, US dollars.
    pub max_usd: Option<f64>,
    /// Ask for JSON by a schema.
    pub json: bool,
}

/// The system of this executable.
pub struct InProcess {
    fingerprint: String,
    vlm: Option<Arc<Asker>>,
    bundles: BundlesConfig,
    /// Loaded models by the names of masks and encoder.
    loaded: Mutex<HashMap<(String, String), NeuralModels>>,
}

struct LocalScene {
    instances: Vec<Instance>,
    boxes: Vec<Aabb>,
    extent: Aabb,
    scenery: Scenery,
    models: Models,
    /// Where an encoder has seen the scene.
    seen: Option<(Arc<DualEncoder>, Embeddings)>,
    album: Album,
    vlm: Option<Arc<Asker>>,
}

impl InProcess {
    /// `tape` is where the model's answers are recorded, if they are; `usage` is how it is asked.
    ///
    /// # Errors
    /// When the executable can not be read: what it would answer is known by its bytes.
    pub fn new(bundles: BundlesConfig, vlm: Option<ChatClient>, tape: Option<&Utf8Path>, usage: ModelUse) -> anyhow::Result<Self> {
        let executable = std::env::current_exe()?;
        let bytes = fs::read(&executable).with_context(|| executable.display().to_string())?;
        let program = digest::of(&bytes);
        // What was answered off this tape is not on it.
        let fingerprint = format!(
            "{program} {} {} {}",
            bundles.models,
            vlm.as_ref().map_or("", |client| client.model()),
            tape.map_or("", Utf8Path::as_str)
        );
        let vlm = vlm.map(|client| Asker::new(client, usage.max_usd, usage.json)).transpose()?.map(Arc::new);
        Ok(Self { fingerprint, vlm, bundles, loaded: Mutex::default() })
    }

    /// The models a configuration asks for, loaded once.
    fn models(&self, configuration: &Configuration) -> anyhow::Result<NeuralModels> {
        let mut loaded = self.loaded.lock().unwrap_or_else(PoisonError::into_inner);
        let (masks, encoder) = (configuration.masks.clone(), configuration.encoder.clone());
        if let Some(models) = loaded.get(&(masks.clone(), encoder.clone())) {
            return Ok(models.clone());
        }
        let config = ModelsConfig { masks: masks.clone(), encoder: encoder.clone(), bundles: self.bundles.clone() };
        let models = config.load()?;
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

    fn accepts(&self, configuration: &Configuration) -> anyhow::Result<()> {
        for (axis, wanted) in
            [("parser=vlm", configuration.parser == ParserChoice::Vlm), ("reasoner=vlm", configuration.reasoner == ReasonerChoice::Vlm)]
        {
            ensure!(!wanted || self.vlm.is_some(), "{axis}: no vision-language model is configured");
        }
        // Before anything runs: whether the models are there and whole.
        self.models(configuration).map(drop)
    }

    fn still_has(&self, _: &str) -> bool {
        true // Everything a reply depends on is in the fingerprint and the content.
    }

    fn enter(&self, scene: &SuiteScene, configuration: &Configuration) -> anyhow::Result<Box<dyn OpenScene>> {
        let annotated = |permission| scene.annotations.as_ref().map(|sealed| sealed.as_instances(permission));
        let missing = |what: &str| format!("the scene {} has no {what}", scene.id);
        let models = self.models(configuration)?;
        let settings = ParseSettings::from_request(configuration.preset, None)?;
        // The scene is brought in once for all reasoners and parsers: where a model may decide, it needs photographs.
        let with_views = self.vlm.is_some();
        let known = |annotations: &Annotations, names| boxed(annotations, scene, names, &models, &settings, with_views);
        let Entered { instances, cloud, extent, masks, embeddings, album } = match configuration.source {
            Source::Parsed => {
                let scan = scene.scan.as_deref().with_context(|| missing("scan"))?;
                let folder = Unpacked::of(scan)?;
                let ParsedScan { scene, models, frames, .. } =
                    parse_scan(&folder.path, &settings, &models, &Checkpoints::none(), &Progress::silent())?;
                let ParsedScene { instances, cloud, extent, embeddings, .. } = scene;
                Entered { instances, cloud, extent, masks: models.masks, embeddings, album: Album::new(frames, Some(folder)) }
            }
            Source::Oracle => known(annotated(OracleRun(())).with_context(|| missing("annotations"))?, Names::Annotated)?,
            Source::OracleBoxes => known(annotated(OracleRun(())).with_context(|| missing("annotations"))?, Names::Encoder)?,
            Source::Recorded => known(scene.recorded.as_ref().with_context(|| missing("recorded candidates"))?, Names::Encoder)?,
        };
        let encoder = models
            .label(Role::Encoder)
            .filter(|_| embeddings.is_some())
            .unwrap_or_else(|| attributes::NAME.into());
        let seen = models.encoder.zip(embeddings);
        let models = Models { masks, encoder, parser: BuiltinParser.name(), reasoner: service::BUILTIN_REASONER.into() };
        let boxes = instances.iter().map(|i| i.aabb).collect();
        Ok(Box::new(LocalScene {
            instances,
            boxes,
            extent,
            scenery: Scenery::of(cloud),
            models,
            seen,
            album,
            vlm: self.vlm.clone(),
        }))
    }
}

/// A scene as it comes in, whatever its instances come from.
struct Entered {
    instances: Vec<Instance>,
    cloud: PointCloud,
    extent: Aabb,
    masks: String,
    embeddings: Option<Embeddings>,
    album: Album,
}

/// Instances from known boxes, with the scan's cloud where there is one, and what an encoder sees of them.
fn boxed(
    known: &Annotations,
    scene: &SuiteScene,
    names: Names,
    models: &NeuralModels,
    settings: &ParseSettings,
    with_views: bool,
) -> anyhow::Result<Entered> {
    let folder = scene.scan.as_deref().map(Unpacked::of).transpose()?;
    let bundle = match &folder {
        Some(folder) => Some(ingest::load(&ingest::open(&folder.path)?, &settings.import, &Progress::silent())?),
        None => None,
    };
    let (cloud, frames) = bundle.map_or_else(Default::default, |bundle| (bundle.cloud, bundle.frames));
    let corners: Vec<_> = known.objects.iter().flat_map(|o| o.aabb.corners()).collect();
    let extent = Aabb::around(cloud.positions.iter().chain(&corners)).with_context(|| format!("the scene {} is empty", scene.id))?;
    let mut instances = instances_of(known, &cloud, names);
    let embeddings = match &models.encoder {
        Some(encoder) if names == Names::Encoder => Some(see(known, &mut instances, &cloud, &frames, encoder, &settings.parsing)?),
        _ => None,
    };
    if with_views {
        view(known, &mut instances, &cloud, &frames, &settings.parsing)?;
    }
    Ok(Entered { instances, cloud, extent, masks: "none".into(), embeddings, album: Album::new(frames, folder) })
}

impl OpenScene for LocalScene {
    fn ask(&self, expression: &Expression, configuration: &Configuration, hints: Option<&Hints>) -> anyhow::Result<Reply> {
        // In a paper-compatible run annotated anchors join the scene.
        let with_anchors: Option<Vec<Instance>> = hints.filter(|h| !h.anchors.is_empty()).map(|hints| self.with(&hints.anchors));
        let instances = with_anchors.as_deref().unwrap_or(&self.instances);
        let question = Question {
            query: expression.query.clone(),
            top_k: configuration.top_k as usize,
            convention: configuration.convention,
            observer: None,
            target_name: hints.and_then(|hints| hints.target_name.clone()),
        };
        let start = Instant::now();
        let mut models = self.models.clone();
        let (parsed, mut calls) = match (&self.vlm, configuration.parser) {
            (Some(asker), ParserChoice::Vlm) => {
                models.parser = asker.parser_name();
                asker.read(&question.query)?
            }
            _ => (query::parse(&question.query), Vec::new()),
        };
        let reading = start.elapsed();
        let looks = |(encoder, embeddings): &(Arc<DualEncoder>, Embeddings)| {
            Appearance::of(&question.query, &parsed, encoder, embeddings, ShortlistScoring::default())
        };
        let appearance = self.seen.as_ref().map(looks).transpose()?;
        let view = SceneView { instances, extent: self.extent, appearance: appearance.as_ref() };
        let shortlist = grounding::shortlist(view, &parsed, SHORTLIST_DEPTH as usize);
        let grounding = match self.vlm.as_ref().filter(|_| configuration.reasoner != ReasonerChoice::Builtin) {
            None => grounding::ground_read(view, &question, parsed, reading),
            Some(asker) => {
                let (mut grounding, brief) = grounding::ground_and_brief(view, &question, parsed, reading);
                if !brief.candidates.is_empty() {
                    let room = Room { instances, scenery: &self.scenery, extent: self.extent, album: &self.album };
                    let (of_review, reasoner) = asker.review(&room, &brief, &mut grounding, configuration)?;
                    calls.extend(of_review);
                    models.reasoner = reasoner.unwrap_or(models.reasoner);
                }
                grounding
            }
        };
        let latency_ms = start.elapsed().as_secs_f64() * 1e3;
        Ok(Reply {
            status: grounding.status,
            answer: grounding.answer,
            aabb: grounding.aabb,
            oriented_box: grounding.oriented_box,
            confidence: grounding.confidence,
            candidates: grounding.candidates,
            shortlist: shortlist.iter().map(|c| c.aabb).collect(),
            models,
            usage: Usage::of(&calls),
            latency_ms,
        })
    }

    fn boxes(&self) -> &[Aabb] {
        &self.boxes
    }

    fn token(&self) -> &'static str {
        ""
    }

    fn scenery(&self) -> &Scenery {
        &self.scenery
    }
}

impl LocalScene {
    fn with(&self, anchors: &[(String, Aabb)]) -> Vec<Instance> {
        let mut instances = self.instances.clone();
        let objects = Annotations::named(anchors);
        for mut anchor in instances_of(&objects, &PointCloud::default(), Names::Annotated) {
            let name = anchor.given_name.take().unwrap_or_default();
            anchor.id = InstanceId(instances.len() as u32 + 1);
            give_name(&mut anchor, &name);
            instances.push(anchor);
        }
        instances
    }
}
