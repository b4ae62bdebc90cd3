//! Evaluates a running server over HTTP. Scans are uploaded once and stay there.

use super::{OpenScene, System};
use crate::configuration::{Configuration, Names, Source};
use crate::digest;
use crate::reply::{Reply, SHORTLIST_DEPTH};
use crate::suite::{Expression, Hints, SuiteScene};
use anyhow::{Context, bail, ensure};
use camino::{Utf8Path, Utf8PathBuf};
use reqwest::Body;
use sha2::{Digest, Sha256};
use std::fs::{self, File};
use std::sync::Arc;
use std::time::Instant;
use tempfile::TempDir;
use tokio::runtime::Runtime;
use tokio_util::io::ReaderStream;
use uniground_client::Client;
use uniground_geometry::boxes::Aabb;
use uniground_ingest::archive::ArchiveKind;
use uniground_ingest::read_cloud;
use uniground_models::choice::{BUILTIN_ENCODER, BUILTIN_MASKS};
use uniground_render::RenderScene;
use uniground_types::instances::Levels;
use uniground_types::job::JobState;
use uniground_types::question::{GroundRequest, ParserChoice, ShortlistRequest};
use uniground_types::scenes::Scene;
use uniground_types::settings::ParsePreset;

/// A server, with an async runtime for calls from threads without one.
pub struct Server {
    client: Client,
    address: String,
    runtime: Arc<Runtime>,
}

struct RemoteScene {
    client: Client,
    runtime: Arc<Runtime>,
    id: String,
    token: String,
    boxes: Vec<Aabb>,
    render_scene: RenderScene,
}

impl Server {
    /// # Errors
    /// Returns an error for an invalid address, or a server that is not ready.
    pub fn connect(address: &str, api_key: Option<String>) -> anyhow::Result<Self> {
        let client = Client::new(address, api_key)?;
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
        runtime
            .block_on(client.scenes(1, None))
            .with_context(|| format!("the server at {address}"))?;
        Ok(Self { client, address: address.to_owned(), runtime: runtime.into() })
    }
}

impl System for Server {
    fn name(&self) -> String {
        self.address.clone()
    }

    fn fingerprint(&self) -> &str {
        &self.address
    }

    fn check_configuration(&self, configuration: &Configuration) -> anyhow::Result<()> {
        let Configuration {
            source, names, preset, settings, masks, encoder, paper_compatible, ..
        } = configuration;
        ensure!(
            *source == Source::Parsed,
            "a server uses only instances that it parsed: run without --server to use annotated or recorded ones"
        );
        ensure!(
            *names == Names::Own,
            "a server uses only names from its own model: run without --server for names=seen"
        );
        let own = *preset == ParsePreset::Default && settings.is_none();
        ensure!(
            own,
            "a server parses with its own settings: run without --server for parse presets and settings"
        );
        let unnamed = masks == BUILTIN_MASKS && encoder == BUILTIN_ENCODER;
        ensure!(
            unnamed,
            "a server uses the models it was started with: run without --server for masks= and encoder="
        );
        ensure!(
            !paper_compatible,
            "a server accepts no annotated hints: run without --server for --paper-compatible"
        );
        Ok(())
    }

    fn has_scene(&self, token: &str) -> bool {
        let id = token.split(' ').next().unwrap_or_default();
        self.runtime.block_on(self.client.scene(id)).is_ok_and(|scene| scene_token(&scene) == token)
    }

    fn open_scene(
        &self,
        scene: &SuiteScene,
        _: &Configuration,
    ) -> anyhow::Result<Box<dyn OpenScene>> {
        let scan =
            scene.scan.as_deref().with_context(|| format!("the scene {} has no scan", scene.id))?;
        let archive = Archive::read(scan)?;
        // Uploading the same scan again returns the existing scene.
        let key = format!("evaluation-as-it-is-{}", archive.digest()?);
        self.runtime.block_on(async {
            let body =
                Body::wrap_stream(ReaderStream::new(tokio::fs::File::open(&archive.path).await?));
            // The annotations are in the world of the files.
            let query = [("name", scene.id.as_str()), ("levelling", "off")];
            let created =
                self.client.create_scene_once(&query, archive.media_type, body, &key).await?;
            let job = self.client.follow_parses(&created.scene.id, |_| {}).await?;
            let job = job.context("the server started no parse job")?;
            if job.state != JobState::Succeeded {
                let why = job.error.map_or_else(
                    || format!("the job ended as {:?}", job.state),
                    |e| format!("{} ({})", e.detail, e.code),
                );
                bail!("the parse of {} failed: {why}", scene.id);
            }
            let id = created.scene.id;
            let boxes =
                self.client.all_instances(&id, Levels::All).await?.iter().map(|i| i.aabb).collect();
            let cloud = self.client.bytes(&format!("v1/scenes/{id}/cloud.ply")).await?;
            let folder = tempfile::tempdir()?;
            let file = Utf8Path::from_path(folder.path())
                .context("the path of the temporary folder is not UTF-8")?
                .join("cloud.ply");
            fs::write(&file, cloud)?;
            let render_scene = RenderScene::new(read_cloud(&file)?);
            let token = scene_token(&self.client.scene(&id).await?);
            let scene = RemoteScene {
                token,
                client: self.client.clone(),
                runtime: self.runtime.clone(),
                id,
                boxes,
                render_scene,
            };
            Ok(Box::new(scene) as Box<dyn OpenScene>)
        })
    }
}

impl OpenScene for RemoteScene {
    fn ask(
        &self,
        expression: &Expression,
        configuration: &Configuration,
        _: Option<&Hints>,
    ) -> anyhow::Result<Reply> {
        let Configuration {
            parser,
            reasoner,
            candidates,
            query_text,
            prompt,
            ablation,
            evidence,
            top_k,
            convention,
            ..
        } = configuration;
        let request = GroundRequest {
            top_k: *top_k,
            candidates: *candidates,
            query_text: *query_text,
            prompt: *prompt,
            parser: *parser,
            reasoner: *reasoner,
            ablation: *ablation,
            evidence: *evidence,
            direction_convention: *convention,
            // As measured in process: the report shows how reliable the confidences are.
            min_confidence: Some(0.0),
            ..GroundRequest::new(&expression.query)
        };
        let shortlist = ShortlistRequest {
            top_k: SHORTLIST_DEPTH,
            candidates: *candidates,
            query_text: *query_text,
            ..ShortlistRequest::new(&expression.query)
        };
        self.runtime.block_on(async {
            let start = Instant::now();
            let answer = self.client.ground(&self.id, &request).await?;
            let latency_ms = start.elapsed().as_secs_f64() * 1e3;
            let trace = answer.trace.as_ref();
            let reading =
                trace.and_then(|trace| trace.calls.iter().find(|call| call.purpose == "parse"));
            let unread = reading.and_then(|call| call.error.as_ref());
            let fell_back = trace.and_then(|trace| trace.corrections.first());
            let fell_back =
                fell_back.filter(|_| *parser == ParserChoice::Vlm && answer.usage.vlm_calls == 0);
            if let Some(why) = fell_back.or(unread) {
                bail!("the model could not be asked: {why}");
            }
            let shortlist = self.client.shortlist(&self.id, &shortlist).await?;
            Ok(Reply {
                status: answer.status,
                answer: answer.answer,
                aabb: answer.aabb,
                oriented_box: answer.oriented_box,
                confidence: answer.confidence,
                candidates: answer.candidates.unwrap_or_default(),
                shortlist: shortlist.candidates.iter().map(|c| c.aabb).collect(),
                models: answer.models,
                usage: answer.usage,
                latency_ms,
            })
        })
    }

    fn boxes(&self) -> &[Aabb] {
        &self.boxes
    }

    fn token(&self) -> &str {
        &self.token
    }

    fn render_scene(&self) -> &RenderScene {
        &self.render_scene
    }
}

/// Returns a token of a scene and its parse. It changes if the scene is deleted or parsed again.
fn scene_token(scene: &Scene) -> String {
    format!("{} {} {:?}", scene.id, scene.parse_version, scene.models)
}

/// A scan in the form that the server accepts. Folders and single clouds are packed.
struct Archive {
    media_type: &'static str,
    path: Utf8PathBuf,
    _temporary: Option<TempDir>,
}

impl Archive {
    fn read(scan: &Utf8Path) -> anyhow::Result<Self> {
        if let Some(kind) = ArchiveKind::from_file_name(scan.as_str()).filter(|_| scan.is_file()) {
            return Ok(Self {
                media_type: kind.media_type(),
                path: scan.to_owned(),
                _temporary: None,
            });
        }
        let temporary = tempfile::tempdir()?;
        let path: Utf8PathBuf = temporary.path().join("scan.tar").try_into()?;
        let mut tar = tar::Builder::new(File::create(&path)?);
        if scan.is_dir() {
            tar.append_dir_all(".", scan)?;
        } else if scan.extension() == Some("ply") {
            tar.append_path_with_name(scan, "cloud.ply")?;
        } else {
            bail!("{scan}: expected a folder, .zip, .tar, .tar.zst or .ply");
        }
        tar.into_inner()?.sync_all()?;
        Ok(Self { media_type: ArchiveKind::Tar.media_type(), path, _temporary: Some(temporary) })
    }

    fn digest(&self) -> anyhow::Result<String> {
        let mut hasher = Sha256::new();
        digest::add_path(&self.path, &mut hasher).with_context(|| self.path.to_string())?;
        Ok(digest::short_hex(hasher))
    }
}
