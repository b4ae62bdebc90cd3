//! Stage 2 with a vision-language model, without the model's own time: images, prompts, and the
//! service's overhead per call. `cargo bench --bench vlm`

#![allow(missing_docs, clippy::unwrap_used)] // a bench that can not set up has nothing to time

use axum::routing::post;
use axum::{Json, Router};
use camino::{Utf8Path, Utf8PathBuf};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fs;
use std::sync::Arc;
use std::time::{Duration, Instant};
use uniground::app;
use uniground::config::{
    AccessConfig, BlobsConfig, BundlesConfig, DatabaseConfig, LimitsConfig, LogConfig, LogFormat,
    ModelsConfig, ParseChoice, Role, RuntimeConfig, ServeConfig, VlmConfig, WebhookConfig,
};
use uniground_client::Client;
use uniground_core::grounding::memory_scene::{MemoryScene, SceneAlbum};
use uniground_core::grounding::vlm::{
    Conversation, EvidenceMode, Options, PictureSettings, PromptContext, REMAINING, VisualEvidence,
    collect, contact_sheets, naming, narrowing,
};
use uniground_core::grounding::{NameIndex, Question, SceneView, ground_with_context};
use uniground_core::ingest::ScanFolder;
use uniground_core::language;
use uniground_core::models::chat::Tokens;
use uniground_core::models::neural::Models;
use uniground_core::parsing::checkpoints::Checkpoints;
use uniground_core::progress::Progress;
use uniground_core::render::RenderScene;
use uniground_core::scan::{ParsedScan, parse_scan};
use uniground_core::scene::{InstanceId, PointCloud};
use uniground_types::answer::Answer;
use uniground_types::question::{GroundRequest, ReasonerChoice};
use uniground_types::settings::ParseSettings;

const POINTS: usize = 200_000;
/// Number of candidates on contact sheets.
const ON_SHEETS: usize = 24;
const ROUNDS: usize = 15;

fn main() {
    let examples = Utf8Path::new(env!("CARGO_MANIFEST_DIR")).join("examples");
    let queries: Value =
        serde_json::from_slice(&fs::read(examples.join("living_room.queries.json")).unwrap())
            .unwrap();
    let queries: Vec<String> = queries
        .as_array()
        .unwrap()
        .iter()
        .map(|q| q["query"].as_str().unwrap().to_owned())
        .collect();
    let scan = examples.join("living_room.zip");
    let sample = Sample::parse(&scan);
    sample.time_evidence(&queries);
    sample.count_tokens(&queries);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let archive = fs::read(&scan).unwrap();
    runtime.block_on(measure_overhead(&archive, &queries));
    runtime.block_on(measure_during_parse(&archive, &queries));
}

/// The sample scene and the folder of its photographs.
struct Sample {
    parsed: ParsedScan,
    _folder: ScanFolder,
}

impl Sample {
    fn parse(scan: &Utf8Path) -> Self {
        let folder = ScanFolder::open(scan).unwrap();
        let settings = ParseSettings::default();
        let parsed = parse_scan(
            &folder.path,
            &settings,
            &Models::default(),
            &Checkpoints::disabled(),
            &Progress::silent(),
        )
        .unwrap();
        Self { parsed, _folder: folder }
    }

    fn context(&self, words: &str, top_k: usize) -> PromptContext {
        let scene = &self.parsed.scene;
        let view = SceneView {
            instances: &scene.instances,
            extent: scene.extent,
            names: &NameIndex::of(&scene.instances),
            appearance: None,
        };
        ground_with_context(
            view,
            &Question { top_k, ..Question::of(words) },
            language::parse(words),
            Duration::ZERO,
        )
        .1
    }

    /// The scene with nothing rendered yet, over `points` of its cloud.
    fn fresh(&self, points: usize) -> Arc<MemoryScene> {
        let (scene, all) = (&self.parsed.scene, &self.parsed.scene.cloud);
        let every = all.len() as f64 / points as f64;
        let kept = (0..points).map(|i| (i as f64 * every) as usize);
        let cloud = PointCloud {
            positions: kept.clone().map(|i| all.positions[i]).collect(),
            colors: kept.map(|i| all.colors[i]).collect(),
        };
        let frames = self.parsed.frames.clone();
        let render_scene = RenderScene::with_building(cloud, &scene.instances);
        Arc::new(SceneAlbum::new(scene.extent, render_scene, None, String::new(), frames))
            .scene(scene.instances.clone().into())
    }

    /// Three renders of 680 x 680 and five collages, rendered and encoded; photographs come from
    /// files, the cloud is in memory.
    fn time_evidence(&self, queries: &[String]) {
        let context =
            queries.iter().map(|q| self.context(q, 5)).find(|c| c.candidates.len() == 5).unwrap();
        let settings = PictureSettings::of(Options::default());
        let mut times: Vec<f64> = (0..ROUNDS)
            .map(|_| {
                let scene = self.fresh(POINTS);
                let start = Instant::now();
                let evidence = collect(scene.as_ref(), &context, &settings).unwrap();
                assert!(evidence.global.is_some() && evidence.collages.len() >= 5);
                start.elapsed().as_secs_f64() * 1e3
            })
            .collect();
        times.sort_by(f64::total_cmp);
        println!(
            "evidence for 5 candidates, {POINTS} points: median {:.0} ms, worst of {ROUNDS} {:.0} ms",
            times[ROUNDS / 2],
            times[ROUNDS - 1]
        );
    }

    /// Estimated tokens of the first call: text at four characters per token, images by tiles of
    /// 512 pixels.
    fn count_tokens(&self, queries: &[String]) {
        let scene = self.fresh(self.parsed.scene.cloud.len());
        // Names as a model would give them; the encoder's names stand in.
        let name =
            |id: u32| format!("{} object", self.parsed.scene.instances[id as usize - 1].label());
        let (mut full, mut cached, mut sheet, mut two_step, mut text) = (0, 0, 0, 0, 0);
        let mut photographed = 0;
        for words in queries {
            let (five, many) = (self.context(words, 5), self.context(words, ON_SHEETS));
            let remain: Vec<u32> = many.candidates.iter().map(|c| c.id.0).take(REMAINING).collect();
            let three = many.narrowed_to(&remain);
            let first_step = {
                let ids: Vec<InstanceId> = many.candidates.iter().map(|c| c.id).collect();
                let sheets = contact_sheets(scene.as_ref(), &ids).unwrap();
                Tokens::estimate(&narrowing(
                    &many,
                    &VisualEvidence { sheets, ..VisualEvidence::default() },
                ))
                .total()
            };
            two_step += first_step;
            let modes = [
                (EvidenceMode::Full, &five, &mut full),
                (EvidenceMode::CachedNames, &five, &mut cached),
                (EvidenceMode::Sheet, &many, &mut sheet),
                (EvidenceMode::TwoStep, &three, &mut two_step),
            ];
            for (evidence, context, total) in modes {
                let settings = PictureSettings::of(Options { evidence, ..Options::default() });
                let pictures = collect(scene.as_ref(), context, &settings).unwrap();
                let names: BTreeMap<u32, String> =
                    context.candidates.iter().map(|c| (c.id.0, name(c.id.0))).collect();
                let options = Options { evidence, ..Options::default() };
                let request =
                    Conversation { context, evidence: &pictures, options, names, unnamed: None }
                        .first_request();
                let tokens = Tokens::estimate(&request);
                *total += tokens.total();
                match evidence {
                    EvidenceMode::Full => text = text.max(tokens.text),
                    EvidenceMode::CachedNames => photographed += request.user.len() - 2,
                    EvidenceMode::Sheet | EvidenceMode::TwoStep | EvidenceMode::Photographs => {}
                }
            }
        }
        let objects: Vec<InstanceId> = self
            .parsed
            .scene
            .instances
            .iter()
            .filter(|i| i.structure.is_none())
            .map(|i| i.id)
            .collect();
        let naming: u64 = objects
            .chunks(naming::PER_SHEET)
            .filter_map(|ids| {
                let (sheet, ids) = naming::sheet_of(scene.as_ref(), 1, ids).unwrap()?;
                Some(Tokens::estimate(&naming::request(sheet, &ids)).total())
            })
            .sum();
        let count = queries.len() as u64;
        println!(
            "\n| evidence | prompt tokens per question (of {count}) | of full |\n|---|---|---|"
        );
        println!(
            "| full, 5 candidates, one call | {} (text at most {text}) | 1.00 |",
            full / count
        );
        println!(
            "| sheet, {ON_SHEETS} candidates, one call | {} | {:.2} |",
            sheet / count,
            sheet as f64 / full as f64
        );
        println!(
            "| two_step, {ON_SHEETS} then {REMAINING}, two calls | {} | {:.2} |",
            two_step / count,
            two_step as f64 / full as f64
        );
        println!("| cached_names | {} | {:.2} |", cached / count, cached as f64 / full as f64);
        println!(
            "| cached_names, with naming all {} objects once | {} | {:.2} |",
            objects.len(),
            (cached + naming) / count,
            (cached + naming) as f64 / full as f64
        );
        println!("\nwith cached names {photographed} collages went along with {count} questions");
    }
}

/// The service's overhead with a model that answers at once.
async fn measure_overhead(scan: &[u8], queries: &[String]) {
    let server = Server::start(ModelsConfig::builtin()).await;
    let created = server.client.create_scene(None, "application/zip", scan.to_vec()).await.unwrap();
    server.client.follow_job(&created.job.unwrap().id, |_| {}).await.unwrap();
    println!(
        "\n| | questions | service beside the model, ms: p50 | p95 | pictures, ms: p50 | p95 |\n|---|---|---|---|---|---|"
    );
    for pass in ["first time", "again"] {
        let (mut beside, mut pictures) = (Vec::new(), Vec::new());
        for words in queries {
            let (answer, took) = server.ask(&created.scene.id, words).await;
            let calls: f64 = answer.trace.unwrap().calls.iter().map(|call| call.latency_ms).sum();
            beside.push(took - calls);
            pictures.push(answer.timings_ms.evidence);
        }
        let count = beside.len();
        println!(
            "| {pass} | {count} | {:.1} | {:.1} | {:.1} | {:.1} |",
            percentile(&mut beside, 0.5),
            percentile(&mut beside, 0.95),
            percentile(&mut pictures, 0.5),
            percentile(&mut pictures, 0.95)
        );
    }
    server.running.stop().await.unwrap();
}

/// Images for questions while a parse with a segmenter runs, and on an idle server. The tiny bundle
/// replaces a real one unless `MASKS` names one in `models/`.
async fn measure_during_parse(scan: &[u8], queries: &[String]) {
    let root = Utf8Path::new(env!("CARGO_MANIFEST_DIR"));
    let (masks, folder) = match std::env::var("MASKS") {
        Ok(bundle) => (bundle, root.join("models")),
        Err(_) => ("tiny-segmenter".to_owned(), root.join("crates/uniground-models/tests/data")),
    };
    let library = root.join(".onnxruntime/libonnxruntime.so");
    let bundles = BundlesConfig {
        models: folder,
        runtime: RuntimeConfig { onnxruntime_lib: Some(library), ..RuntimeConfig::default() },
        ..BundlesConfig::default()
    };
    let server =
        Server::start(ModelsConfig { masks: masks.clone(), bundles, ..ModelsConfig::builtin() })
            .await;
    let built_in = |share: f64| json!({"settings": {"models": {"masks": "builtin"}, "parsing": {"views": {"min_share_of_best": share}}}});
    let scene = server.client.create_scene(None, "application/zip", scan.to_vec()).await.unwrap();
    server.client.cancel_job(&scene.job.unwrap().id).await.unwrap();
    let scene = scene.scene.id;
    println!(
        "\n| pictures for a question, ms | questions | p50 | p95 | worst | whole question, ms: p95 |\n|---|---|---|---|---|---|"
    );
    for (pass, share) in [("quiet", 0.3), ("beside a parse with a segmenter", 0.31)] {
        // A new parse for each pass, so that no image is cached.
        let job = server.client.parse(&scene, &built_in(share)).await.unwrap();
        server.client.follow_job(&job.id, |_| {}).await.unwrap();
        let (mut pictures, mut whole) = (Vec::new(), Vec::new());
        let mut parse: Option<String> = None;
        for (number, words) in queries.iter().enumerate() {
            if share > 0.3 {
                parse = Some(server.keep_parsing(&scene, parse, number).await);
            }
            let (answer, took) = server.ask(&scene, words).await;
            pictures.push(answer.timings_ms.evidence);
            whole.push(took);
        }
        if let Some(job) = parse {
            server.client.cancel_job(&job).await.unwrap();
        }
        println!(
            "| {pass} ({masks}) | {} | {:.0} | {:.0} | {:.0} | {:.0} |",
            pictures.len(),
            percentile(&mut pictures, 0.5),
            percentile(&mut pictures, 0.95),
            percentile(&mut pictures, 1.0),
            percentile(&mut whole, 0.95)
        );
    }
    server.running.stop().await.unwrap();
}

/// Starts a service whose model answers at once.
struct Server {
    running: app::RunningService,
    client: Client,
    _data: tempfile::TempDir,
}

impl Server {
    async fn start(models: ModelsConfig) -> Self {
        let reply = || async {
            let text = "Predicted ID: 1\nExplanation: x\nCandidate Names: 1 -> thing\nTarget name matches?: true\nAnchor ID: unknown\nRelation used: none";
            Json(
                json!({"choices": [{"message": {"content": text}}], "usage": {"prompt_tokens": 1, "completion_tokens": 1}}),
            )
        };
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}/v1", listener.local_addr().unwrap());
        let router = Router::new()
            .route("/v1/chat/completions", post(reply))
            .layer(axum::extract::DefaultBodyLimit::disable());
        tokio::spawn(async move { axum::serve(listener, router).await });
        let data = tempfile::tempdir().unwrap();
        let config = ServeConfig {
            listen: "127.0.0.1:0".parse().unwrap(),
            database: DatabaseConfig::default(),
            blobs: BlobsConfig::default(),
            data_dir: Utf8PathBuf::try_from(data.path().to_owned()).unwrap(),
            role: Role::All,
            access: AccessConfig::default(),
            models,
            fetch_models: false,
            vlm_check: false,
            parse: ParseChoice::FullOnly,
            vlm: VlmConfig {
                vlm_url: Some(url),
                vlm_model: Some("instant".into()),
                ..VlmConfig::default()
            },
            webhook: WebhookConfig::default(),
            limits: LimitsConfig {
                reader_program: Some(env!("CARGO_BIN_EXE_uniground").into()),
                ..LimitsConfig::default()
            },
            log: LogConfig { log_format: LogFormat::Text, otlp_endpoint: None },
        };
        let running = app::start(&config).await.unwrap();
        let client = Client::new(&format!("http://{}", running.address), None).unwrap();
        Self { running, client, _data: data }
    }

    /// Returns an answer by the model and its latency in milliseconds.
    async fn ask(&self, scene: &str, words: &str) -> (Answer, f64) {
        let request = GroundRequest { reasoner: ReasonerChoice::Vlm, ..GroundRequest::new(words) };
        let start = Instant::now();
        let answer = self.client.ground(scene, &request).await.unwrap();
        (answer, start.elapsed().as_secs_f64() * 1e3)
    }

    /// Ensures that a parse with the segmenter is running and computing masks.
    async fn keep_parsing(&self, scene: &str, job: Option<String>, number: usize) -> String {
        let running = match &job {
            Some(id) => !self.client.job(id).await.unwrap().state.is_final(),
            None => false,
        };
        let id = if let Some(id) = job.filter(|_| running) {
            id
        } else {
            // Different mask settings every time, so that no earlier parse is reused.
            let masks = json!({"points_per_side": 24, "min_area": 0.0001 + 1e-6 * number as f64});
            let request = json!({"settings": {"parsing": {"sam_masks": masks}}});
            self.client.parse(scene, &request).await.unwrap().id
        };
        loop {
            let job = self.client.job(&id).await.unwrap();
            assert!(
                !job.state.is_final(),
                "the parse ended before a question could be asked: {job:?}"
            );
            if job.stage.as_deref() == Some("masks_and_lifting") {
                return id;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }
}

fn percentile(times: &mut [f64], share: f64) -> f64 {
    times.sort_by(f64::total_cmp);
    times[((times.len() - 1) as f64 * share).round() as usize]
}
