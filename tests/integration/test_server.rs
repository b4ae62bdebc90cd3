//! A server of its own for every test: in this process, or as a process that can be killed.

use camino::Utf8Path;
use reqwest::Method;
use sqlx::{AnyConnection, Connection};
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use uniground::app::{self, RunningService};
use uniground::config::{
    AccessConfig, BlobsConfig, DatabaseConfig, LimitsConfig, LogConfig, LogFormat, ModelsConfig,
    ParseChoice, Role, ServeConfig, VlmConfig, WebhookConfig,
};
use uniground_client::{Client, ClientError};
use uniground_storage::Location;
use uniground_types::job::Job;
use uniground_types::problem::Problem;
use uniground_types::question::GroundRequest;
use uniground_types::scenes::Scene;

/// Returns where a data folder's rows are stored: in the folder itself, or, if
/// `UNIGROUND_TEST_POSTGRES` names a server (`postgres://USER@HOST:PORT`), in a PostgreSQL database
/// that belongs to the folder.
pub fn database_location(data: &Utf8Path) -> Location {
    let Ok(server) = std::env::var("UNIGROUND_TEST_POSTGRES") else { return Location::Folder };
    let name: String = data.as_str().chars().filter(char::is_ascii_alphanumeric).collect();
    let name = &name[name.len().saturating_sub(60)..];
    let made = Command::new("createdb")
        .args(["--maintenance-db", &format!("{server}/postgres"), name])
        .output()
        .unwrap();
    let told = String::from_utf8_lossy(&made.stderr);
    assert!(made.status.success() || told.contains("already exists"), "{told}");
    format!("{server}/{name}").parse().unwrap()
}

/// Returns where scans and parses are stored: in the folder itself, or, if `UNIGROUND_TEST_S3`
/// names a bucket (`s3://BUCKET`, the rest in `AWS_…`), below a prefix that belongs to the folder.
pub fn blobs_config(data: &Utf8Path) -> BlobsConfig {
    let Ok(bucket) = std::env::var("UNIGROUND_TEST_S3") else { return BlobsConfig::default() };
    let name: String = data.as_str().chars().filter(char::is_ascii_alphanumeric).collect();
    BlobsConfig { at: format!("{bucket}/{name}").parse().unwrap(), ..BlobsConfig::default() }
}

/// Returns the environment variables that tell a program both locations.
pub fn storage_env(data: &Utf8Path) -> [(&'static str, String); 2] {
    let place = match database_location(data) {
        Location::Postgres(url) => url.with_password().to_owned(),
        _ => "sqlite".to_owned(),
    };
    [("UNIGROUND_DATABASE", place), ("UNIGROUND_BLOBS", blobs_config(data).at.to_string())]
}

/// Connects to the database of a stopped or running server.
pub async fn open_database(data: &Utf8Path) -> AnyConnection {
    sqlx::any::install_default_drivers();
    let url = match database_location(data) {
        Location::Postgres(url) => url.with_password().to_owned(),
        _ => format!("sqlite:{}", data.join("uniground.sqlite")),
    };
    AnyConnection::connect(&url).await.unwrap()
}

/// Connects without foreign key checks, so that a test can write a dangling reference.
pub async fn open_database_unchecked(data: &Utf8Path) -> AnyConnection {
    let mut rows = open_database(data).await;
    let loosen = match database_location(data) {
        Location::Postgres(_) => "SET session_replication_role = replica",
        _ => "PRAGMA foreign_keys = OFF",
    };
    sqlx::query(loosen).execute(&mut rows).await.unwrap();
    rows
}

/// Returns limits for a server in this process. Its child processes run the tested program.
pub fn test_limits() -> LimitsConfig {
    LimitsConfig {
        reader_program: Some(env!("CARGO_BIN_EXE_uniground").into()),
        ..LimitsConfig::default()
    }
}

/// Returns the configuration of a server on a data folder, without models.
pub fn serve_config(data_dir: &Utf8Path) -> ServeConfig {
    ServeConfig {
        listen: "127.0.0.1:0".parse().unwrap(),
        database: DatabaseConfig {
            location: database_location(data_dir),
            ..DatabaseConfig::default()
        },
        blobs: blobs_config(data_dir),
        data_dir: data_dir.to_owned(),
        role: Role::All,
        access: AccessConfig::default(),
        models: ModelsConfig::builtin(),
        fetch_models: false,
        vlm_check: false,
        parse: ParseChoice::FullOnly,
        vlm: VlmConfig::default(),
        webhook: WebhookConfig::default(),
        limits: test_limits(),
        log: LogConfig { log_format: LogFormat::Text, otlp_endpoint: None },
    }
}

/// A running server with a fresh data folder.
pub struct TestServer {
    pub client: Client,
    running: RunningService,
    data: tempfile::TempDir,
}

impl TestServer {
    pub async fn start() -> Self {
        Self::start_with(LimitsConfig::default()).await
    }

    pub async fn start_with(limits: LimitsConfig) -> Self {
        Self::start_configured(limits, VlmConfig::default()).await
    }

    pub async fn start_configured(limits: LimitsConfig, vlm: VlmConfig) -> Self {
        Self::start_on(tempfile::tempdir().unwrap(), limits, vlm, ModelsConfig::builtin()).await
    }

    /// Starts a server on a data folder that may already have been used.
    pub async fn start_on(
        data: tempfile::TempDir,
        limits: LimitsConfig,
        vlm: VlmConfig,
        models: ModelsConfig,
    ) -> Self {
        let config = serve_config(Utf8Path::from_path(data.path()).unwrap());
        let limits = LimitsConfig { reader_program: self::test_limits().reader_program, ..limits };
        Self::start_config(data, ServeConfig { models, vlm, limits, ..config }).await
    }

    /// Starts a server with this configuration, whose data is in `data`.
    pub async fn start_config(data: tempfile::TempDir, config: ServeConfig) -> Self {
        let running = app::start(&config).await.unwrap();
        let client = Client::new(&format!("http://{}", running.address), None).unwrap();
        Self { client, running, data }
    }

    pub fn data(&self) -> &Utf8Path {
        Utf8Path::from_path(self.data.path()).unwrap()
    }

    pub fn url(&self) -> String {
        format!("http://{}", self.running.address)
    }

    /// Uploads an archive and waits until it is parsed.
    pub async fn upload_and_parse(&self, archive: Vec<u8>) -> Scene {
        upload_and_parse(&self.client, "application/zip", archive).await
    }

    /// Returns the names of the entries of a folder below the data folder.
    pub fn list_folder(&self, folder: &str) -> Vec<String> {
        let entries = self.data().join(folder).read_dir_utf8().unwrap();
        entries.map(|entry| entry.unwrap().file_name().to_owned()).collect()
    }

    pub async fn stop(self) {
        self.stop_and_keep_data().await;
    }

    /// Stops the server and returns the data folder for the next one.
    pub async fn stop_and_keep_data(self) -> tempfile::TempDir {
        self.running.stop().await.unwrap();
        self.data
    }
}

pub async fn upload_and_parse(client: &Client, media_type: &str, archive: Vec<u8>) -> Scene {
    let created = client.create_scene(None, media_type, archive).await.unwrap();
    let job = wait_for_job(client, &created.job.unwrap().id).await;
    assert_eq!(job.error, None, "{job:?}");
    client.scene(&created.scene.id).await.unwrap()
}

pub async fn wait_for_job(client: &Client, job_id: &str) -> Job {
    client.follow_job(job_id, |_| {}).await.unwrap()
}

pub fn ask(query: &str) -> GroundRequest {
    serde_json::from_value(serde_json::json!({ "query": query })).unwrap()
}

/// Returns the problem of a failed call.
pub fn expect_problem<T: std::fmt::Debug>(result: Result<T, ClientError>) -> Problem {
    match result {
        Err(ClientError::Problem(problem)) => *problem,
        other => panic!("expected a problem, got {other:?}"),
    }
}

/// Asserts that a text contains another one, and prints both if it does not.
#[track_caller]
pub fn assert_contains(text: impl AsRef<str>, expected: impl AsRef<str>) {
    let (text, expected) = (text.as_ref(), expected.as_ref());
    assert!(text.contains(expected), "{expected:?} is not in: {text}");
}

/// Sends raw bytes and returns the problem.
pub async fn post_raw(client: &Client, path: &str, media_type: &str, body: &str) -> Problem {
    let request =
        client.request(Method::POST, path).header("content-type", media_type).body(body.to_owned());
    let response = request.send().await.unwrap();
    let content_type = response.headers()["content-type"].to_str().unwrap().to_owned();
    let text = response.text().await.unwrap();
    assert_eq!(content_type, "application/problem+json", "{text}");
    serde_json::from_str(&text).unwrap()
}

/// The binary as a child process, for tests that kill it.
pub struct Process {
    pub client: Client,
    pub child: Child,
}

impl Process {
    pub fn start(data: &Utf8Path) -> Self {
        Self::spawn(serve_command(data, "127.0.0.1:0").stderr(Stdio::null()))
    }

    /// Starts the binary with its log in a JSON file, at the default level.
    pub fn start_logging(data: &Utf8Path, log: &Utf8Path) -> Self {
        let mut command = serve_command(data, "127.0.0.1:0");
        Self::spawn(
            command
                .args(["--log-format", "json"])
                .env_remove("RUST_LOG")
                .stderr(File::create(log).unwrap()),
        )
    }

    pub fn spawn(command: &mut Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let address = line
            .trim()
            .strip_prefix("listening on ")
            .unwrap_or_else(|| panic!("unexpected first line {line:?}"));
        Self { client: Client::new(address, None).unwrap(), child }
    }

    /// Sends SIGKILL: the process cannot clean up.
    pub fn kill(mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// Sends SIGTERM and returns the exit code.
    pub fn terminate(mut self) -> Option<i32> {
        Command::new("kill").arg(self.child.id().to_string()).status().unwrap();
        self.child.wait().unwrap().code()
    }
}

/// No test leaves a server running, however it ends.
impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

pub fn serve_command(data: &Utf8Path, listen: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_uniground"));
    command
        .args(["serve", "--listen", listen, "--data-dir", data.as_str()])
        .env_remove("UNIGROUND_API_KEY")
        // Ignores models in the current folder; a test that needs models sets them.
        .envs([("UNIGROUND_MASKS", "builtin"), ("UNIGROUND_ENCODER", "builtin")])
        .envs(storage_env(data));
    command
}
