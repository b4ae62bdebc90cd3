//! Cluster membership and named locks: which processes use the store, and which of them holds which
//! lock. A SQLite file belongs to one process, which the lock of the data folder enforces. A
//! PostgreSQL database may have several member processes, on one machine or many.
//!
//! A member is a row with the time of its last heartbeat, by the database's clock, and a database
//! session that holds advisory locks. A killed process loses its session at once, and its row is
//! deleted a few seconds later. A process that hangs is removed, and its session terminated, after
//! a lease without heartbeats. Other workers then take over its work. The removed process finds its
//! row missing before it can write anything, and joins again under a new id.

use super::StoreError;
use super::database::{Database, Engine, KEEPALIVES, Location};
use super::local_locks::{LocalLock, LocalLocks};
use super::writer::Writer;
use sha2::{Digest, Sha256};
use sqlx::any::{AnyConnectOptions, install_default_drivers};
use sqlx::{AnyConnection, ConnectOptions, Connection, Executor};
use std::str::FromStr;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, PoisonError, RwLock, Weak};
use std::time::{Duration, Instant};
use tokio::sync::Mutex;
use tokio::time::{sleep, timeout};
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

/// How long a process that wants exclusive access waits for previous processes to end.
const HANDOVER_TIMEOUT: Duration = Duration::from_secs(5);
/// How long a process waits for another one that has exclusive access, while that one cleans up or
/// updates the schema before it lets others join.
const CLEANUP_TIMEOUT: Duration = Duration::from_mins(1);
/// Interval of heartbeats. A member whose session is gone and that has missed three heartbeats is
/// removed.
const HEARTBEAT_INTERVAL: Duration = Duration::from_secs(2);
/// How long members get to reconnect after the database was away: one heartbeat, and one failed
/// attempt before it.
const RECONNECT_TIMEOUT: Duration = Duration::from_secs(8);
/// Longest interval between attempts to take a lock. Processes that take locks one after the other
/// pause longer in between (`RunMode::pause`).
const MAX_LOCK_POLL_INTERVAL: Duration = Duration::from_millis(25);
/// Timeout of calls on the session's connection.
const CALL_TIMEOUT: Duration = Duration::from_secs(2);
/// Duration of a lease: a member without a heartbeat for so long loses its work to others.
pub const LEASE: Duration = Duration::from_secs(30);

/// Whether other processes may use the store at the same time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StoreAccess {
    /// As the database allows: PostgreSQL allows it, SQLite does not.
    Shared,
    /// Exclusive access.
    Exclusive,
}

/// This process as a member of the cluster that uses the store. Cheap to clone.
#[derive(Clone)]
pub(super) struct ClusterMembership {
    member: ProcessLease,
    local_locks: LocalLocks,
    /// Present where the database may have other members.
    session: Option<Session>,
    /// No other member was present when this one joined.
    pub was_alone: bool,
}

/// The member's current id and the duration of its lease.
#[derive(Clone)]
struct ProcessLease {
    id: Arc<RwLock<Arc<str>>>,
    lease: Duration,
}

/// A connection whose advisory locks belong to this member.
#[derive(Clone)]
struct Session {
    options: AnyConnectOptions,
    /// `None` while the server is away.
    held_connection: Arc<Mutex<Option<AnyConnection>>>,
    /// Counts connections. A lock is lost with the connection on which it was taken.
    number: Arc<AtomicU64>,
}

/// A named lock. While it lives, no other task of this or another process holds it.
pub struct NamedLock {
    /// The lock within this process, where the database has no other members.
    _local: Option<LocalLock>,
    shared: Option<AdvisoryLock>,
}

impl NamedLock {
    /// Returns whether the lock is still held. It is lost with the session: when the database was
    /// away, or when this process missed its heartbeats for a lease. Long-running holders check
    /// this.
    #[must_use]
    pub fn is_ours(&self) -> bool {
        self.shared.as_ref().is_none_or(|lock| lock.session.number.load(Relaxed) == lock.number)
    }
}

/// An advisory lock of the database. Released on drop, also where the caller was cancelled before
/// it received the lock.
struct AdvisoryLock {
    session: Session,
    key: i64,
    number: u64,
    /// The lock within this process. It is released only after the database's lock, so that a task
    /// of this process cannot take it before other processes could.
    local: Option<LocalLock>,
}

/// The connection number after this member has left.
const LEFT: u64 = u64::MAX;

/// The lock that all members share, and that a process with exclusive access holds alone. No other
/// user of this database may use this number.
const MEMBERS: i64 = 7_313_053;

impl ClusterMembership {
    /// Joins the members of a database. The member's row is written by [`enter`](Self::enter), once
    /// the schema is up to date.
    ///
    /// # Errors
    /// [`StoreError::DatabaseInUse`], or the database's error.
    pub async fn join(
        location: &Location,
        access: StoreAccess,
        lease: Duration,
    ) -> Result<Self, StoreError> {
        let (member, local_locks) =
            (ProcessLease { id: Arc::new(RwLock::new(new_id())), lease }, LocalLocks::default());
        let Location::Postgres(url) = location else {
            return Ok(Self { member, local_locks, session: None, was_alone: true });
        };
        install_default_drivers();
        let options = AnyConnectOptions::from_str(url.with_password())?;
        let mut connection = connect(&options).await?;
        let begun = Instant::now();
        let mut waited = false;
        let was_alone = loop {
            if call_lock_function(&mut connection, "pg_try_advisory_lock", MEMBERS).await? {
                if waited || !has_members(&mut connection).await? {
                    break true;
                }
                // They were killed, or are reconnecting to a database that was away itself.
                call_lock_function(&mut connection, "pg_advisory_unlock", MEMBERS).await?;
                sleep(RECONNECT_TIMEOUT).await;
                waited = true;
                continue;
            }
            if access == StoreAccess::Shared
                && call_lock_function(&mut connection, "pg_try_advisory_lock_shared", MEMBERS)
                    .await?
            {
                break false;
            }
            let patience =
                if access == StoreAccess::Shared { CLEANUP_TIMEOUT } else { HANDOVER_TIMEOUT };
            if begun.elapsed() >= patience {
                return Err(StoreError::DatabaseInUse);
            }
            sleep(HANDOVER_TIMEOUT / 50).await;
        };
        let session = Session {
            options,
            held_connection: Arc::new(Mutex::new(Some(connection))),
            number: Arc::default(),
        };
        Ok(Self { member, local_locks, session: Some(session), was_alone })
    }

    /// Writes this member's row. A member that was alone deletes all other rows: their processes
    /// are gone.
    pub async fn enter(&self, writer: &Writer) -> Result<(), StoreError> {
        let mut tx = writer.begin().await?;
        if self.was_alone {
            sqlx::query("DELETE FROM members").execute(&mut *tx).await?;
        }
        let sql =
            format!("INSERT INTO members (id, seen_at) VALUES ($1, {})", writer.engine().clock());
        sqlx::query(sqlx::AssertSqlSafe(sql)).bind(&*self.id()).execute(&mut *tx).await?;
        tx.commit().await
    }

    /// Releases exclusive access, where this process had it, and starts the heartbeats.
    pub async fn release_exclusive_access(&self) -> Result<(), StoreError> {
        let Some(session) = &self.session else { return Ok(()) };
        if self.was_alone {
            let mut held_connection = session.held_connection.lock().await;
            let connection = held_connection.as_mut().ok_or(sqlx::Error::PoolTimedOut)?;
            call_lock_function(connection, "pg_try_advisory_lock_shared", MEMBERS).await?;
            call_lock_function(connection, "pg_advisory_unlock", MEMBERS).await?;
        }
        tokio::spawn(self.member.clone().run_heartbeat(
            session.options.clone(),
            Arc::downgrade(&session.held_connection),
            session.number.clone(),
        ));
        Ok(())
    }

    /// Returns the id that marks this member's work. It changes when the member was removed and
    /// joined again.
    pub fn id(&self) -> Arc<str> {
        self.member.id()
    }

    /// Returns whether the database may have other members.
    pub fn is_shared(&self) -> bool {
        self.session.is_some()
    }

    /// Waits for the lock of this name.
    ///
    /// # Errors
    /// The database's error.
    pub async fn lock(&self, name: &str) -> Result<NamedLock, StoreError> {
        let local = self.local_locks.lock(name).await;
        let Some(session) = &self.session else {
            return Ok(NamedLock { _local: Some(local), shared: None });
        };
        let shared = session.clone().acquire(lock_key(name), LockWait::Wait).await?;
        Ok(NamedLock { _local: None, shared: shared.map(|shared| shared.with_local_lock(local)) })
    }

    /// Takes the lock of this name, if it is free.
    ///
    /// # Errors
    /// The database's error.
    pub async fn try_lock(&self, name: &str) -> Result<Option<NamedLock>, StoreError> {
        let Some(local) = self.local_locks.try_lock(name) else { return Ok(None) };
        let Some(session) = &self.session else {
            return Ok(Some(NamedLock { _local: Some(local), shared: None }));
        };
        let shared = session.clone().acquire(lock_key(name), LockWait::NoWait).await?;
        Ok(shared
            .map(|shared| NamedLock { _local: None, shared: Some(shared.with_local_lock(local)) }))
    }

    /// Leaves the cluster. Other members can take over this one's work at once.
    pub async fn leave(&self) {
        let Some(session) = &self.session else { return };
        let leaving = async {
            let mut held_connection = session.held_connection.lock().await;
            session.number.store(LEFT, Relaxed);
            if let Some(mut connection) = held_connection.take() {
                let _ = sqlx::query("DELETE FROM members WHERE id = $1")
                    .bind(&*self.id())
                    .execute(&mut connection)
                    .await;
                let _ = connection.close().await;
            }
        };
        // A server that does not answer notices by itself that the session is gone.
        let _ = timeout(CALL_TIMEOUT, leaving).await;
    }
}

impl ProcessLease {
    fn id(&self) -> Arc<str> {
        self.id.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Sends heartbeats as long as the session has an owner. Removes members that are gone, and
    /// reconnects whenever the database was away.
    async fn run_heartbeat(
        self,
        options: AnyConnectOptions,
        held_connection: Weak<Mutex<Option<AnyConnection>>>,
        number: Arc<AtomicU64>,
    ) {
        let (mut steady_since, mut beaten, mut wait) =
            (Instant::now(), Instant::now(), HEARTBEAT_INTERVAL);
        loop {
            sleep(wait).await;
            wait = HEARTBEAT_INTERVAL;
            let Some(held_connection) = held_connection.upgrade() else { return };
            let mut held_connection = held_connection.lock().await;
            if number.load(Relaxed) == LEFT {
                return;
            }
            // A process that was suspended or disconnected cannot tell which other members are
            // gone.
            let stood_still = beaten.elapsed() > HEARTBEAT_INTERVAL * 3;
            if stood_still {
                steady_since = Instant::now();
            }
            beaten = Instant::now();
            let id_before = self.id();
            let seen = timeout(CALL_TIMEOUT * 2, async {
                let connection = match &mut *held_connection {
                    Some(connection) => connection,
                    gone => gone.insert(reconnect(&options).await?),
                };
                self.send_heartbeat(connection).await?;
                if *self.id() != *id_before {
                    steady_since = Instant::now();
                }
                if steady_since.elapsed() >= self.lease {
                    self.remove_gone_members(connection).await?;
                }
                Ok::<_, StoreError>(())
            });
            let trouble = match seen.await {
                Ok(Ok(())) => continue,
                Ok(Err(StoreError::DatabaseInUse)) => "another process has exclusive access",
                Ok(Err(_)) => "connection refused or closed",
                Err(_) => "no response",
            };
            tracing::warn!(trouble, "database connection lost; reconnecting");
            *held_connection = None;
            number.fetch_add(1, Relaxed);
            steady_since = Instant::now();
            // Other members have terminated its session: check at once whether its row was removed.
            if stood_still {
                wait = Duration::ZERO;
            }
        }
    }

    /// Sends one heartbeat. Takes a new id where this member was removed.
    async fn send_heartbeat(&self, connection: &mut AnyConnection) -> Result<(), StoreError> {
        let (clock, id) = (Engine::Postgres.clock(), self.id());
        let sql = format!(
            "UPDATE members SET seen_at = {clock}, session = pg_backend_pid() WHERE id = $1"
        );
        let seen =
            sqlx::query(sqlx::AssertSqlSafe(sql)).bind(&*id).execute(&mut *connection).await?;
        if seen.rows_affected() == 0 {
            let again = new_id();
            tracing::error!(
                "lease lost: this process missed its heartbeats and its jobs went to other workers"
            );
            let sql = format!(
                "INSERT INTO members (id, seen_at, session) VALUES ($1, {clock}, pg_backend_pid())"
            );
            sqlx::query(sqlx::AssertSqlSafe(sql)).bind(&*again).execute(connection).await?;
            *self.id.write().unwrap_or_else(PoisonError::into_inner) = again;
        }
        Ok(())
    }

    /// Removes members that are gone, and members without a heartbeat for a lease, whose sessions
    /// it terminates.
    async fn remove_gone_members(&self, connection: &mut AnyConnection) -> Result<(), StoreError> {
        let clock = Engine::Postgres.clock();
        let sql = format!(
            "DELETE FROM members WHERE id <> $1 AND (seen_at < {clock} - $2
                 OR (seen_at < {clock} - $3 AND NOT EXISTS (SELECT 1 FROM pg_stat_activity WHERE pid = session)))
             RETURNING id, coalesce(session, 0)"
        );
        let gone: Vec<(String, i64)> = sqlx::query_as(sqlx::AssertSqlSafe(sql))
            .bind(&*self.id())
            .bind(self.lease.as_secs_f64())
            .bind((HEARTBEAT_INTERVAL * 3).as_secs_f64())
            .fetch_all(&mut *connection)
            .await?;
        for (id, session) in gone {
            tracing::warn!(
                member = id,
                "process lease expired; another worker takes over its jobs"
            );
            // Its locks, which other members may wait for, end with its session.
            let end = "SELECT count(pg_terminate_backend(pid)) FROM pg_stat_activity WHERE pid = $1 AND datname = current_database()";
            sqlx::query(end)
                .bind(i32::try_from(session).unwrap_or(0))
                .execute(&mut *connection)
                .await?;
        }
        Ok(())
    }
}

enum LockWait {
    NoWait,
    Wait,
}

impl Session {
    /// Takes an advisory lock, in a task of its own: a cancelled caller must not leave the
    /// connection in the middle of a statement.
    async fn acquire(
        self,
        key: i64,
        waiting: LockWait,
    ) -> Result<Option<AdvisoryLock>, StoreError> {
        let wanted = CancellationToken::new();
        let _wants = wanted.clone().drop_guard();
        let taking = tokio::spawn(async move {
            let mut wait = Duration::from_millis(5);
            loop {
                let (taken, number) = self.lock(key).await?;
                if taken {
                    return Ok(Some(AdvisoryLock { session: self, key, number, local: None }));
                }
                if matches!(waiting, LockWait::NoWait) || wanted.is_cancelled() {
                    return Ok(None);
                }
                sleep(wait).await;
                wait = (wait * 2).min(MAX_LOCK_POLL_INTERVAL);
            }
        });
        taking.await.map_err(|error| StoreError::Blobs(std::io::Error::other(error)))?
    }

    async fn lock(&self, key: i64) -> Result<(bool, u64), StoreError> {
        let mut held_connection = self.held_connection.lock().await;
        let number = self.number.load(Relaxed);
        let taken = self.call(&mut held_connection, "pg_try_advisory_lock", key).await?;
        Ok((taken, number))
    }

    /// Calls an advisory lock function. A connection that failed, or was interrupted within a
    /// statement, is dropped; the next heartbeat opens a new one.
    async fn call(
        &self,
        held_connection: &mut Option<AnyConnection>,
        function: &'static str,
        key: i64,
    ) -> Result<bool, StoreError> {
        let connection = held_connection.as_mut().ok_or(sqlx::Error::PoolTimedOut)?;
        let called = timeout(CALL_TIMEOUT, call_lock_function(connection, function, key)).await;
        let called = called.unwrap_or_else(|_| Err(sqlx::Error::PoolTimedOut.into()));
        if called.is_err() {
            *held_connection = None;
            self.number.fetch_add(1, Relaxed);
        }
        called
    }
}

impl AdvisoryLock {
    fn with_local_lock(mut self, local: LocalLock) -> Self {
        self.local = Some(local);
        self
    }
}

impl Drop for AdvisoryLock {
    fn drop(&mut self) {
        let (session, key, number, local) =
            (self.session.clone(), self.key, self.number, self.local.take());
        // Where the process ends, the session ends too, and its locks with it.
        let Ok(runtime) = tokio::runtime::Handle::try_current() else { return };
        runtime.spawn(async move {
            let mut held_connection = session.held_connection.lock().await;
            if session.number.load(Relaxed) == number {
                let _ = session.call(&mut held_connection, "pg_advisory_unlock", key).await;
            }
            drop(held_connection);
            drop(local);
        });
    }
}

async fn connect(options: &AnyConnectOptions) -> Result<AnyConnection, StoreError> {
    let mut connection = options.connect().await?;
    connection.execute(KEEPALIVES).await?;
    Ok(connection)
}

/// Returns whether any member has not left. Before the first member the table does not exist.
async fn has_members(connection: &mut AnyConnection) -> Result<bool, StoreError> {
    let is_there: bool = sqlx::query_scalar("SELECT to_regclass('members') IS NOT NULL")
        .fetch_one(&mut *connection)
        .await?;
    if !is_there {
        return Ok(false);
    }
    let here: i64 =
        sqlx::query_scalar("SELECT count(*) FROM members").fetch_one(connection).await?;
    Ok(here > 0)
}

async fn reconnect(options: &AnyConnectOptions) -> Result<AnyConnection, StoreError> {
    let mut connection = connect(options).await?;
    match call_lock_function(&mut connection, "pg_try_advisory_lock_shared", MEMBERS).await? {
        true => Ok(connection),
        false => Err(StoreError::DatabaseInUse),
    }
}

/// Calls one of PostgreSQL's advisory lock functions.
async fn call_lock_function(
    connection: &mut AnyConnection,
    function: &'static str,
    key: i64,
) -> Result<bool, StoreError> {
    let sql = format!("SELECT {function}($1)");
    Ok(sqlx::query_scalar(sqlx::AssertSqlSafe(sql)).bind(key).fetch_one(connection).await?)
}

fn new_id() -> Arc<str> {
    Uuid::now_v7().to_string().into()
}

/// Returns the number of a named lock. PostgreSQL's advisory locks are numbered.
fn lock_key(name: &str) -> i64 {
    let digest = Sha256::digest(name);
    i64::from_be_bytes(std::array::from_fn(|i| digest[i]))
}

impl super::JobRepository {
    /// Joins the database as another process, as a restart does. For tests of job leases.
    ///
    /// # Errors
    /// [`StoreError`].
    #[doc(hidden)]
    pub async fn enter_as_new_process(&self) -> Result<(), StoreError> {
        let Database { members, writer, .. } = &*self.database;
        *members.member.id.write().unwrap_or_else(PoisonError::into_inner) = new_id();
        members.enter(writer).await
    }
}
