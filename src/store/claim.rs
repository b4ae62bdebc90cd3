//! Who has a database of PostgreSQL's for its own program, as the lock of a data folder has the folder: one connection holds a lock there.

use super::StoreError;
use super::database::Location;
use sqlx::any::{AnyConnectOptions, install_default_drivers};
use sqlx::{AnyConnection, AnyPool, ConnectOptions, Connection};
use std::str::FromStr;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::Mutex;
use tokio::time::{sleep, timeout};

/// What a server before may still need to be gone.
const HANDOVER: Duration = Duration::from_secs(5);
/// How often the connection is looked at.
const LOOK_EVERY: Duration = Duration::from_secs(2);

/// Held as long as a handle of it lives.
#[derive(Clone)]
pub(super) struct Claim {
    /// The connection that holds the lock.
    held: Arc<Mutex<Option<AnyConnection>>>,
    options: AnyConnectOptions,
}

impl Claim {
    /// Takes a database; nothing where it is in the data folder.
    ///
    /// # Errors
    /// [`StoreError::DatabaseInUse`], or what the database says.
    pub async fn take(location: &Location) -> Result<Option<Self>, StoreError> {
        let Location::Postgres(url) = location else { return Ok(None) };
        install_default_drivers();
        let options = AnyConnectOptions::from_str(url.with_password())?;
        let held = Arc::new(Mutex::new(Some(lock(&options, HANDOVER).await?)));
        Ok(Some(Self { held, options }))
    }

    /// Takes it again whenever its server was away. If somebody else was faster, it is not used any more: `used` is closed.
    pub fn keep(&self, used: [AnyPool; 2]) {
        let (held, options) = (Arc::downgrade(&self.held), self.options.clone());
        tokio::spawn(async move {
            loop {
                sleep(LOOK_EVERY).await;
                let Some(held) = held.upgrade() else { return };
                let mut connection = held.lock().await;
                let Some(open) = connection.as_mut() else { return };
                if matches!(timeout(LOOK_EVERY, open.ping()).await, Ok(Ok(()))) {
                    continue;
                }
                match timeout(HANDOVER, lock(&options, Duration::ZERO)).await {
                    Ok(Ok(again)) => *open = again,
                    Ok(Err(StoreError::DatabaseInUse)) => {
                        tracing::error!("another server took the database while it was away: this one does not use it any more");
                        for pool in &used {
                            pool.close().await;
                        }
                        return;
                    }
                    Ok(Err(error)) => tracing::warn!(error = &error as &dyn std::error::Error, "the database is away"),
                    Err(_) => tracing::warn!("the database is away"),
                }
            }
        });
    }

    /// Lets others have it.
    pub async fn let_go(&self) {
        let letting_go = async {
            if let Some(connection) = self.held.lock().await.take() {
                let _ = connection.close().await;
            }
        };
        // A server that does not answer lets go by itself.
        let _ = timeout(LOOK_EVERY, letting_go).await;
    }
}

/// A connection that holds the lock.
async fn lock(options: &AnyConnectOptions, patience: Duration) -> Result<AnyConnection, StoreError> {
    let mut connection = options.connect().await?;
    let begun = Instant::now();
    // The number is ours alone in this database; the lock goes with the connection.
    while !sqlx::query_scalar::<_, bool>("SELECT pg_try_advisory_lock(7313053)")
        .fetch_one(&mut connection)
        .await?
    {
        if begun.elapsed() >= patience {
            return Err(StoreError::DatabaseInUse);
        }
        sleep(HANDOVER / 50).await;
    }
    Ok(connection)
}
