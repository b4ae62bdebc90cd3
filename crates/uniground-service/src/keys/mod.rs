//! Who asks: keys, what they allow, how often they may be used and what they may spend.
//!
//! A key is 32 random bytes, shown once. Kept are its first characters, by which it is found, and
//! its hash, by which it is known. Where no key was ever made and none is configured, nobody needs
//! one.

mod audit;
mod links;

pub use audit::AuditedRequest;
pub use links::{LinkSecret, PARAMETER as LINK_PARAMETER};

use crate::error::Error;
use audit::AuditLog;
use base64::Engine;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use governor::clock::{Clock, DefaultClock};
use governor::middleware::StateInformationMiddleware;
use governor::{DefaultDirectRateLimiter, Quota, RateLimiter};
use jiff::Timestamp;
use sha2::{Digest, Sha256};
use std::collections::HashMap;
use std::num::NonZeroU32;
use std::sync::{Arc, Mutex, PoisonError, RwLock};
use std::time::{Duration, Instant};
use uniground_storage::{IdGenerator, KeyRepository, KeyRow, LockTable, Store, now, page};
use uniground_telemetry::metrics::Metrics;
use uniground_types::keys::{CreatedKey, Key, KeyList, NewKey, Scope};
use uniground_types::numbers::zero_or_more;

/// Characters of a secret by which it is found: `ug_` and eight more.
const PREFIX_CHARS: usize = 11;
const MAX_NAME_CHARS: usize = 200;
/// How often it is written down that a key is used.
const NOTE_USE_EVERY: Duration = Duration::from_mins(1);

/// Who asks.
#[derive(Debug, Clone)]
pub struct Caller {
    /// A key that was made here; none for the server's own, and where none is wanted.
    pub key: Option<Arc<KnownKey>>,
    pub scope: Scope,
}

impl Caller {
    /// Who may do everything: holders of the server's own key, and whoever comes where no key is
    /// wanted.
    #[must_use]
    pub fn operator() -> Self {
        Self { key: None, scope: Scope::Admin }
    }

    #[must_use]
    pub fn key_id(&self) -> Option<&str> {
        self.key.as_ref().map(|key| key.row.id.as_str())
    }

    /// A name somebody chose, as no other caller can have chosen it: nobody gets what another made.
    pub(super) fn own(&self, name: String) -> String {
        match self.key_id() {
            Some(id) => format!("{id}:{name}"),
            None => name,
        }
    }
}

/// A key in use.
#[derive(Debug)]
pub struct KnownKey {
    pub row: KeyRow,
    limit: Option<DefaultDirectRateLimiter<StateInformationMiddleware>>,
    noted: Mutex<Option<Instant>>,
}

/// What is left of a key's requests.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RateLimitStatus {
    pub per_minute: u32,
    pub left: u32,
    /// Until all of it is there again, seconds.
    pub reset_s: u64,
}

/// Why a caller is turned away.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum KeyRejection {
    NoKey,
    UnknownKey,
    Expired,
    Revoked,
    /// A link that was not made here, or not for this path.
    BadLink,
    /// A link whose time is over.
    LinkOver,
}

impl KnownKey {
    fn of(row: KeyRow) -> Arc<Self> {
        let per_minute = row.requests_per_minute.and_then(NonZeroU32::new);
        let limit = per_minute.map(|n| {
            RateLimiter::direct(Quota::per_minute(n))
                .with_middleware::<StateInformationMiddleware>()
        });
        Arc::new(Self { row, limit, noted: Mutex::default() })
    }

    /// Counts a request of this process. `None`: it may come as often as it likes.
    ///
    /// # Errors
    /// How long it has to wait, seconds, and what it may.
    fn count(&self) -> Result<Option<RateLimitStatus>, (u64, RateLimitStatus)> {
        let Some(limit) = &self.limit else { return Ok(None) };
        let per_minute = self.row.requests_per_minute.unwrap_or(1);
        let whole = |wait: Duration| wait.as_secs() + u64::from(wait.subsec_nanos() > 0);
        match limit.check() {
            Ok(state) => {
                let left = state.remaining_burst_capacity();
                let missing = per_minute.saturating_sub(left);
                let reset_s = whole(state.quota().replenish_interval() * missing);
                Ok(Some(RateLimitStatus { per_minute, left, reset_s }))
            }
            Err(not_until) => {
                let wait = whole(not_until.wait_time_from(DefaultClock::default().now())).max(1);
                Err((wait, RateLimitStatus { per_minute, left: 0, reset_s: wait }))
            }
        }
    }

    fn is_expired(&self, now: Timestamp) -> bool {
        // Checked when it was made; what can not be read protects nobody.
        self.row
            .expires_at
            .as_ref()
            .is_some_and(|at| at.parse().map_or(true, |at: Timestamp| at <= now))
    }

    /// Why it is refused, if so.
    pub(super) fn refusal(&self, now: Timestamp) -> Option<KeyRejection> {
        match &self.row.revoked_at {
            Some(_) => Some(KeyRejection::Revoked),
            None => self.is_expired(now).then_some(KeyRejection::Expired),
        }
    }
}

/// All keys. Cheap to clone.
#[derive(Clone)]
pub struct Keyring {
    keys: KeyRepository,
    ids: IdGenerator,
    locks: LockTable,
    /// SHA-256 of the server's own key, from its configuration.
    own: Option<Arc<str>>,
    /// By prefix.
    known: Arc<RwLock<HashMap<String, Arc<KnownKey>>>>,
    link_secret: LinkSecret,
    audit_log: AuditLog,
}

impl Keyring {
    /// With the server's own key, where it has one.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn open(store: &Store, own: Option<&str>) -> Result<Self, Error> {
        let known = store
            .keys
            .all_keys()
            .await?
            .into_iter()
            .map(|row| (row.prefix.clone(), KnownKey::of(row)))
            .collect();
        let own = own.map(|key| hash_of(key).into());
        let audit_log = AuditLog::start(store.keys.audit_writer(), Arc::default());
        Ok(Self {
            keys: store.keys.clone(),
            ids: store.ids.clone(),
            locks: store.locks.clone(),
            own,
            known: Arc::new(RwLock::new(known)),
            link_secret: LinkSecret::random()?,
            audit_log,
        })
    }

    /// Counts audit entries that are dropped in these metrics.
    #[must_use]
    pub fn counted_by(self, metrics: Arc<Metrics>) -> Self {
        let audit_log = AuditLog::start(self.keys.audit_writer(), metrics);
        Self { audit_log, ..self }
    }

    /// Reads anew what other processes may have changed. A key that is as it was keeps the count of
    /// its requests.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn reload(&self) -> Result<(), Error> {
        let rows = self.keys.all_keys().await?;
        let mut known = self.known.write().unwrap_or_else(PoisonError::into_inner);
        for row in rows {
            if known.get(&row.prefix).is_none_or(|key| key.row.revoked_at != row.revoked_at) {
                known.insert(row.prefix.clone(), KnownKey::of(row));
            }
        }
        Ok(())
    }

    /// With a secret that other servers know as well, or that outlives this one: links work there
    /// too.
    #[must_use]
    pub fn with_link_secret(self, link_secret: LinkSecret) -> Self {
        Self { link_secret, ..self }
    }

    /// Whether callers must show a key: from the first one on, for good. Revoking the last one
    /// locks the door, it does not open it.
    #[must_use]
    pub fn is_wanted(&self) -> bool {
        self.own.is_some() || !self.known.read().unwrap_or_else(PoisonError::into_inner).is_empty()
    }

    /// Who shows this.
    ///
    /// # Errors
    /// Why nobody is known by it.
    pub fn caller(&self, presented: Option<&str>) -> Result<Caller, KeyRejection> {
        if !self.is_wanted() {
            return Ok(Caller::operator());
        }
        let presented = presented.ok_or(KeyRejection::NoKey)?;
        let hash = hash_of(presented);
        // First, also where it is the server's own key as well: its limits hold, and it can be
        // revoked.
        let found = presented.get(..PREFIX_CHARS).and_then(|prefix| self.by_prefix(prefix));
        if let Some(key) = found.filter(|key| equal(&key.row.hash, &hash)) {
            return match key.refusal(Timestamp::now()) {
                Some(denied) => Err(denied),
                None => Ok(Caller { scope: key.row.scope, key: Some(key) }),
            };
        }
        match self.own.as_ref().is_some_and(|own| equal(own, &hash)) {
            true => Ok(Caller::operator()),
            false => Err(KeyRejection::UnknownKey),
        }
    }

    fn by_prefix(&self, prefix: &str) -> Option<Arc<KnownKey>> {
        self.known.read().unwrap_or_else(PoisonError::into_inner).get(prefix).cloned()
    }

    /// The caller a stored id means. What was begun for a key that is refused by now is not gone on
    /// with.
    ///
    /// # Errors
    /// Why it is refused.
    pub(super) fn caller_of(&self, key_id: Option<&str>) -> Result<Caller, KeyRejection> {
        let Some(id) = key_id else { return Ok(Caller::operator()) };
        let known = self.known.read().unwrap_or_else(PoisonError::into_inner);
        let key =
            known.values().find(|key| key.row.id == id).cloned().ok_or(KeyRejection::UnknownKey)?;
        match key.refusal(Timestamp::now()) {
            Some(denied) => Err(denied),
            None => Ok(Caller { scope: key.row.scope, key: Some(key) }),
        }
    }

    /// Counts a request of a key, whichever process it came to. `None`: it may come as often as it
    /// likes.
    ///
    /// # Errors
    /// How long it has to wait, seconds, and what it may.
    pub async fn count(
        &self,
        key: &KnownKey,
    ) -> Result<Option<RateLimitStatus>, (u64, RateLimitStatus)> {
        let Some(here) = key.count()? else { return Ok(None) };
        if !self.locks.is_shared() {
            return Ok(Some(here));
        }
        let per_minute = here.per_minute;
        let whole = |seconds: f64| seconds.ceil().max(0.0) as u64;
        match self.keys.count_request(&key.row.id, per_minute).await {
            Ok(Ok(until_full_s)) => {
                let left =
                    ((1.0 - until_full_s / 60.0) * f64::from(per_minute) + 0.001).max(0.0) as u32;
                Ok(Some(RateLimitStatus { per_minute, left, reset_s: whole(until_full_s) }))
            }
            Ok(Err(wait_s)) => {
                let wait_s = whole(wait_s).max(1);
                Err((wait_s, RateLimitStatus { per_minute, left: 0, reset_s: wait_s }))
            }
            // What this process has counted holds all the same.
            Err(error) => {
                tracing::warn!(
                    error = &error as &dyn std::error::Error,
                    "shared rate limit unavailable; limiting by this process only"
                );
                Ok(Some(here))
            }
        }
    }

    /// Notes that a key was shown; once a minute it is written down. Nobody waits for that.
    pub fn note_use(&self, key: &Arc<KnownKey>) {
        let mut noted = key.noted.lock().unwrap_or_else(PoisonError::into_inner);
        if noted.is_some_and(|at| at.elapsed() < NOTE_USE_EVERY) {
            return;
        }
        *noted = Some(Instant::now());
        let (keys, id) = (self.keys.clone(), key.row.id.clone());
        tokio::spawn(async move {
            if let Err(error) = keys.note_key_use(&id, &now()).await {
                tracing::debug!(
                    error = &error as &dyn std::error::Error,
                    "last use of a key could not be recorded"
                );
            }
        });
    }

    /// Makes a key. Its secret is told here and never again.
    ///
    /// # Errors
    /// [`Error::Invalid`]: a name or a limit that is none.
    pub async fn create(&self, new: NewKey) -> Result<CreatedKey, Error> {
        let expires_at = check(&new)?;
        let NewKey { name, scope, expires_at: _, requests_per_minute, max_scenes, daily_usd } = new;
        let secret = new_secret()?;
        let row = KeyRow {
            id: self.ids.new_id(),
            name,
            prefix: secret[..PREFIX_CHARS].to_owned(),
            hash: hash_of(&secret),
            scope,
            expires_at,
            requests_per_minute,
            max_scenes,
            daily_usd,
            created_at: now(),
            last_used_at: None,
            revoked_at: None,
        };
        // A task of its own: whoever asked may leave, and what is stored is known here all the
        // same.
        let (keys, new) = (self.clone(), row.clone());
        let inserted =
            tokio::spawn(
                async move { keys.keys.insert_key(&new).await.inspect(|()| keys.put(new)) },
            );
        inserted.await??;
        Ok(CreatedKey { key: told(row, 0.0), secret })
    }

    /// Keys, newest first.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn list(&self, limit: u32, cursor: Option<&str>) -> Result<KeyList, Error> {
        let (rows, next_cursor) =
            page(self.keys.keys(limit + 1, cursor).await?, limit, |row| &row.id);
        let mut keys = Vec::with_capacity(rows.len());
        for row in rows {
            keys.push(self.present(row).await?);
        }
        Ok(KeyList { keys, next_cursor })
    }

    /// Has a key refused from now on. Its row stays: what was done with it stays readable.
    ///
    /// # Errors
    /// [`Error::KeyNotFound`].
    pub async fn revoke(&self, id: &str) -> Result<Key, Error> {
        let (keys, key_id) = (self.clone(), id.to_owned());
        let revoked = tokio::spawn(async move {
            keys.keys
                .revoke_key(&key_id)
                .await
                .inspect(|row| row.iter().for_each(|row| keys.put(row.clone())))
        });
        let row = revoked.await??.ok_or_else(|| Error::KeyNotFound { id: id.into() })?;
        self.present(row).await
    }

    fn put(&self, row: KeyRow) {
        self.known
            .write()
            .unwrap_or_else(PoisonError::into_inner)
            .insert(row.prefix.clone(), KnownKey::of(row));
    }

    async fn present(&self, row: KeyRow) -> Result<Key, Error> {
        let spent_today_usd = self.keys.spent_by_key(&row.id, &now()[..10]).await?;
        Ok(told(row, spent_today_usd))
    }
}

/// A key as admins see it.
fn told(row: KeyRow, spent_today_usd: f64) -> Key {
    let KeyRow {
        id,
        name,
        prefix,
        hash: _,
        scope,
        expires_at,
        requests_per_minute,
        max_scenes,
        daily_usd,
        ..
    } = row;
    let KeyRow { created_at, last_used_at, revoked_at, .. } = row;
    Key {
        id,
        name,
        prefix,
        scope,
        expires_at,
        requests_per_minute,
        max_scenes,
        daily_usd,
        spent_today_usd,
        created_at,
        last_used_at,
        revoked_at,
    }
}

/// Looks a wanted key over; its expiry as it is kept.
fn check(new: &NewKey) -> Result<Option<String>, Error> {
    if new.name.trim().is_empty()
        || new.name.chars().count() > MAX_NAME_CHARS
        || new.name.chars().any(char::is_control)
    {
        return Err(Error::invalid("/name", format!("a line of 1 to {MAX_NAME_CHARS} characters")));
    }
    if new.requests_per_minute == Some(0) {
        return Err(Error::invalid(
            "/requests_per_minute",
            "must be at least 1; to refuse all of them, revoke the key",
        ));
    }
    new.daily_usd.map_or(Ok(()), |usd| zero_or_more("/daily_usd", usd))?;
    let Some(at) = &new.expires_at else { return Ok(None) };
    let at: Timestamp = at
        .parse()
        .map_err(|_| Error::invalid("/expires_at", "must be a time like 2027-01-31T00:00:00Z"))?;
    if at <= Timestamp::now() {
        return Err(Error::invalid("/expires_at", "must lie ahead"));
    }
    Ok(Some(at.to_string()))
}

fn new_secret() -> Result<String, Error> {
    let mut bytes = [0; 36];
    getrandom::fill(&mut bytes)
        .map_err(|error| Error::Io(std::io::Error::other(error.to_string())))?;
    let (name, secret) = bytes.split_at(4);
    Ok(format!("ug_{}_{}", hex(name), URL_SAFE_NO_PAD.encode(secret)))
}

fn hash_of(secret: &str) -> String {
    hex(&Sha256::digest(secret))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Compares hashes: how long that takes says nothing about where they differ.
fn equal(a: &str, b: &str) -> bool {
    a.len() == b.len()
        && a.bytes().zip(b.bytes()).fold(0, |difference, (a, b)| difference | (a ^ b)) == 0
}

#[cfg(test)]
mod tests {
    use super::*;
    use camino::Utf8Path;

    async fn keyring(folder: &tempfile::TempDir, own: Option<&str>) -> Keyring {
        let store = Store::open(
            Utf8Path::from_path(folder.path()).unwrap(),
            &uniground_storage::Location::Folder,
            &uniground_storage::BlobHome::Folder,
        )
        .await
        .unwrap();
        Keyring::open(&store, own).await.unwrap()
    }

    fn wanted(scope: Scope) -> NewKey {
        NewKey {
            name: "robot".into(),
            scope,
            expires_at: None,
            requests_per_minute: None,
            max_scenes: None,
            daily_usd: None,
        }
    }

    #[tokio::test]
    async fn only_the_key_itself_is_known_until_it_is_revoked() {
        let folder = tempfile::tempdir().unwrap();
        let keys = keyring(&folder, None).await;
        assert_eq!(keys.caller(None).unwrap().scope, Scope::Admin, "nobody has made a key yet");
        let CreatedKey { key, secret } = keys.create(wanted(Scope::Read)).await.unwrap();
        assert!(secret.starts_with(&key.prefix) && secret.len() > 40, "{secret}");
        assert_eq!(keys.caller(None).unwrap_err(), KeyRejection::NoKey);
        assert_eq!(keys.caller(Some(&secret)).unwrap().scope, Scope::Read);
        for wrong in [
            "",
            "ug_",
            &secret[..secret.len() - 1],
            &format!("{secret}x"),
            &key.prefix,
            "ug_0123é56789ab",
        ] {
            assert_eq!(keys.caller(Some(wrong)).unwrap_err(), KeyRejection::UnknownKey, "{wrong}");
        }
        keys.revoke(&key.id).await.unwrap();
        assert_eq!(keys.caller(Some(&secret)).unwrap_err(), KeyRejection::Revoked);
        assert_eq!(
            keys.caller(None).unwrap_err(),
            KeyRejection::NoKey,
            "the last key locks the door"
        );
        // Not even as the server's own.
        drop(keys);
        let both = keyring(&folder, Some(&secret)).await;
        assert_eq!(both.caller(Some(&secret)).unwrap_err(), KeyRejection::Revoked);
        drop(both);
        let data = keyring(&folder, Some("ug_the_servers_own")).await;
        assert_eq!(
            data.caller(Some(&secret)).unwrap_err(),
            KeyRejection::Revoked,
            "nor is it known to the next server"
        );
        assert_eq!(data.caller(Some("ug_the_servers_own")).unwrap().scope, Scope::Admin);
    }

    #[tokio::test]
    async fn a_key_expires_and_has_a_rate() {
        let folder = tempfile::tempdir().unwrap();
        let keys = keyring(&folder, None).await;
        let late =
            NewKey { expires_at: Some("2001-01-01T00:00:00Z".into()), ..wanted(Scope::Read) };
        assert!(keys.create(late).await.unwrap_err().to_string().contains("/expires_at"));
        let mut row = KeyRow {
            expires_at: Some("2001-01-01T00:00:00Z".into()),
            ..row_of(&keys, wanted(Scope::Read)).await
        };
        assert_eq!(
            KnownKey::of(row.clone()).refusal(Timestamp::now()),
            Some(KeyRejection::Expired)
        );
        (row.expires_at, row.requests_per_minute) = (None, Some(2));
        let key = KnownKey::of(row);
        assert_eq!(key.count().unwrap().unwrap().left, 1);
        assert_eq!(key.count().unwrap().unwrap().left, 0);
        let (wait, allowance) = key.count().unwrap_err();
        assert!((1..=30).contains(&wait) && allowance.left == 0, "{wait} {allowance:?}");
    }

    async fn row_of(keys: &Keyring, new: NewKey) -> KeyRow {
        keys.create(new).await.unwrap();
        keys.keys.all_keys().await.unwrap().remove(0)
    }
}
