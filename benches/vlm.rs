//! Stage 2 with a vision-language model, without the model's own time: pictures, prompts, and what the service adds to a call.
//! `cargo bench --bench vlm`

#![allow(missing_docs, clippy::unwrap_used)] // a bench that can not set up has nothing to time

use axum::routing::post;
use axum::{Json, Router};
use camino::{Utf8Path, Utf8PathBuf};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fs;
use std::time::{Duration, Instant};
use uniground::app;
use uniground::client::Client;
use uniground::config::{AccessConfig, LimitsConfig, LogConfig, LogFormat, ModelsConfig, ServeConfig, VlmConfig};
use uniground::grounding::direction::DirectionConvention;
use uniground::grounding::vlm::{Brief, Conversation, EvidenceMode, Exhibits, Options, PictureSettings, collages, global, naming};
use uniground::grounding::{Question, SceneView, ground_and_brief, query};
use uniground::ingest::{self, ImportSettings, Unpacked};
use uniground::models::chat::Tokens;
use uniground::progress::Progress;
use uniground::render::{Scenery, Shot};
use uniground::scene::{InstanceId, ParsedScene, PointCloud};
use uniground::scene_parsing::checkpoints::Checkpoints;
use uniground::scene_parsing::evidence::{self, EvidencePicture, Picture};
use uniground::scene_parsing::masks::rgbd::RgbdMasks;
use uniground::scene_parsing::{self, ParseError, ParsingSettings, Perception};
use uniground::service::{GroundRequest, ReasonerChoice};

const POINTS: usize = 200_000;
const ROUNDS: usize = 15;

fn main() {
    let examples = Utf8Path::new(env!("CARGO_MANIFEST_DIR")).join("examples");
    let queries: Value = serde_json::from_slice(&fs::read(examples.join("living_room.queries.json")).unwrap()).unwrap();
    let queries: Vec<String> = queries.as_array().unwrap().iter().map(|q| q["query"].as_str().unwrap().to_owned()).collect();
    let scan = examples.join("living_room.zip");
    let folder = tempfile::tempdir().unwrap();
    let room = Room::parse(&scan, Utf8Path::from_path(folder.path()).unwrap());
    room.time_evidence(&queries);
    room.count_tokens(&queries);
    tokio::runtime::Runtime::new().unwrap().block_on(overhead(&fs::read(&scan).unwrap(), &queries));
}

struct Room {
    parsed: ParsedScene,
    /// The views as the service keeps them.
    views: Utf8PathBuf,
}

impl Room {
    fn parse(scan: &Utf8Path, views: &Utf8Path) -> Self {
        let folder = Unpacked::of(scan).unwrap();
        let silent = Progress::silent();
        let bundle = ingest::load(&ingest::open(&folder.path).unwrap(), &ImportSettings::default(), &silent).unwrap();
        let frames = bundle.frames.clone();
        let masks = RgbdMasks::default();
        let settings = ParsingSettings::default();
        let parsed = scene_parsing::parse(bundle, &Perception::with_masks(&masks), &settings, &Checkpoints::none(), &silent).unwrap();
        let keep = |EvidencePicture { instance, view, picture, jpeg }: EvidencePicture| {
            fs::write(file(views, instance, view, picture), jpeg).unwrap();
            Ok::<_, ParseError>(())
        };
        evidence::render(&frames, &parsed.instances, &silent, keep).unwrap();
        Self { parsed, views: views.to_owned() }
    }

    fn brief(&self, words: &str) -> Brief {
        let scene = SceneView { instances: &self.parsed.instances, extent: self.parsed.extent, appearance: None };
        let convention = DirectionConvention::Paper;
        let question = Question { query: words.to_owned(), top_k: 5, convention, observer: None, target_name: None };
        ground_and_brief(scene, &question, query::parse(words), Duration::ZERO).1
    }

    fn shots(&self, id: InstanceId) -> Vec<Shot> {
        let instance = &self.parsed.instances[id.0 as usize - 1];
        let read = |view, picture| {
            image::load_from_memory(&fs::read(file(&self.views, id, view, picture)).unwrap())
                .unwrap()
                .into_rgb8()
        };
        let shot = |(k, view): (usize, &uniground::scene::View)| {
            let (crop, frame) = (read(k, Picture::Crop), read(k, Picture::Frame));
            Shot::new(crop, frame, view.box_px)
        };
        instance.views.iter().enumerate().map(shot).collect()
    }

    fn exhibits(&self, brief: &Brief, scenery: &Scenery, settings: &PictureSettings) -> Exhibits {
        let ids: Vec<InstanceId> = brief.candidates.iter().map(|c| c.id).collect();
        let (global, collages) = rayon::join(
            || global(brief, scenery, &self.parsed.extent, &settings.global),
            || collages(&ids, |id| self.shots(id), settings.collage),
        );
        Exhibits { global, collages }
    }

    /// Three renders of 680 x 680 and five collages, drawn and encoded; photographs come from files, the cloud is in memory.
    fn time_evidence(&self, queries: &[String]) {
        let brief = queries.iter().map(|q| self.brief(q)).find(|b| b.candidates.len() == 5).unwrap();
        let all = &self.parsed.cloud;
        let every = all.len() as f64 / POINTS as f64;
        let kept = (0..POINTS).map(|i| (i as f64 * every) as usize);
        let cloud =
            PointCloud { positions: kept.clone().map(|i| all.positions[i]).collect(), colours: kept.map(|i| all.colours[i]).collect() };
        let scenery = Scenery::of(cloud);
        let settings = PictureSettings::of(EvidenceMode::Full);
        let mut times: Vec<f64> = (0..ROUNDS)
            .map(|_| {
                let start = Instant::now();
                let exhibits = self.exhibits(&brief, &scenery, &settings);
                assert!(exhibits.global.is_some() && exhibits.collages.len() == 5);
                start.elapsed().as_secs_f64() * 1e3
            })
            .collect();
        times.sort_by(f64::total_cmp);
        println!(
            "evidence for 5 candidates, {} points: median {:.0} ms, worst of {ROUNDS} {:.0} ms",
            scenery.cloud.len(),
            times[ROUNDS / 2],
            times[ROUNDS - 1]
        );
    }

    /// Tokens of the first call, reckoned: text at four characters each, pictures by tiles of 512 pixels.
    fn count_tokens(&self, queries: &[String]) {
        let scenery = Scenery::of(self.parsed.cloud.clone());
        // Names as somebody gives them who looks; the encoder's stand in for a model's.
        let name = |id: u32| format!("{} object", self.parsed.instances[id as usize - 1].label());
        let (mut full, mut cached, mut text) = (0, 0, 0);
        let mut photographed = 0;
        for words in queries {
            let brief = self.brief(words);
            for (evidence, total) in [(EvidenceMode::Full, &mut full), (EvidenceMode::CachedNames, &mut cached)] {
                let settings = PictureSettings::of(evidence);
                let exhibits = self.exhibits(&brief, &scenery, &settings);
                let names: BTreeMap<u32, String> = brief.candidates.iter().map(|c| (c.id.0, name(c.id.0))).collect();
                let options = Options { evidence, ..Options::default() };
                let request = Conversation { brief: &brief, exhibits: &exhibits, options, names, unnamed: None }.first_request();
                let tokens = Tokens::of(&request);
                *total += tokens.total();
                match evidence {
                    EvidenceMode::Full => text = text.max(tokens.text),
                    EvidenceMode::CachedNames => photographed += request.user.len() - 2,
                }
            }
        }
        let objects: Vec<InstanceId> = self.parsed.instances.iter().filter(|i| i.structure.is_none()).map(|i| i.id).collect();
        let naming: u64 = objects
            .chunks(naming::PER_SHEET)
            .map(|ids| {
                let shots: Vec<_> = ids.iter().filter_map(|&id| Some((id, self.shots(id).into_iter().next()?))).collect();
                let ids: Vec<u32> = ids.iter().map(|id| id.0).collect();
                Tokens::of(&naming::request(naming::sheet(1, &shots), &ids)).total()
            })
            .sum();
        let count = queries.len() as u64;
        println!("\n| evidence | prompt tokens per question (of {count}) | of full |\n|---|---|---|");
        println!("| full | {} (text at most {text}) | 1.00 |", full / count);
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

fn file(views: &Utf8Path, instance: InstanceId, view: usize, picture: Picture) -> Utf8PathBuf {
    views.join(format!("{instance}-{view}-{picture:?}.jpg"))
}

/// What the service adds to a model that answers at once.
async fn overhead(scan: &[u8], queries: &[String]) {
    let reply = || async {
        let text = "Predicted ID: 1\nExplanation: x\nCandidate Names: 1 -> thing\nTarget name matches?: true\nAnchor ID: unknown\nRelation used: none";
        Json(json!({"choices": [{"message": {"content": text}}], "usage": {"prompt_tokens": 1, "completion_tokens": 1}}))
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
        data_dir: Utf8PathBuf::try_from(data.path().to_owned()).unwrap(),
        access: AccessConfig::default(),
        models: ModelsConfig::default(),
        vlm: VlmConfig { vlm_url: Some(url), vlm_model: Some("instant".into()), ..VlmConfig::default() },
        limits: LimitsConfig::default(),
        log: LogConfig { log_format: LogFormat::Text },
    };
    let running = app::start(&config).await.unwrap();
    let client = Client::new(&format!("http://{}", running.address), None).unwrap();
    let created = client.create_scene(None, "application/zip", scan.to_vec()).await.unwrap();
    client.follow_job(&created.job.unwrap().id, |_| {}).await.unwrap();
    println!("\n| | questions | service beside the model, ms: p50 | p95 | pictures, ms: p50 | p95 |\n|---|---|---|---|---|---|");
    for pass in ["first time", "again"] {
        let (mut beside, mut pictures) = (Vec::new(), Vec::new());
        for words in queries {
            let request = GroundRequest { reasoner: ReasonerChoice::Vlm, ..GroundRequest::of(words) };
            let start = Instant::now();
            let answer = client.ground(&created.scene.id, &request).await.unwrap();
            let calls: f64 = answer.trace.unwrap().calls.iter().map(|call| call.latency_ms).sum();
            beside.push(start.elapsed().as_secs_f64() * 1e3 - calls);
            pictures.push(answer.timings_ms.evidence);
        }
        let count = beside.len();
        let at = |times: &mut Vec<f64>, share: f64| {
            times.sort_by(f64::total_cmp);
            times[((times.len() - 1) as f64 * share).round() as usize]
        };
        println!(
            "| {pass} | {count} | {:.1} | {:.1} | {:.1} | {:.1} |",
            at(&mut beside, 0.5),
            at(&mut beside, 0.95),
            at(&mut pictures, 0.5),
            at(&mut pictures, 0.95)
        );
    }
    running.stop().await.unwrap();
}
