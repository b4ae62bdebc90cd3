//! Installs a bundle from its source. Files are brought into a staging folder, which becomes the
//! bundle's folder when all of them are there and verified: a bundle is never half of one revision
//! and half of another, and one that is in use keeps its files.

use super::lock::{Lock, LockedBundle, LockedFile};
use super::origin::Origin;
use super::plan::{Plan, base_name};
use super::source::{BundleSource, HubName, check_name};
use super::{AddError, HubSettings};
use crate::packages::Event;
use camino::{Utf8Path, Utf8PathBuf};
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io;
use std::time::Duration;
use uniground_core::models::neural::bundle::{Bundle, MANIFEST};
use uniground_core::models::neural::layouts::{About, Precision, external_weights};
use uniground_storage::FileLock;

/// How to install bundles.
pub struct AddOptions<'a> {
    /// The folder of bundles.
    pub models: &'a Utf8Path,
    /// Name of the bundle. `None`: that of the repository, folder or file.
    pub name: Option<&'a str>,
    /// `None`: the most exact one that exists.
    pub precision: Option<Precision>,
    /// Whether a revision is looked up again instead of taking the pinned commit.
    pub update: bool,
    pub hub: &'a HubSettings,
    /// Waits between attempts to download.
    pub pause: &'a dyn Fn(Duration),
}

/// An installed bundle.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Added {
    pub name: String,
    pub folder: Utf8PathBuf,
}

/// Largest configuration or tokenizer. They are read into memory; those of large vocabularies have
/// 35 MB.
pub const MAX_JSON_BYTES: u64 = 64 << 20;
/// Folder of bundles that are not complete yet, in the folder of bundles.
const STAGING: &str = ".staging";

/// Installs a bundle. Does nothing if it is installed, and requests nothing then.
///
/// # Errors
/// Returns [`AddError`]. An installed bundle is unchanged then, and what was downloaded is there for
/// the next attempt.
pub fn add(
    source: &BundleSource,
    options: &AddOptions,
    on_event: &mut dyn FnMut(Event),
) -> Result<Added, AddError> {
    let source = &resolved(source)?;
    let lock = Lock::read(options.models)?;
    let name = name_of(source, &lock, options);
    let refused = |why: String| AddError::Source { source_name: source.to_string(), why };
    check_name(&name).map_err(refused)?;
    let folder = options.models.join(&name);
    let pinned = lock.bundles.get(&name).filter(|locked| locked.source == source.identity());
    let pinned_precision = pinned.and_then(|locked| locked.precision);
    if folder.join(MANIFEST).is_file() {
        let is_there = match pinned {
            Some(pinned) => {
                requested(source).is_none_or(|revision| pinned.has_revision(revision))
                    && pinned.missing_file(&folder).is_none()
            }
            // Somebody has copied the folder without the lock.
            None if comes_from(&folder, source) => true,
            None => {
                return Err(refused(format!(
                    "{folder} is another bundle, or another revision of this one. \
                     Choose another name with --as."
                )));
            }
        };
        let another = options.precision.filter(|wanted| pinned_precision != Some(*wanted));
        if let Some(wanted) = another.filter(|_| !options.update) {
            let there = pinned_precision.map_or("another precision", Precision::name);
            return Err(refused(format!(
                "{folder} has {there}. For {wanted} too, choose another name with --as; to replace \
                 it, say --update."
            )));
        }
        if is_there && !options.update {
            on_event(Event::AlreadyInstalled(&folder));
            return Ok(Added { name, folder });
        }
    }
    // A bundle that is gone comes back as it was pinned.
    let options = &AddOptions { precision: options.precision.or(pinned_precision), ..*options };
    let staging = options.models.join(STAGING).join(&name);
    fs::create_dir_all(&staging).map_err(|why| AddError::File { file: staging.clone(), why })?;
    let file = File::open(&staging).map_err(|why| AddError::File { file: staging.clone(), why })?;
    let _guard = FileLock::try_exclusive(file).map_err(|_| AddError::Source {
        source_name: source.to_string(),
        why: format!("another process installs {name}"),
    })?;
    let pinned = pinned.filter(|_| !options.update);
    let mut origin = Origin::open(source, pinned, &staging, options, on_event)?;
    let installation = Installation { source, staging: &staging, installed: &folder };
    let completed = installation.complete(&mut origin, &name, options, on_event);
    if let Err(AddError::Layout { .. }) = &completed {
        // Another attempt would find the same files, which can be large.
        let _gone = fs::remove_dir_all(&staging);
    }
    let locked = completed?;
    publish(&staging, &folder)?;
    on_event(Event::Installed(&folder));
    pin(options.models, &name, locked)?;
    Ok(Added { name, folder })
}

/// Installs every bundle of `models.lock` that is not complete, with the pinned revisions and
/// hashes. One that cannot be installed does not keep the others from it.
///
/// # Errors
/// Returns an error if the lock cannot be read.
pub fn install_locked(
    options: &AddOptions,
    on_event: &mut dyn FnMut(Event),
) -> Result<Vec<Result<Added, AddError>>, AddError> {
    let install = |(name, locked): (String, LockedBundle)| {
        let source = locked
            .source
            .parse()
            .map_err(|why| AddError::Source { source_name: locked.source.clone(), why })?;
        let options = AddOptions { name: Some(&name), precision: locked.precision, ..*options };
        add(&source, &options, on_event)
    };
    Ok(Lock::read(options.models)?.bundles.into_iter().map(install).collect())
}

/// Returns whether the manifest of an installed bundle names this source, at the commit that the
/// source names, if it does.
fn comes_from(folder: &Utf8Path, source: &BundleSource) -> bool {
    Bundle::read(folder).is_ok_and(|bundle| {
        let rest = bundle.manifest.source().strip_prefix(&source.identity());
        rest.is_some_and(|rest| match rest.strip_prefix('@') {
            Some(commit) => requested(source).is_none_or(|wanted| wanted == commit),
            None => rest.is_empty(),
        })
    })
}

/// Returns the source with an absolute path, so that `models.lock` holds from any folder.
fn resolved(source: &BundleSource) -> Result<BundleSource, AddError> {
    match source {
        BundleSource::Folder(folder) => folder
            .canonicalize_utf8()
            .map(BundleSource::Folder)
            .map_err(|why| AddError::File { file: folder.clone(), why }),
        BundleSource::Hub(_) | BundleSource::Zip(..) => Ok(source.clone()),
    }
}

/// Returns the name that the user gives, that the source is installed under, or the source's own.
fn name_of(source: &BundleSource, lock: &Lock, options: &AddOptions) -> String {
    let AddOptions { name, precision, .. } = options;
    let is_meant = |locked: &LockedBundle| {
        locked.source == source.identity()
            && precision.is_none_or(|precision| locked.precision == Some(precision))
    };
    let installed =
        || lock.bundles.iter().find(|(_, locked)| is_meant(locked)).map(|(name, _)| name);
    let own = || match precision {
        None | Some(Precision::Fp32) => source.default_name(),
        Some(precision) => format!("{}-{precision}", source.default_name()),
    };
    name.map(str::to_owned).or_else(|| installed().cloned()).unwrap_or_else(own)
}

/// Returns the revision that a source names.
fn requested(source: &BundleSource) -> Option<&str> {
    match source {
        BundleSource::Hub(HubName { revision, .. }) => revision.as_deref(),
        BundleSource::Folder(_) | BundleSource::Zip(..) => None,
    }
}

/// Removes what attempts of other sources, revisions and precisions have left in a staging folder.
fn remove_others(staging: &Utf8Path, files: &BTreeMap<String, LockedFile>) {
    for entry in staging.read_dir_utf8().into_iter().flatten().flatten() {
        if entry.file_name() != MANIFEST && !files.contains_key(entry.file_name()) {
            // What cannot be removed takes space, but does no harm.
            let _gone = fs::remove_file(entry.path());
        }
    }
}

/// Makes the staging folder the bundle's folder.
fn publish(staging: &Utf8Path, folder: &Utf8Path) -> Result<(), AddError> {
    let failed = |why: io::Error| AddError::File { file: folder.to_owned(), why };
    if folder.exists() {
        let old = Utf8PathBuf::from(format!("{staging}.old"));
        fs::rename(folder, &old).map_err(failed)?;
        fs::rename(staging, folder).map_err(failed)?;
        // A rest takes space, but does no harm.
        let _gone = fs::remove_dir_all(&old);
    } else {
        fs::rename(staging, folder).map_err(failed)?;
    }
    Ok(())
}

/// Adds a bundle to `models.lock`. Other processes may do the same.
fn pin(models: &Utf8Path, name: &str, locked: LockedBundle) -> Result<(), AddError> {
    let _guard = File::open(models)
        .and_then(FileLock::exclusive)
        .map_err(|why| AddError::File { file: models.to_owned(), why })?;
    let mut lock = Lock::read(models)?;
    lock.bundles.insert(name.to_owned(), locked);
    lock.write(models)
}

/// A bundle on its way into its folder.
struct Installation<'a> {
    source: &'a BundleSource,
    staging: &'a Utf8Path,
    /// The bundle's folder, which may hold another revision.
    installed: &'a Utf8Path,
}

impl Installation<'_> {
    /// Brings all files and writes the manifest.
    fn complete(
        &self,
        origin: &mut Origin,
        name: &str,
        options: &AddOptions,
        on_event: &mut dyn FnMut(Event),
    ) -> Result<LockedBundle, AddError> {
        // The staging folder means nothing to people.
        let place = format!("{}/", self.staging);
        let layout = |why: String| AddError::Layout {
            source_name: self.source.to_string(),
            why: why.replace(&place, ""),
        };
        let listed = origin.list()?;
        let own = Plan::of_manifest(origin, &listed, self.staging, on_event)?;
        let plan = match own {
            Some(plan) => plan,
            None => Plan::of_layout(&listed, options.precision).map_err(layout)?,
        };
        on_event(Event::Described {
            source: &self.source.to_string(),
            license: origin.license(),
            bytes: listed
                .iter()
                .filter(|path| plan.includes(path))
                .filter_map(|path| origin.bytes(path))
                .sum(),
        });
        if plan.paths().iter().any(|path| !origin.is_verifiable(path)) {
            on_event(Event::NotVerified { source: &self.source.to_string() });
        }
        let mut files = BTreeMap::new();
        for path in plan.paths() {
            self.bring(origin, &path, &mut files, on_event)?;
        }
        let networks: Vec<String> = plan.networks().iter().map(|path| base_name(path)).collect();
        let weights =
            external_weights(self.staging, &networks).map_err(|e| layout(e.to_string()))?;
        for weights in weights {
            let path = plan.beside_networks(&weights).find(|path| listed.contains(path));
            let path = path.ok_or_else(|| {
                layout(format!("a network keeps weights in {weights:?}, which is not beside it"))
            })?;
            self.bring(origin, &path, &mut files, on_event)?;
        }
        let identity = self.source.identity();
        let revision = origin.revision().map(str::to_owned);
        let about = About {
            name: name.to_owned(),
            licence: origin.license().to_owned(),
            source: match &revision {
                Some(commit) => format!("{identity}@{commit}"),
                None => identity.clone(),
            },
        };
        let precision = plan.precision();
        let manifest = plan.manifest(self.staging, &about).map_err(|e| layout(e.to_string()))?;
        let license = manifest.licence().to_owned();
        Bundle::write(self.staging, manifest).map_err(|e| layout(e.to_string()))?;
        remove_others(self.staging, &files);
        let requested = requested(self.source).map(str::to_owned);
        Ok(LockedBundle { source: identity, requested, revision, precision, license, files })
    }

    /// Brings a file into the staging folder and records it.
    fn bring(
        &self,
        origin: &mut Origin,
        path: &str,
        files: &mut BTreeMap<String, LockedFile>,
        on_event: &mut dyn FnMut(Event),
    ) -> Result<(), AddError> {
        let name = base_name(path);
        let is_json = Utf8Path::new(&name).extension() == Some("json");
        if is_json && origin.bytes(path).is_some_and(|b| b > MAX_JSON_BYTES) {
            return Err(AddError::Layout {
                source_name: self.source.to_string(),
                why: format!("{path} is larger than {} MB", MAX_JSON_BYTES >> 20),
            });
        }
        let to = self.staging.join(&name);
        let sha256 = origin.bring(path, &to, &self.installed.join(&name), on_event)?;
        let bytes = to.metadata().map_err(|why| AddError::File { file: to.clone(), why })?.len();
        files.insert(name, LockedFile { path: path.to_owned(), bytes, sha256 });
        Ok(())
    }
}
