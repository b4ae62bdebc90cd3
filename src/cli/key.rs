//! `uniground key`: manages the API keys of a server.

use super::output::print_json;
use super::table;
use crate::config::{BlobsConfig, DatabaseConfig};
use crate::{telemetry, words};
use anyhow::{Context, ensure};
use camino::{Utf8Path, Utf8PathBuf};
use jiff::{Timestamp, ToSpan};
use std::io::{self, Write};
use uniground_client::Client;
use uniground_service::Keyring;
use uniground_storage::Store;
use uniground_types::keys::{CreatedKey, Key, NewKey, Scope};

#[derive(Debug, clap::Args)]
pub struct KeyArgs {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    /// Create a key and print its secret. The secret is shown only once
    Create(CreateArgs),
    /// List keys, newest first
    List(ListArgs),
    /// Revoke a key. It is rejected from then on
    Revoke(RevokeArgs),
}

#[derive(Debug, clap::Args)]
struct CreateArgs {
    /// Name of the holder, for display
    name: String,
    /// Access level: read (view and ask), write (also upload and change), admin (also manage keys)
    #[arg(long, default_value = "read", value_parser = words::scope())]
    scope: Scope,
    /// Days until the key expires [default: never]
    #[arg(long, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(1..=36_500))]
    expires_in_days: Option<u32>,
    /// Maximum requests per minute
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    requests_per_minute: Option<u32>,
    /// Maximum number of scenes the key may own
    #[arg(long, value_name = "N")]
    max_scenes: Option<u32>,
    /// Spending limit per day (UTC), US dollars
    #[arg(long, value_name = "USD", value_parser = words::usd)]
    daily_usd: Option<f64>,
    #[command(flatten)]
    place: KeyTarget,
}

#[derive(Debug, clap::Args)]
struct ListArgs {
    #[command(flatten)]
    place: KeyTarget,
}

#[derive(Debug, clap::Args)]
struct RevokeArgs {
    /// Id of the key, or the beginning of its secret (ug_ and eight more characters)
    key: String,
    #[command(flatten)]
    place: KeyTarget,
}

/// The key store: a running server, or the data folder of a stopped one.
#[allow(clippy::doc_markdown)] // Help is plain text.
#[derive(Debug, clap::Args)]
struct KeyTarget {
    /// Address of the server. Set UNIGROUND_API_KEY to an admin key
    #[arg(long, env = "UNIGROUND_SERVER", default_value = "http://127.0.0.1:8080")]
    server: String,
    /// Use the data folder of a stopped server instead, for example to create the first key
    #[arg(long)]
    data_dir: Option<Utf8PathBuf>,
    #[command(flatten)]
    database: DatabaseConfig,
    #[command(flatten)]
    blobs: BlobsConfig,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// Maximum page size of the API.
const PAGE: u32 = 100;

/// The data folder of a stopped server.
struct StoppedServer {
    keys: Keyring,
    store: Store,
}

/// Creates, lists and revokes keys.
enum KeyStore {
    Server(Client),
    Folder(Box<StoppedServer>),
}

impl KeyStore {
    async fn open(
        KeyTarget { server, data_dir, database, blobs, json: _ }: &KeyTarget,
    ) -> anyhow::Result<Self> {
        match data_dir {
            Some(folder) => Self::open_folder(folder, database, blobs).await,
            None => Ok(Self::Server(Client::new(server, std::env::var("UNIGROUND_API_KEY").ok())?)),
        }
    }

    async fn open_folder(
        folder: &Utf8Path,
        database: &DatabaseConfig,
        blobs: &BlobsConfig,
    ) -> anyhow::Result<Self> {
        let store = Store::open_alongside_server(folder, &database.location, &blobs.blob_home()?)
            .await
            .with_context(|| {
                format!(
                    "data folder {folder} (if its server is running, omit --data-dir and use \
                     --server)"
                )
            })?;
        let keys = Keyring::open(&store, None).await?;
        Ok(Self::Folder(Box::new(StoppedServer { keys, store })))
    }

    async fn create(&self, new: NewKey) -> anyhow::Result<CreatedKey> {
        Ok(match self {
            Self::Server(client) => client.create_key(&new).await?,
            Self::Folder(folder) => folder.keys.create(new).await?,
        })
    }

    async fn list_all(&self) -> anyhow::Result<Vec<Key>> {
        let (mut keys, mut cursor) = (Vec::new(), None);
        loop {
            let page = match self {
                Self::Server(client) => client.keys(PAGE, cursor.as_deref()).await?,
                Self::Folder(folder) => folder.keys.list(PAGE, cursor.as_deref()).await?,
            };
            keys.extend(page.keys);
            cursor = page.next_cursor;
            if cursor.is_none() {
                return Ok(keys);
            }
        }
    }

    async fn revoke(&self, id: &str) -> anyhow::Result<Key> {
        Ok(match self {
            Self::Server(client) => client.revoke_key(id).await?,
            Self::Folder(folder) => folder.keys.revoke(id).await?,
        })
    }

    async fn close(self) {
        if let Self::Folder(folder) = self {
            folder.store.close().await;
        }
    }
}

pub async fn run(args: &KeyArgs) -> anyhow::Result<()> {
    telemetry::start_quiet();
    match &args.command {
        Command::Create(args) => create(args).await,
        Command::List(ListArgs { place }) => {
            let keys = KeyStore::open(place).await?;
            let all = keys.list_all().await;
            keys.close().await;
            match place.json {
                true => print_json(&all?),
                false => Ok(writeln!(io::stdout(), "{}", table::keys_table(&all?))?),
            }
        }
        Command::Revoke(RevokeArgs { key, place }) => {
            let keys = KeyStore::open(place).await?;
            let revoked = revoke(&keys, key).await;
            keys.close().await;
            let revoked = revoked?;
            match place.json {
                true => print_json(&revoked),
                false => {
                    Ok(writeln!(io::stdout(), "revoked {} ({})", revoked.prefix, revoked.name)?)
                }
            }
        }
    }
}

async fn create(args: &CreateArgs) -> anyhow::Result<()> {
    let CreateArgs {
        name,
        scope,
        expires_in_days,
        requests_per_minute,
        max_scenes,
        daily_usd,
        place,
    } = args;
    let ahead =
        expires_in_days.map(|days| Timestamp::now().checked_add((i64::from(days) * 24).hours()));
    let new = NewKey {
        name: name.clone(),
        scope: *scope,
        expires_at: ahead.transpose()?.map(|at| at.to_string()),
        requests_per_minute: *requests_per_minute,
        max_scenes: *max_scenes,
        daily_usd: *daily_usd,
    };
    let keys = KeyStore::open(place).await?;
    let created = keys.create(new).await;
    keys.close().await;
    let created = created?;
    if place.json {
        return print_json(&created);
    }
    writeln!(io::stdout(), "{}", created.secret)?;
    eprintln!(
        "key with scope {}, shown only once. Use it as: Authorization: Bearer {}_…",
        created.key.scope.as_str(),
        created.key.prefix
    );
    Ok(())
}

/// Revokes a key by its id or by the beginning of its secret.
async fn revoke(keys: &KeyStore, key: &str) -> anyhow::Result<Key> {
    let found: Vec<Key> = keys
        .list_all()
        .await?
        .into_iter()
        .filter(|known| known.id == key || known.prefix == key)
        .collect();
    ensure!(!found.is_empty(), "key {key} not found");
    keys.revoke(&found[0].id).await
}
