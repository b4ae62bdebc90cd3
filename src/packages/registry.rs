//! Finds the address of an archive in a registry, with the requests of the registry's own tool.

use super::{FetchError, Package, Source, describe_error};
use reqwest::blocking::{Client, Response};
use reqwest::header::{ACCEPT, CONTENT_TYPE};
use reqwest::{StatusCode, Url};
use serde::Deserialize;
use std::collections::HashMap;
use std::io::{self, Read};

/// Maximum size of an index. Real ones have a few hundred kilobytes.
const MAX_INDEX_BYTES: u64 = 64 << 20;
/// Python's index as JSON (PEP 691), with a page of links (PEP 503) as the fallback.
const PYPI_ACCEPTS: &str = "application/vnd.pypi.simple.v1+json, text/html;q=0.5";
/// The media type that npm requests: only versions and addresses.
const NPM_ACCEPTS: &str = "application/vnd.npm.install-v1+json, application/json;q=0.8";

/// A registry of packages.
#[derive(Debug, Clone)]
pub struct Registry {
    /// Its address.
    pub base: Url,
    /// What to do when it cannot be used, as a sentence.
    pub remedy: String,
}

/// The configured registries, one of each kind.
#[derive(Debug, Clone)]
pub struct Registries {
    pub pypi: Registry,
    pub npm: Registry,
}

/// The used fields of Python's index of a package.
#[derive(Deserialize)]
struct PypiIndex {
    files: Vec<PypiFile>,
}

#[derive(Deserialize)]
struct PypiFile {
    filename: String,
    url: String,
}

/// The used fields of npm's description of a package.
#[derive(Deserialize)]
struct NpmIndex {
    versions: HashMap<String, NpmVersion>,
}

#[derive(Deserialize)]
struct NpmVersion {
    dist: NpmDist,
}

#[derive(Deserialize)]
struct NpmDist {
    tarball: String,
}

impl Registries {
    /// Returns the registry that hosts a package.
    pub(super) fn registry_of(&self, package: &Package) -> &Registry {
        match package.source {
            Source::PyPi => &self.pypi,
            Source::Npm => &self.npm,
        }
    }
}

impl Registry {
    /// Returns the address for display: without user name and password.
    fn display_address(&self) -> String {
        let mut shown = self.base.clone();
        // Addresses that cannot hold them have none.
        let _none = (shown.set_username(""), shown.set_password(None));
        shown.set_query(None);
        shown.as_str().trim_end_matches('/').to_owned()
    }

    pub(super) fn unreachable(&self, package: &Package, why: String) -> FetchError {
        FetchError::Unreachable {
            package: package.to_string(),
            address: self.display_address(),
            why,
            remedy: self.remedy.clone(),
        }
    }

    fn not_listed(&self, package: &Package) -> FetchError {
        let archive = package.archive.to_owned();
        FetchError::NotListed {
            package: package.to_string(),
            address: self.display_address(),
            archive,
            remedy: self.remedy.clone(),
        }
    }

    /// Returns the address of a package's archive.
    ///
    /// # Errors
    /// Returns an error when the registry is unreachable or does not have the package.
    pub(super) fn address_of(&self, package: &Package, client: &Client) -> Result<Url, FetchError> {
        let (page, accepts) = match package.source {
            Source::PyPi => (format!("{}/", package.name), PYPI_ACCEPTS),
            // The slash between a scope and a name is part of the name.
            Source::Npm => (package.name.replace('/', "%2F"), NPM_ACCEPTS),
        };
        let page =
            self.url_below(&page).ok_or_else(|| self.unreachable(package, "invalid URL".into()))?;
        let asked = client
            .get(page)
            .header(ACCEPT, accepts)
            .send()
            .map_err(|e| self.unreachable(package, describe_error(e)))?;
        if asked.status() == StatusCode::NOT_FOUND {
            return Err(self.not_listed(package));
        }
        let answer =
            asked.error_for_status().map_err(|e| self.unreachable(package, describe_error(e)))?;
        let from = answer.url().clone();
        let link = read(answer, package).map_err(|why| {
            self.unreachable(package, format!("its response cannot be read: {why}"))
        })?;
        let address =
            link.and_then(|link| from.join(&link).ok()).ok_or_else(|| self.not_listed(package))?;
        Ok(self.with_password(address))
    }

    fn url_below(&self, page: &str) -> Option<Url> {
        let mut base = self.base.clone();
        let path = format!("{}/", base.path().trim_end_matches('/'));
        base.set_path(&path);
        base.join(page).ok()
    }

    /// Adds the user name and password of the registry's address, if any, to an archive's address
    /// on the registry's own host.
    fn with_password(&self, mut address: Url) -> Url {
        if address.origin() == self.base.origin() && address.username().is_empty() {
            let _kept = (
                address.set_username(self.base.username()),
                address.set_password(self.base.password()),
            );
        }
        address
    }
}

/// Returns the link to the archive in a registry's response, if it contains one.
fn read(answer: Response, package: &Package) -> io::Result<Option<String>> {
    let is_json = answer
        .headers()
        .get(CONTENT_TYPE)
        .and_then(|kind| kind.to_str().ok())
        .is_some_and(|kind| kind.contains("json"));
    let mut text = String::new();
    answer.take(MAX_INDEX_BYTES).read_to_string(&mut text)?;
    Ok(match package.source {
        Source::PyPi if is_json => {
            let index: PypiIndex = serde_json::from_str(&text)?;
            index
                .files
                .into_iter()
                .find(|file| file.filename == package.archive)
                .map(|file| file.url)
        }
        Source::PyPi => link_on_page(&text, package.archive),
        Source::Npm => {
            let mut index: NpmIndex = serde_json::from_str(&text)?;
            index.versions.remove(package.version).map(|version| version.dist.tarball)
        }
    })
}

/// Returns the target of the link whose path ends with a file's name.
fn link_on_page(page: &str, file: &str) -> Option<String> {
    let targets = page.split("href=").skip(1).filter_map(|rest| {
        let quote = rest.chars().next().filter(|c| matches!(c, '"' | '\''))?;
        rest[1..].split(quote).next()
    });
    let of_file = |target: &&str| {
        target.split(['#', '?']).next().and_then(|path| path.rsplit('/').next()) == Some(file)
    };
    targets.into_iter().find(of_file).map(|target| target.replace("&amp;", "&"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_on_an_index_page_are_found() {
        let page = r#"<a href="../../x/lib-1.0-any.whl.metadata">m</a><a data-x="1" href="../../x/lib-1.0-any.whl?a=1&amp;b=2#sha256=00">lib-1.0-any.whl</a>
            <a href='/y/lib-2.0-any.whl'>lib-2.0-any.whl</a>"#;
        assert_eq!(
            link_on_page(page, "lib-1.0-any.whl").as_deref(),
            Some("../../x/lib-1.0-any.whl?a=1&b=2#sha256=00")
        );
        assert_eq!(link_on_page(page, "lib-2.0-any.whl").as_deref(), Some("/y/lib-2.0-any.whl"));
        assert_eq!(link_on_page(page, "lib-3.0-any.whl"), None);
    }

    #[test]
    fn credentials_stay_with_their_host_and_are_not_shown() {
        let registry = Registry {
            base: Url::parse("https://me:secret@host.example/simple?key=secret").unwrap(),
            remedy: String::new(),
        };
        assert_eq!(registry.display_address(), "https://host.example/simple");
        let own = registry.with_password(Url::parse("https://host.example/files/a.whl").unwrap());
        assert_eq!(own.as_str(), "https://me:secret@host.example/files/a.whl");
        let other = registry.with_password(Url::parse("https://files.example/a.whl").unwrap());
        assert_eq!(other.as_str(), "https://files.example/a.whl");
    }
}
