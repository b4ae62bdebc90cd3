//! Links that work without a key. A link states its maker and its expiry. It is signed, together
//! with its path, with a secret of this server.
//!
//! ```text
//! link = <expires, Unix seconds>.<id of the key, "own" or "none">.<HMAC>
//! HMAC = HMAC-SHA-256 of both and the path, hex
//! ```

use super::{Caller, KeyRejection, Keyring, equal_in_constant_time, hex};
use crate::error::Error;
use hmac::{Hmac, KeyInit, Mac};
use jiff::Timestamp;
use sha2::{Digest, Sha256};
use uniground_types::keys::Scope;
use uniground_types::links::{Link, LinkList, LinkRequest};

/// The name of the query parameter.
pub const PARAMETER: &str = "link";
const MAX_PATHS: usize = 500;
const MAX_PATH_CHARS: usize = 500;
const SECONDS: std::ops::RangeInclusive<u32> = 10..=86_400;
/// The suffix of a path for everything below it.
const ALL: &str = "/*";
/// The maker of links created with the server's own key, and where no key is required.
const OWN: &str = "own";
const NONE: &str = "none";

/// The secret that signs links.
#[derive(Clone)]
pub struct LinkSecret(Hmac<Sha256>);

impl LinkSecret {
    /// Derives a secret from any bytes that nobody else knows.
    #[must_use]
    pub fn new(secret: &[u8]) -> Self {
        let mut block = [0; 64];
        block[..32].copy_from_slice(&Sha256::digest(secret));
        Self(Hmac::new(&block.into()))
    }

    /// Generates a random secret. Links signed with it work until the server stops.
    ///
    /// # Errors
    /// [`Error::Io`] if the system provides no random bytes.
    pub fn random() -> Result<Self, Error> {
        let mut secret = [0; 32];
        getrandom::fill(&mut secret)
            .map_err(|error| Error::Io(std::io::Error::other(error.to_string())))?;
        Ok(Self::new(&secret))
    }

    fn sign(&self, path: &str, expires: i64, maker: &str) -> String {
        let mut mac = self.0.clone();
        mac.update(format!("{expires}\n{maker}\n{path}").as_bytes());
        hex(&mac.finalize().into_bytes())
    }
}

impl Keyring {
    /// Creates links to paths. Anyone with a link can read what its maker may read.
    ///
    /// # Errors
    /// [`Error::Invalid`].
    pub fn links(
        &self,
        request: LinkRequest,
        caller: &Caller,
        now: Timestamp,
    ) -> Result<LinkList, Error> {
        let LinkRequest { paths, expires_in_s } = request;
        if !SECONDS.contains(&expires_in_s) {
            return Err(Error::invalid(
                "/expires_in_s",
                format!("must be {} to {}", SECONDS.start(), SECONDS.end()),
            ));
        }
        if !(1..=MAX_PATHS).contains(&paths.len()) {
            return Err(Error::invalid("/paths", format!("must be 1 to {MAX_PATHS} paths")));
        }
        let expires = now.as_second() + i64::from(expires_in_s);
        let maker = match caller.key_id() {
            Some(id) => id,
            None if self.has_keys() => OWN,
            None => NONE,
        };
        let link = |(index, path): (usize, String)| {
            // The path names one resource, or everything below one.
            let is_path = path.strip_prefix("/v1/").is_some_and(|below| {
                let (folder, is_all) =
                    below.strip_suffix(ALL).map_or((below, false), |folder| (folder, true));
                let is_one = folder.contains('/') && !folder.ends_with('/');
                !folder.is_empty() && !folder.contains('*') && (is_one || !is_all)
            });
            if !is_path
                || path.len() > MAX_PATH_CHARS
                || path.contains(['?', '#'])
                || !path.is_ascii()
            {
                let detail = format!(
                    "must be a path below /v1/ without a query, at most {MAX_PATH_CHARS} characters"
                );
                return Err(Error::invalid(format!("/paths/{index}"), detail));
            }
            let token = format!(
                "{expires}.{maker}.{}",
                self.link_secret.sign(&path, expires, &self.signer(maker))
            );
            let url = (!path.ends_with(ALL)).then(|| format!("{path}?{PARAMETER}={token}"));
            let expires_at = Timestamp::from_second(expires).unwrap_or(now).to_string();
            Ok(Link { path, token, url, expires_at })
        };
        Ok(LinkList { links: paths.into_iter().enumerate().map(link).collect::<Result<_, _>>()? })
    }

    /// Returns the maker as it is signed. The signature includes the server's own key, so links
    /// made with it stop working when that key changes.
    fn signer(&self, maker: &str) -> String {
        match &self.own {
            Some(own) if maker == OWN => format!("{OWN} {own}"),
            _ => maker.to_owned(),
        }
    }

    /// Returns the maker of a link to this path, with permission to read.
    ///
    /// # Errors
    /// Why the link is invalid or has expired.
    pub fn caller_of_link(
        &self,
        token: &str,
        path: &str,
        now: Timestamp,
    ) -> Result<Caller, KeyRejection> {
        let mut parts = token.splitn(3, '.');
        let (Some(expires), Some(maker), Some(mac)) = (parts.next(), parts.next(), parts.next())
        else {
            return Err(KeyRejection::BadLink);
        };
        let expires: i64 = expires.parse().map_err(|_| KeyRejection::BadLink)?;
        // A link is signed for the path itself, or for everything below a folder that contains it.
        let folders =
            path.match_indices('/').skip(3).map(|(at, _)| format!("{}{ALL}", &path[..at]));
        let signer = self.signer(maker);
        let is_signed = |path: String| {
            equal_in_constant_time(&self.link_secret.sign(&path, expires, &signer), mac)
        };
        if !std::iter::once(path.to_owned()).chain(folders).any(is_signed) {
            return Err(KeyRejection::BadLink);
        }
        if expires <= now.as_second() {
            return Err(KeyRejection::LinkExpired);
        }
        let caller = match maker {
            NONE if self.has_keys() => return Err(KeyRejection::NoKey),
            OWN if self.own.is_none() => return Err(KeyRejection::BadLink),
            OWN | NONE => Caller::operator(),
            id => self.resolve_caller(Some(id))?,
        };
        Ok(Caller { scope: Scope::Read, ..caller })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use camino::Utf8Path;
    use uniground_storage::Store;
    use uniground_types::keys::NewKey;

    const SCENE: &str = "/v1/scenes/01a1ff70-0000-7000-8000-000000000001";

    fn wanted(paths: &[String]) -> LinkRequest {
        LinkRequest { paths: paths.to_vec(), expires_in_s: 60 }
    }

    #[tokio::test]
    async fn a_link_opens_only_its_path_until_it_expires() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(
            Utf8Path::from_path(folder.path()).unwrap(),
            &uniground_storage::Location::Folder,
            &uniground_storage::BlobHome::Folder,
        )
        .await
        .unwrap();
        let keys = Keyring::open(&store, Some("the servers own key")).await.unwrap();
        let now = Timestamp::from_second(1_700_000_000).unwrap();
        let later = |s: i64| Timestamp::from_second(1_700_000_000 + s).unwrap();
        let new = NewKey {
            name: "page".into(),
            scope: Scope::Write,
            expires_at: None,
            requests_per_minute: None,
            max_scenes: None,
            daily_usd: None,
        };
        let made = keys.create(new).await.unwrap();
        let maker = keys.caller(Some(&made.secret)).unwrap();
        let cloud = format!("{SCENE}/cloud.ply");
        let links =
            keys.links(wanted(&[cloud.clone(), format!("{SCENE}/*")]), &maker, now).unwrap().links;
        assert_eq!(
            (links[0].url.clone(), &links[1].url),
            (Some(format!("{cloud}?link={}", links[0].token)), &None)
        );
        let opens = |token: &str, path: &str, at| {
            keys.caller_of_link(token, path, at)
                .map(|caller| (caller.scope, caller.key_id().map(str::to_owned)))
        };
        let reader = Ok((Scope::Read, Some(made.key.id.clone())));
        assert_eq!(
            opens(&links[0].token, &cloud, later(59)),
            reader,
            "links have the scope read, whatever the scope of their maker"
        );
        assert_eq!(opens(&links[0].token, &cloud, later(60)), Err(KeyRejection::LinkExpired));
        for below in [cloud.clone(), format!("{SCENE}/instances/3/views/0.jpg")] {
            assert_eq!(opens(&links[1].token, &below, now), reader);
        }
        let other = SCENE.replace('1', "2");
        for (token, path) in [
            (links[0].token.clone(), format!("{SCENE}/points.bin")),
            (links[1].token.clone(), SCENE.to_owned()),
            (links[1].token.clone(), format!("{other}/cloud.ply")),
            (links[1].token.clone(), format!("{SCENE}x/cloud.ply")),
            (links[0].token.replacen("17", "18", 1), cloud.clone()),
            (links[0].token.replace(&made.key.id, OWN), cloud.clone()),
            ("1.2".into(), cloud.clone()),
            (String::new(), cloud.clone()),
        ] {
            assert_eq!(opens(&token, &path, now), Err(KeyRejection::BadLink), "{token} {path}");
        }
        keys.revoke(&made.key.id).await.unwrap();
        assert_eq!(
            opens(&links[0].token, &cloud, now),
            Err(KeyRejection::Revoked),
            "a link is rejected once its key is revoked"
        );
    }

    #[tokio::test]
    async fn links_signed_before_keys_existed_are_invalid_afterwards() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(
            Utf8Path::from_path(folder.path()).unwrap(),
            &uniground_storage::Location::Folder,
            &uniground_storage::BlobHome::Folder,
        )
        .await
        .unwrap();
        let keys = Keyring::open(&store, None).await.unwrap();
        let now = Timestamp::now();
        let token = keys
            .links(wanted(&[SCENE.into()]), &Caller::operator(), now)
            .unwrap()
            .links
            .remove(0)
            .token;
        assert!(keys.caller_of_link(&token, SCENE, now).is_ok());
        let new = serde_json::from_str(r#"{"name": "first", "scope": "admin"}"#).unwrap();
        keys.create(new).await.unwrap();
        assert_eq!(keys.caller_of_link(&token, SCENE, now).unwrap_err(), KeyRejection::NoKey);
    }

    #[tokio::test]
    async fn links_are_created_only_for_resource_paths() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(
            Utf8Path::from_path(folder.path()).unwrap(),
            &uniground_storage::Location::Folder,
            &uniground_storage::BlobHome::Folder,
        )
        .await
        .unwrap();
        let keys = Keyring::open(&store, None).await.unwrap();
        let refused = |paths: &[&str], expires_in_s| {
            let paths = paths.iter().map(|&path| path.to_owned()).collect();
            keys.links(LinkRequest { paths, expires_in_s }, &Caller::operator(), Timestamp::now())
                .is_err()
        };
        for path in [
            "",
            "/",
            "/v1/",
            "/v1/*",
            "/v1/scenes/*",
            "/v1/scenes//*",
            "/metrics",
            "/v1/jobs?limit=1",
            "/v1/caf\u{e9}",
        ] {
            assert!(refused(&[path], 60), "{path}");
        }
        assert!(
            refused(&[], 60)
                && refused(&[SCENE], 9)
                && refused(&[SCENE], 86_401)
                && !refused(&[SCENE], 86_400)
        );
    }
}
