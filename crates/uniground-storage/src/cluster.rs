//! Who uses the store, and whose turn something is. SQLite's file belongs to one process: the lock
//! of the data folder sees to that. A database of PostgreSQL's may have several members, on one
//! machine or many.
//!
//! A member is a row that says when it was last seen, by the database's own clock, and a session
//! that holds locks. One that is killed loses its session at once and is forgotten a few seconds
//! later; one that hangs is forgotten, and its session ended, once it was not seen for a lease.
//! What it was at work on is others' from then on: it finds itself forgotten before it can write
//! anything down, and joins anew under another id.

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

/// What processes before may still need to be gone, for one that wants to be alone;
const HANDOVER: Duration = Duration::from_secs(5);
/// and what one that is alone may need, to clear up or to bring the schema up to date, before it
/// lets others in.
const CLEARING: Duration = Duration::from_mins(1);
/// How often a member says that it is there. One whose session is gone and that has missed three of
/// these is forgotten.
const BEAT: Duration = Duration::from_secs(2);
/// How long those who have not left may need to be back after the database was away: a beat, and a
/// try that came to nothing before.
const COMING_BACK: Duration = Duration::from_secs(8);
/// Who waits for a turn looks so often at least. Who takes turns one after the other pauses for
/// longer in between (`Beside::pause`).
const LONGEST_LOOK: Duration = Duration::from_millis(25);
/// Longer than that the session's server is not waited for.
const PATIENCE: Duration = Duration::from_secs(2);
/// How long a member may not be seen until what it is at work on is given to others.
pub const LEASE: Duration = Duration::from_secs(30);

/// Whether others may use the store meanwhile.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StoreAccess {
    /// As its database allows: PostgreSQL does, SQLite does not.
    Welcome,
    /// Nobody.
    None,
}

/// This process among those who use the store. Cheap to clone.
#[derive(Clone)]
pub(super) struct ClusterMembership {
    member: ProcessLease,
    turns: LocalLocks,
    /// Where there may be others.
    session: Option<Session>,
    /// Nobody else was there when it came.
    pub was_alone: bool,
}

/// By what it is known.
#[derive(Clone)]
struct ProcessLease {
    id: Arc<RwLock<Arc<str>>>,
    lease: Duration,
}

/// A connection whose locks are this member's.
#[derive(Clone)]
struct Session {
    options: AnyConnectOptions,
    /// Gone while the server is away.
    held: Arc<Mutex<Option<AnyConnection>>>,
    /// Counts connections: locks go with that in which they were taken.
    number: Arc<AtomicU64>,
}

/// A turn at something: nobody else, in this process or another, has it as long as this lives.
pub struct NamedLock {
    /// Within this process, where there is no other.
    _local: Option<LocalLock>,
    shared: Option<AdvisoryLock>,
}

impl NamedLock {
    /// Whether it still is: it goes with the session where the database was away, or this process
    /// was not seen for a lease. For those who keep one for long.
    #[must_use]
    pub fn is_ours(&self) -> bool {
        self.shared.as_ref().is_none_or(|turn| turn.session.number.load(Relaxed) == turn.number)
    }
}

/// A lock of the database's. It goes when this does, also where whoever wanted it has left before
/// he could be told.
struct AdvisoryLock {
    session: Session,
    key: i64,
    number: u64,
    /// Within this process. Nobody here has it before the others could: it is let go once the lock
    /// is.
    local: Option<LocalLock>,
}

/// The number of no connection: this member has left.
const LEFT: u64 = u64::MAX;

/// The lock that all members share, and that one who wants to be alone has for itself. The number
/// is ours alone in this database.
const MEMBERS: i64 = 7_313_053;

impl ClusterMembership {
    /// Joins those who use a database. Its row follows with [`enter`](Self::enter), once the schema
    /// is up to date.
    ///
    /// # Errors
    /// [`StoreError::DatabaseInUse`], or what the database says.
    pub async fn join(
        location: &Location,
        company: StoreAccess,
        lease: Duration,
    ) -> Result<Self, StoreError> {
        let (member, turns) =
            (ProcessLease { id: Arc::new(RwLock::new(new_id())), lease }, LocalLocks::default());
        let Location::Postgres(url) = location else {
            return Ok(Self { member, turns, session: None, was_alone: true });
        };
        install_default_drivers();
        let options = AnyConnectOptions::from_str(url.with_password())?;
        let mut connection = connect(&options).await?;
        let begun = Instant::now();
        let mut waited = false;
        let was_alone = loop {
            if locked(&mut connection, "pg_try_advisory_lock", MEMBERS).await? {
                if waited || !is_anybody_expected(&mut connection).await? {
                    break true;
                }
                // Killed, or on their way back to a database that was away itself.
                locked(&mut connection, "pg_advisory_unlock", MEMBERS).await?;
                sleep(COMING_BACK).await;
                waited = true;
                continue;
            }
            if company == StoreAccess::Welcome
                && locked(&mut connection, "pg_try_advisory_lock_shared", MEMBERS).await?
            {
                break false;
            }
            let patience = if company == StoreAccess::Welcome { CLEARING } else { HANDOVER };
            if begun.elapsed() >= patience {
                return Err(StoreError::DatabaseInUse);
            }
            sleep(HANDOVER / 50).await;
        };
        let session = Session {
            options,
            held: Arc::new(Mutex::new(Some(connection))),
            number: Arc::default(),
        };
        Ok(Self { member, turns, session: Some(session), was_alone })
    }

    /// Writes down that this member is there. Who is alone knows that all others are gone.
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

    /// Lets others join, where nobody else was there, and stays a member from now on.
    pub async fn let_others_in(&self) -> Result<(), StoreError> {
        let Some(session) = &self.session else { return Ok(()) };
        if self.was_alone {
            let mut held = session.held.lock().await;
            let connection = held.as_mut().ok_or(sqlx::Error::PoolTimedOut)?;
            locked(connection, "pg_try_advisory_lock_shared", MEMBERS).await?;
            locked(connection, "pg_advisory_unlock", MEMBERS).await?;
        }
        tokio::spawn(self.member.clone().stay(
            session.options.clone(),
            Arc::downgrade(&session.held),
            session.number.clone(),
        ));
        Ok(())
    }

    /// By which what this member is at work on is marked as its own. Another one once it was
    /// forgotten.
    pub fn id(&self) -> Arc<str> {
        self.member.id()
    }

    /// Whether there may be others.
    pub fn is_shared(&self) -> bool {
        self.session.is_some()
    }

    /// Waits for the turn at something, by its name.
    ///
    /// # Errors
    /// What the database says.
    pub async fn turn(&self, name: &str) -> Result<NamedLock, StoreError> {
        let local = self.turns.at(name).await;
        let Some(session) = &self.session else {
            return Ok(NamedLock { _local: Some(local), shared: None });
        };
        let shared = session.clone().take(key_of(name), LockWait::AsLongAsItTakes).await?;
        Ok(NamedLock { _local: None, shared: shared.map(|shared| shared.with(local)) })
    }

    /// The turn at something, by its name, if nobody has it.
    ///
    /// # Errors
    /// What the database says.
    pub async fn try_turn(&self, name: &str) -> Result<Option<NamedLock>, StoreError> {
        let Some(local) = self.turns.try_at(name) else { return Ok(None) };
        let Some(session) = &self.session else {
            return Ok(Some(NamedLock { _local: Some(local), shared: None }));
        };
        let shared = session.clone().take(key_of(name), LockWait::NotAtAll).await?;
        Ok(shared.map(|shared| NamedLock { _local: None, shared: Some(shared.with(local)) }))
    }

    /// Leaves: what it was at work on is others' at once.
    pub async fn leave(&self) {
        let Some(session) = &self.session else { return };
        let leaving = async {
            let mut held = session.held.lock().await;
            session.number.store(LEFT, Relaxed);
            if let Some(mut connection) = held.take() {
                let _ = sqlx::query("DELETE FROM members WHERE id = $1")
                    .bind(&*self.id())
                    .execute(&mut connection)
                    .await;
                let _ = connection.close().await;
            }
        };
        // A server that does not answer finds out by itself.
        let _ = timeout(PATIENCE, leaving).await;
    }
}

impl ProcessLease {
    fn id(&self) -> Arc<str> {
        self.id.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Stays a member as long as somebody holds the session: is seen, forgets the gone, and comes
    /// back whenever the database was away.
    async fn stay(
        self,
        options: AnyConnectOptions,
        held: Weak<Mutex<Option<AnyConnection>>>,
        number: Arc<AtomicU64>,
    ) {
        let (mut steady_since, mut beaten, mut wait) = (Instant::now(), Instant::now(), BEAT);
        loop {
            sleep(wait).await;
            wait = BEAT;
            let Some(held) = held.upgrade() else { return };
            let mut held = held.lock().await;
            if number.load(Relaxed) == LEFT {
                return;
            }
            // Who stood still, or was away, can not tell who else was.
            let stood_still = beaten.elapsed() > BEAT * 3;
            if stood_still {
                steady_since = Instant::now();
            }
            beaten = Instant::now();
            let id_before = self.id();
            let seen = timeout(PATIENCE * 2, async {
                let connection = match &mut *held {
                    Some(connection) => connection,
                    gone => gone.insert(connect_again(&options).await?),
                };
                self.beat(connection).await?;
                if *self.id() != *id_before {
                    steady_since = Instant::now();
                }
                if steady_since.elapsed() >= self.lease {
                    self.forget_the_gone(connection).await?;
                }
                Ok::<_, StoreError>(())
            });
            let trouble = match seen.await {
                Ok(Ok(())) => continue,
                Ok(Err(StoreError::DatabaseInUse)) => "somebody has it for itself",
                Ok(Err(_)) => "it refuses or is gone",
                Err(_) => "it does not answer",
            };
            tracing::warn!(trouble, "database connection lost; reconnecting");
            *held = None;
            number.fetch_add(1, Relaxed);
            steady_since = Instant::now();
            // Others have ended its session: it learns at once whether it was forgotten.
            if stood_still {
                wait = Duration::ZERO;
            }
        }
    }

    /// Says that it is there; takes another id where it was forgotten.
    async fn beat(&self, connection: &mut AnyConnection) -> Result<(), StoreError> {
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

    /// Forgets members that are gone, and those that were not seen for a lease, whose sessions end.
    async fn forget_the_gone(&self, connection: &mut AnyConnection) -> Result<(), StoreError> {
        let clock = Engine::Postgres.clock();
        let sql = format!(
            "DELETE FROM members WHERE id <> $1 AND (seen_at < {clock} - $2
                 OR (seen_at < {clock} - $3 AND NOT EXISTS (SELECT 1 FROM pg_stat_activity WHERE pid = session)))
             RETURNING id, coalesce(session, 0)"
        );
        let gone: Vec<(String, i64)> = sqlx::query_as(sqlx::AssertSqlSafe(sql))
            .bind(&*self.id())
            .bind(self.lease.as_secs_f64())
            .bind((BEAT * 3).as_secs_f64())
            .fetch_all(&mut *connection)
            .await?;
        for (id, session) in gone {
            tracing::warn!(
                member = id,
                "process lease expired; another worker takes over its jobs"
            );
            // Its locks, which others may wait for, go with its session.
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
    NotAtAll,
    AsLongAsItTakes,
}

impl Session {
    /// A lock of the database's. In a task of its own: a caller that leaves in the middle leaves no
    /// connection in the middle.
    async fn take(self, key: i64, waiting: LockWait) -> Result<Option<AdvisoryLock>, StoreError> {
        let wanted = CancellationToken::new();
        let _wants = wanted.clone().drop_guard();
        let taking = tokio::spawn(async move {
            let mut wait = Duration::from_millis(5);
            loop {
                let (taken, number) = self.lock(key).await?;
                if taken {
                    return Ok(Some(AdvisoryLock { session: self, key, number, local: None }));
                }
                if matches!(waiting, LockWait::NotAtAll) || wanted.is_cancelled() {
                    return Ok(None);
                }
                sleep(wait).await;
                wait = (wait * 2).min(LONGEST_LOOK);
            }
        });
        taking.await.map_err(|error| StoreError::Blobs(std::io::Error::other(error)))?
    }

    async fn lock(&self, key: i64) -> Result<(bool, u64), StoreError> {
        let mut held = self.held.lock().await;
        let number = self.number.load(Relaxed);
        let taken = self.call(&mut held, "pg_try_advisory_lock", key).await?;
        Ok((taken, number))
    }

    /// Calls a function for locks. A connection that is lost or in the middle of something is of no
    /// use any more: a new one comes with the next beat.
    async fn call(
        &self,
        held: &mut Option<AnyConnection>,
        function: &'static str,
        key: i64,
    ) -> Result<bool, StoreError> {
        let connection = held.as_mut().ok_or(sqlx::Error::PoolTimedOut)?;
        let called = timeout(PATIENCE, locked(connection, function, key)).await;
        let called = called.unwrap_or_else(|_| Err(sqlx::Error::PoolTimedOut.into()));
        if called.is_err() {
            *held = None;
            self.number.fetch_add(1, Relaxed);
        }
        called
    }
}

impl AdvisoryLock {
    fn with(mut self, local: LocalLock) -> Self {
        self.local = Some(local);
        self
    }
}

impl Drop for AdvisoryLock {
    fn drop(&mut self) {
        let (session, key, number, local) =
            (self.session.clone(), self.key, self.number, self.local.take());
        // Where the process ends, so does the session.
        let Ok(runtime) = tokio::runtime::Handle::try_current() else { return };
        runtime.spawn(async move {
            let mut held = session.held.lock().await;
            if session.number.load(Relaxed) == number {
                let _ = session.call(&mut held, "pg_advisory_unlock", key).await;
            }
            drop(held);
            drop(local);
        });
    }
}

async fn connect(options: &AnyConnectOptions) -> Result<AnyConnection, StoreError> {
    let mut connection = options.connect().await?;
    connection.execute(KEEPALIVES).await?;
    Ok(connection)
}

/// Whether there is somebody who has not left. Before the first member there is no such table.
async fn is_anybody_expected(connection: &mut AnyConnection) -> Result<bool, StoreError> {
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

async fn connect_again(options: &AnyConnectOptions) -> Result<AnyConnection, StoreError> {
    let mut connection = connect(options).await?;
    match locked(&mut connection, "pg_try_advisory_lock_shared", MEMBERS).await? {
        true => Ok(connection),
        false => Err(StoreError::DatabaseInUse),
    }
}

/// Calls one of PostgreSQL's functions for advisory locks.
async fn locked(
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

/// The number of a name: locks of PostgreSQL's have numbers.
fn key_of(name: &str) -> i64 {
    let digest = Sha256::digest(name);
    i64::from_be_bytes(std::array::from_fn(|i| digest[i]))
}

impl super::JobRepository {
    /// Enters the database as another process, as a restart does. For tests of job leases.
    ///
    /// # Errors
    /// [`StoreError`].
    #[doc(hidden)]
    pub async fn enter_as_new_process(&self) -> Result<(), StoreError> {
        let Database { members, writer, .. } = &self.database;
        *members.member.id.write().unwrap_or_else(PoisonError::into_inner) = new_id();
        members.enter(writer).await
    }
}
