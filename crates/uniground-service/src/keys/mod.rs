//! API keys: callers, their scopes, rate limits and budgets.
//!
//! A key is 32 random bytes, shown once. The server stores its first characters, to look it up, and
//! its hash, to verify it. If no key was ever created and none is configured, callers need no key.

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
use uniground_storage::{IdGenerator, KeyRepository, KeyRow, LockTable, Store, now, split_page};
use uniground_telemetry::metrics::Metrics;
use uniground_types::keys::{CreatedKey, Key, KeyList, NewKey, Scope};
use uniground_types::numbers::check_zero_or_more;

/// The length of the prefix by which a key is looked up: `ug_` and eight more characters.
const PREFIX_CHARS: usize = 11;
const MAX_NAME_CHARS: usize = 200;
/// The interval at which the last use of a key is stored.
const NOTE_USE_EVERY: Duration = Duration::from_mins(1);

/// The caller of a request.
#[derive(Debug, Clone)]
pub struct Caller {
    /// The stored key of the caller. `None` for the server's own key, and where no key is required.
    pub key: Option<Arc<KnownKey>>,
    pub scope: Scope,
}

impl Caller {
    /// Returns a caller with all permissions: a holder of the server's own key, or any caller if no
    /// key is required.
    #[must_use]
    pub fn operator() -> Self {
        Self { key: None, scope: Scope::Admin }
    }

    #[must_use]
    pub fn key_id(&self) -> Option<&str> {
        self.key.as_ref().map(|key| key.row.id.as_str())
    }

    /// Qualifies a name that this caller chose, so that it never equals a name that another caller
    /// chose. A caller cannot reach what another one created.
    pub(super) fn qualify_name(&self, name: String) -> String {
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

/// The remaining requests of a key.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RateLimitStatus {
    pub per_minute: u32,
    pub left: u32,
    /// Seconds until the full limit is available again.
    pub reset_s: u64,
}

/// Why a caller is rejected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum KeyRejection {
    NoKey,
    UnknownKey,
    Expired,
    Revoked,
    /// A link that this server did not sign, or that is for another path.
    BadLink,
    /// A link that has expired.
    LinkExpired,
}

impl KnownKey {
    fn from_row(row: KeyRow) -> Arc<Self> {
        let per_minute = row.requests_per_minute.and_then(NonZeroU32::new);
        let limit = per_minute.map(|n| {
            RateLimiter::direct(Quota::per_minute(n))
                .with_middleware::<StateInformationMiddleware>()
        });
        Arc::new(Self { row, limit, noted: Mutex::default() })
    }

    /// Counts a request in this process. Returns `None` if the key has no rate limit.
    ///
    /// # Errors
    /// The seconds to wait, and the state of the limit.
    fn count_request(&self) -> Result<Option<RateLimitStatus>, (u64, RateLimitStatus)> {
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
        // The time was validated when the key was created. An unreadable time counts as expired.
        self.row
            .expires_at
            .as_ref()
            .is_some_and(|at| at.parse().map_or(true, |at: Timestamp| at <= now))
    }

    /// Returns why the key is refused, if it is.
    pub(super) fn rejection(&self, now: Timestamp) -> Option<KeyRejection> {
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
    /// The keys by prefix.
    known: Arc<RwLock<HashMap<String, Arc<KnownKey>>>>,
    link_secret: LinkSecret,
    audit_log: AuditLog,
}

impl Keyring {
    /// Loads all keys, with the server's own key if one is configured.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn open(store: &Store, own: Option<&str>) -> Result<Self, Error> {
        let known = store
            .keys
            .all_keys()
            .await?
            .into_iter()
            .map(|row| (row.prefix.clone(), KnownKey::from_row(row)))
            .collect();
        let own = own.map(|key| hash_secret(key).into());
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

    /// Counts dropped audit entries in these metrics.
    #[must_use]
    pub fn with_metrics(self, metrics: Arc<Metrics>) -> Self {
        let audit_log = AuditLog::start(self.keys.audit_writer(), metrics);
        Self { audit_log, ..self }
    }

    /// Reloads keys that other processes may have changed. An unchanged key keeps its request
    /// count.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn reload(&self) -> Result<(), Error> {
        let rows = self.keys.all_keys().await?;
        let mut known = self.known.write().unwrap_or_else(PoisonError::into_inner);
        for row in rows {
            if known.get(&row.prefix).is_none_or(|key| key.row.revoked_at != row.revoked_at) {
                known.insert(row.prefix.clone(), KnownKey::from_row(row));
            }
        }
        Ok(())
    }

    /// Uses a secret that other servers share, or that outlives this process. Links work there too.
    #[must_use]
    pub fn with_link_secret(self, link_secret: LinkSecret) -> Self {
        Self { link_secret, ..self }
    }

    /// Returns whether callers must present a key. True for good once the first key exists:
    /// revoking the last key does not open the server to everyone.
    #[must_use]
    pub fn has_keys(&self) -> bool {
        self.own.is_some() || !self.known.read().unwrap_or_else(PoisonError::into_inner).is_empty()
    }

    /// Returns the caller who presents this key.
    ///
    /// # Errors
    /// Why the key is rejected.
    pub fn caller(&self, presented: Option<&str>) -> Result<Caller, KeyRejection> {
        if !self.has_keys() {
            return Ok(Caller::operator());
        }
        let presented = presented.ok_or(KeyRejection::NoKey)?;
        let hash = hash_secret(presented);
        // Stored keys are checked first, even if the same secret is also the server's own key:
        // their limits apply, and they can be revoked.
        let found = presented.get(..PREFIX_CHARS).and_then(|prefix| self.find_by_prefix(prefix));
        if let Some(key) = found.filter(|key| equal_in_constant_time(&key.row.hash, &hash)) {
            return match key.rejection(Timestamp::now()) {
                Some(denied) => Err(denied),
                None => Ok(Caller { scope: key.row.scope, key: Some(key) }),
            };
        }
        match self.own.as_ref().is_some_and(|own| equal_in_constant_time(own, &hash)) {
            true => Ok(Caller::operator()),
            false => Err(KeyRejection::UnknownKey),
        }
    }

    fn find_by_prefix(&self, prefix: &str) -> Option<Arc<KnownKey>> {
        self.known.read().unwrap_or_else(PoisonError::into_inner).get(prefix).cloned()
    }

    /// Returns the caller with a stored key id. Work that was started with a key is not
    /// continued once the key has been revoked or has expired.
    ///
    /// # Errors
    /// Why the key is refused.
    pub(super) fn resolve_caller(&self, key_id: Option<&str>) -> Result<Caller, KeyRejection> {
        let Some(id) = key_id else { return Ok(Caller::operator()) };
        let known = self.known.read().unwrap_or_else(PoisonError::into_inner);
        let key =
            known.values().find(|key| key.row.id == id).cloned().ok_or(KeyRejection::UnknownKey)?;
        match key.rejection(Timestamp::now()) {
            Some(denied) => Err(denied),
            None => Ok(Caller { scope: key.row.scope, key: Some(key) }),
        }
    }

    /// Counts a request of a key over all processes. Returns `None` if the key has no rate limit.
    ///
    /// # Errors
    /// The seconds to wait, and the state of the limit.
    pub async fn count_request(
        &self,
        key: &KnownKey,
    ) -> Result<Option<RateLimitStatus>, (u64, RateLimitStatus)> {
        let Some(here) = key.count_request()? else { return Ok(None) };
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
            // The count of this process still applies.
            Err(error) => {
                tracing::warn!(
                    error = &error as &dyn std::error::Error,
                    "shared rate limit unavailable; limiting by this process only"
                );
                Ok(Some(here))
            }
        }
    }

    /// Records that a key was used. Stores this at most once a minute, in the background.
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

    /// Creates a key. Returns its secret, which is never shown again.
    ///
    /// # Errors
    /// [`Error::Invalid`] for an invalid name or limit.
    pub async fn create(&self, new: NewKey) -> Result<CreatedKey, Error> {
        let expires_at = check(&new)?;
        let NewKey { name, scope, expires_at: _, requests_per_minute, max_scenes, daily_usd } = new;
        let secret = new_secret()?;
        let row = KeyRow {
            id: self.ids.new_id(),
            name,
            prefix: secret[..PREFIX_CHARS].to_owned(),
            hash: hash_secret(&secret),
            scope,
            expires_at,
            requests_per_minute,
            max_scenes,
            daily_usd,
            created_at: now(),
            last_used_at: None,
            revoked_at: None,
        };
        // A separate task: it finishes even if the client disconnects, so that a stored key is
        // always known in memory.
        let (keys, new) = (self.clone(), row.clone());
        let inserted = tokio::spawn(async move {
            keys.keys.insert_key(&new).await.inspect(|()| keys.cache_key(new))
        });
        inserted.await??;
        Ok(CreatedKey { key: to_api_key(row, 0.0), secret })
    }

    /// Lists keys, newest first.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn list(&self, limit: u32, cursor: Option<&str>) -> Result<KeyList, Error> {
        let (rows, next_cursor) =
            split_page(self.keys.keys(limit + 1, cursor).await?, limit, |row| &row.id);
        let mut keys = Vec::with_capacity(rows.len());
        for row in rows {
            keys.push(self.to_key(row).await?);
        }
        Ok(KeyList { keys, next_cursor })
    }

    /// Revokes a key. Its row stays, so that the audit log still shows what was done with it.
    ///
    /// # Errors
    /// [`Error::KeyNotFound`].
    pub async fn revoke(&self, id: &str) -> Result<Key, Error> {
        let (keys, key_id) = (self.clone(), id.to_owned());
        let revoked = tokio::spawn(async move {
            keys.keys
                .revoke_key(&key_id)
                .await
                .inspect(|row| row.iter().for_each(|row| keys.cache_key(row.clone())))
        });
        let row = revoked.await??.ok_or_else(|| Error::KeyNotFound { id: id.into() })?;
        self.to_key(row).await
    }

    fn cache_key(&self, row: KeyRow) {
        self.known
            .write()
            .unwrap_or_else(PoisonError::into_inner)
            .insert(row.prefix.clone(), KnownKey::from_row(row));
    }

    async fn to_key(&self, row: KeyRow) -> Result<Key, Error> {
        let spent_today_usd = self.keys.spending_of_key(&row.id, &now()[..10]).await?;
        Ok(to_api_key(row, spent_today_usd))
    }
}

/// Converts a key to the form that administrators see.
fn to_api_key(row: KeyRow, spent_today_usd: f64) -> Key {
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

/// Validates a new key. Returns its expiry in the stored form.
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
    new.daily_usd.map_or(Ok(()), |usd| check_zero_or_more("/daily_usd", usd))?;
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

fn hash_secret(secret: &str) -> String {
    hex(&Sha256::digest(secret))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Compares hashes in constant time: the duration does not reveal where they differ.
fn equal_in_constant_time(a: &str, b: &str) -> bool {
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
    async fn a_key_is_accepted_until_it_is_revoked() {
        let folder = tempfile::tempdir().unwrap();
        let keys = keyring(&folder, None).await;
        assert_eq!(keys.caller(None).unwrap().scope, Scope::Admin, "no key exists yet");
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
        assert_eq!(keys.caller(None).unwrap_err(), KeyRejection::NoKey, "callers still need a key");
        // The revoked key is also rejected as the server's own key.
        drop(keys);
        let both = keyring(&folder, Some(&secret)).await;
        assert_eq!(both.caller(Some(&secret)).unwrap_err(), KeyRejection::Revoked);
        drop(both);
        let data = keyring(&folder, Some("ug_the_servers_own")).await;
        assert_eq!(
            data.caller(Some(&secret)).unwrap_err(),
            KeyRejection::Revoked,
            "the key stays revoked after a restart"
        );
        assert_eq!(data.caller(Some("ug_the_servers_own")).unwrap().scope, Scope::Admin);
    }

    #[tokio::test]
    async fn keys_expire_and_are_rate_limited() {
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
            KnownKey::from_row(row.clone()).rejection(Timestamp::now()),
            Some(KeyRejection::Expired)
        );
        (row.expires_at, row.requests_per_minute) = (None, Some(2));
        let key = KnownKey::from_row(row);
        assert_eq!(key.count_request().unwrap().unwrap().left, 1);
        assert_eq!(key.count_request().unwrap().unwrap().left, 0);
        let (wait, allowance) = key.count_request().unwrap_err();
        assert!((1..=30).contains(&wait) && allowance.left == 0, "{wait} {allowance:?}");
    }

    async fn row_of(keys: &Keyring, new: NewKey) -> KeyRow {
        keys.create(new).await.unwrap();
        keys.keys.all_keys().await.unwrap().remove(0)
    }
}
