//! The pipelines themselves, without a server or a store.

use super::oracle::{Names, give_name, instances_of};
use super::{OpenScene, System};
use crate::evaluation::annotations::Annotations;
use crate::evaluation::configuration::{Configuration, Source};
use crate::evaluation::digest;
use crate::evaluation::reply::{Reply, SHORTLIST_DEPTH};
use crate::evaluation::sealed::OracleRun;
use crate::evaluation::suite::{Expression, Hints, SuiteScene};
use crate::geometry::boxes::Aabb;
use crate::grounding::query::{BuiltinParser, QueryParser, VlmParser};
use crate::grounding::{self, Question, SceneView};
use crate::ingest::{self, Unpacked};
use crate::models::attributes;
use crate::models::chat::ChatClient;
use crate::progress::Progress;
use crate::scene::{Instance, InstanceId, PointCloud};
use crate::scene_parsing::checkpoints::Checkpoints;
use crate::scene_parsing::masks::MaskSource;
use crate::scene_parsing::masks::rgbd::RgbdMasks;
use crate::service::{self, Models, ParseSettings, ParserChoice, ReasonerChoice, Usage, parse_scan};
use anyhow::{Context, bail, ensure};
use camino::Utf8Path;
use std::fs;
use std::sync::Arc;
use std::time::Instant;
use tokio::runtime::Runtime;

/// The system of this executable.
pub struct InProcess {
    fingerprint: String,
    vlm: Option<Arc<Asker>>,
}

/// A chat model, and the runtime to speak with it from threads that know of none.
struct Asker {
    parser: VlmParser,
    runtime: Runtime,
}

struct LocalScene {
    instances: Vec<Instance>,
    boxes: Vec<Aabb>,
    extent: Aabb,
    cloud: PointCloud,
    models: Models,
    vlm: Option<Arc<Asker>>,
}

impl InProcess {
    /// `tape` is where the model's answers are recorded, if they are.
    ///
    /// # Errors
    /// When the executable can not be read: what it would answer is known by its bytes.
    pub fn new(vlm: Option<ChatClient>, tape: Option<&Utf8Path>) -> anyhow::Result<Self> {
        let executable = std::env::current_exe()?;
        let bytes = fs::read(&executable).with_context(|| executable.display().to_string())?;
        let program = digest::of(&bytes);
        // What was answered off this tape is not on it.
        let fingerprint = format!("{program} {} {}", vlm.as_ref().map_or("", |client| client.model()), tape.map_or("", Utf8Path::as_str));
        let vlm = match vlm {
            Some(client) => {
                let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
                Some(Arc::new(Asker { parser: VlmParser { client: Arc::new(client) }, runtime }))
            }
            None => None,
        };
        Ok(Self { fingerprint, vlm })
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
        ensure!(configuration.reasoner != ReasonerChoice::Vlm, "reasoner=vlm: this version reasons with built-in parts only");
        ensure!(
            configuration.parser != ParserChoice::Vlm || self.vlm.is_some(),
            "parser=vlm: no vision-language model is configured"
        );
        Ok(())
    }

    fn still_has(&self, _: &str) -> bool {
        true // Everything a reply depends on is in the fingerprint and the content.
    }

    fn enter(&self, scene: &SuiteScene, configuration: &Configuration) -> anyhow::Result<Box<dyn OpenScene>> {
        let annotated = |permission| scene.annotations.as_ref().map(|sealed| sealed.as_instances(permission));
        let missing = |what: &str| format!("the scene {} has no {what}", scene.id);
        let (instances, cloud, extent, masks) = match configuration.source {
            Source::Parsed => {
                let scan = scene.scan.as_deref().with_context(|| missing("scan"))?;
                let folder = Unpacked::of(scan)?;
                let settings = ParseSettings::from_request(configuration.preset, None)?;
                let parsed = parse_scan(&folder.path, &settings, &Checkpoints::none(), &Progress::silent())?.scene;
                (parsed.instances, parsed.cloud, parsed.extent, RgbdMasks::default().name().to_owned())
            }
            Source::Oracle => {
                let annotations = annotated(OracleRun(())).with_context(|| missing("annotations"))?;
                boxed(annotations, scene, Names::Annotated)?
            }
            Source::OracleBoxes => {
                let annotations = annotated(OracleRun(())).with_context(|| missing("annotations"))?;
                boxed(annotations, scene, Names::Encoder)?
            }
            Source::Recorded => boxed(scene.recorded.as_ref().with_context(|| missing("recorded candidates"))?, scene, Names::Encoder)?,
        };
        let parser = match (&self.vlm, configuration.parser) {
            (Some(asker), ParserChoice::Vlm) => asker.parser.name(),
            _ => BuiltinParser.name(),
        };
        let models = Models { masks, encoder: attributes::NAME.into(), parser, reasoner: service::BUILTIN_REASONER.into() };
        let boxes = instances.iter().map(|i| i.aabb).collect();
        Ok(Box::new(LocalScene { instances, boxes, extent, cloud, models, vlm: self.vlm.clone() }))
    }
}

/// Instances from known boxes, with the scan's cloud where there is one.
fn boxed(known: &Annotations, scene: &SuiteScene, names: Names) -> anyhow::Result<(Vec<Instance>, PointCloud, Aabb, String)> {
    let cloud = match &scene.scan {
        Some(scan) => {
            let folder = Unpacked::of(scan)?;
            ingest::load(&ingest::open(&folder.path)?, &ParseSettings::default().import, &Progress::silent())?.cloud
        }
        None => PointCloud::default(),
    };
    let corners: Vec<_> = known.objects.iter().flat_map(|o| o.aabb.corners()).collect();
    let extent = Aabb::around(cloud.positions.iter().chain(&corners)).with_context(|| format!("the scene {} is empty", scene.id))?;
    Ok((instances_of(known, &cloud, names), cloud, extent, "none".into()))
}

impl OpenScene for LocalScene {
    fn ask(&self, expression: &Expression, configuration: &Configuration, hints: Option<&Hints>) -> anyhow::Result<Reply> {
        // In a paper-compatible run annotated anchors join the scene.
        let with_anchors: Option<Vec<Instance>> = hints.filter(|h| !h.anchors.is_empty()).map(|hints| self.with(&hints.anchors));
        let view = SceneView { instances: with_anchors.as_deref().unwrap_or(&self.instances), extent: self.extent };
        let question = Question {
            query: expression.query.clone(),
            top_k: configuration.top_k as usize,
            convention: configuration.convention,
            observer: None,
            target_name: hints.and_then(|hints| hints.target_name.clone()),
        };
        let start = Instant::now();
        let (grounding, usage) = match (&self.vlm, configuration.parser) {
            (Some(asker), ParserChoice::Vlm) => {
                let reading = asker.runtime.block_on(asker.parser.read(&question.query));
                let usage = Usage::of(&reading);
                // A call that failed is no answer of this configuration: it is told, counted as wrong, and asked again next time.
                if let Some(why) = reading.fell_back.filter(|_| usage.vlm_calls == 0) {
                    bail!("the model could not be asked: {why}");
                }
                (grounding::ground_read(view, &question, reading.parsed, start.elapsed()), usage)
            }
            _ => (grounding::ground(view, &question), Usage::default()),
        };
        let latency_ms = start.elapsed().as_secs_f64() * 1e3;
        let (_, shortlist) = grounding::shortlist(view, &question.query, SHORTLIST_DEPTH as usize);
        Ok(Reply {
            status: grounding.status,
            answer: grounding.answer,
            aabb: grounding.aabb,
            oriented_box: grounding.oriented_box,
            confidence: grounding.confidence,
            candidates: grounding.candidates,
            shortlist: shortlist.iter().map(|c| c.aabb).collect(),
            models: self.models.clone(),
            usage,
            latency_ms,
        })
    }

    fn boxes(&self) -> &[Aabb] {
        &self.boxes
    }

    fn token(&self) -> &'static str {
        ""
    }

    fn cloud(&self) -> &PointCloud {
        &self.cloud
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
