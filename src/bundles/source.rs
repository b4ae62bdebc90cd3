//! Where a bundle comes from, as it is written on the command line.

use camino::Utf8PathBuf;
use reqwest::Url;
use std::fmt;
use std::str::FromStr;

/// The source of a bundle.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum BundleSource {
    /// `hub:OWNER/NAME[@REVISION]`: a repository of the Hugging Face hub.
    Hub(HubName),
    /// A folder on this machine.
    Folder(Utf8PathBuf),
    /// The address of a zip file, and its SHA-256 if the fragment `#sha256=…` states it.
    Zip(Url, Option<String>),
}

/// A repository of the hub.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HubName {
    pub owner: String,
    pub name: String,
    /// A branch, a tag or a commit. `None`: the pinned commit, or else `main`.
    pub revision: Option<String>,
}

const HUB: &str = "hub:";
/// Maximum length of an owner's, repository's or revision's name.
const MAX_NAME: usize = 128;

impl BundleSource {
    /// Returns whether a bundle's name on the command line is a source that has to be installed
    /// first. A folder is not: it is used where it is.
    #[must_use]
    pub fn is_remote(text: &str) -> bool {
        text.starts_with(HUB) || text.starts_with("https://") || text.starts_with("http://")
    }

    /// Returns the name of the bundle, unless the user gives another one.
    #[must_use]
    pub fn default_name(&self) -> String {
        let base = match self {
            Self::Hub(HubName { name, .. }) => name,
            Self::Folder(folder) => folder.file_name().unwrap_or("bundle"),
            Self::Zip(url, _) => {
                url.path_segments().and_then(|mut s| s.next_back()).unwrap_or("bundle")
            }
        };
        let base = base.strip_suffix(".zip").unwrap_or(base);
        let allowed =
            |c: char| if c.is_ascii_alphanumeric() || ".-_".contains(c) { c } else { '-' };
        let name: String = base.chars().map(allowed).take(100).collect();
        let name = name.trim_start_matches('.').to_owned();
        if name.is_empty() { "bundle".into() } else { name }
    }

    /// Returns the source without a revision, user name, password and fragment: what identifies it
    /// in `models.lock`.
    #[must_use]
    pub fn identity(&self) -> String {
        match self {
            Self::Hub(HubName { owner, name, .. }) => format!("{HUB}{owner}/{name}"),
            Self::Folder(folder) => folder.to_string(),
            Self::Zip(url, _) => {
                let mut shown = url.clone();
                // Addresses that cannot hold them have none.
                let _none = (shown.set_username(""), shown.set_password(None));
                shown.set_fragment(None);
                shown.set_query(None);
                shown.to_string()
            }
        }
    }
}

impl fmt::Display for BundleSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.identity())?;
        match self {
            Self::Hub(HubName { revision: Some(revision), .. }) => write!(f, "@{revision}"),
            _ => Ok(()),
        }
    }
}

impl FromStr for BundleSource {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if let Some(name) = text.strip_prefix(HUB) {
            return parse_hub(name).map(Self::Hub).ok_or_else(|| {
                format!(
                    "{text:?} is not hub:OWNER/NAME or hub:OWNER/NAME@REVISION; `uniground models \
                     list --known` has names"
                )
            });
        }
        if text.starts_with("https://") || text.starts_with("http://") {
            let mut url = Url::parse(text).map_err(|e| format!("invalid address: {e}"))?;
            if url.host_str().is_some_and(|host| HUB_PAGES.contains(&host)) {
                return page_of_hub(&url).map(Self::Hub).ok_or_else(|| {
                    format!("{text} is not the page of a model: use hub:OWNER/NAME")
                });
            }
            let sha256 = url.fragment().map(parse_sha256).transpose()?;
            url.set_fragment(None);
            return Ok(Self::Zip(url, sha256));
        }
        let folder = Utf8PathBuf::from(text);
        if folder.is_dir() {
            return Ok(Self::Folder(folder));
        }
        Err(match (folder.is_file(), parse_hub(text.rsplit(':').next().unwrap_or(text))) {
            (true, _) => format!("{text} is a file: unpack it, and name the folder"),
            (false, Some(HubName { owner, name, .. })) => {
                format!("there is no folder {text}. From the Hugging Face hub: {HUB}{owner}/{name}")
            }
            (false, None) => format!("there is no folder {text:?}"),
        })
    }
}

/// Hosts whose pages of models are accepted as sources.
const HUB_PAGES: [&str; 2] = ["huggingface.co", "hf.co"];

/// Reads `https://huggingface.co/OWNER/NAME`, with or without `/tree/REVISION`.
fn page_of_hub(url: &Url) -> Option<HubName> {
    let segments: Vec<&str> = url.path_segments()?.filter(|part| !part.is_empty()).collect();
    match segments[..] {
        [owner, name] => parse_hub(&format!("{owner}/{name}")),
        [owner, name, "tree", revision] => parse_hub(&format!("{owner}/{name}@{revision}")),
        _ => None,
    }
}

fn parse_sha256(fragment: &str) -> Result<String, String> {
    fragment
        .strip_prefix("sha256=")
        .filter(|hash| hash.len() == 64 && hash.chars().all(|c| c.is_ascii_hexdigit()))
        .map(str::to_owned)
        .ok_or_else(|| format!("#{fragment}: expected #sha256= and 64 hexadecimal digits"))
}

/// Words of `--masks` and `--encoder`, and files in the folder of bundles.
const RESERVED: [&str; 6] = ["auto", "builtin", "rgbd", "attributes", "none", "models.lock"];

/// Checks the name of a bundle, which becomes the name of its folder.
///
/// # Errors
/// Returns what a name may be.
pub fn check_name(name: &str) -> Result<(), String> {
    let is_plain = (1..=100).contains(&name.len())
        && !name.starts_with('.')
        && name.chars().all(|c| c.is_ascii_alphanumeric() || ".-_".contains(c));
    match is_plain && !RESERVED.contains(&name) {
        true => Ok(()),
        false => Err(format!(
            "{name:?} cannot be the name of a bundle: 1 to 100 letters, digits, dots, dashes and \
             underscores, not a dot first, and none of {}",
            RESERVED.join(", ")
        )),
    }
}

fn parse_hub(text: &str) -> Option<HubName> {
    let text = text.strip_suffix('/').unwrap_or(text);
    let (path, revision) = match text.split_once('@') {
        Some((path, revision)) => (path, Some(revision)),
        None => (text, None),
    };
    let (owner, name) = path.split_once('/')?;
    let is_name = |part: &str, also: &str| {
        (1..=MAX_NAME).contains(&part.len())
            && part
                .chars()
                .all(|c| c.is_ascii_alphanumeric() || "._-".contains(c) || also.contains(c))
            && !part.contains("..")
    };
    let is_valid =
        is_name(owner, "") && is_name(name, "") && revision.is_none_or(|r| is_name(r, "/"));
    is_valid.then(|| HubName {
        owner: owner.into(),
        name: name.into(),
        revision: revision.map(str::to_owned),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sources_are_told_apart() {
        let hub: BundleSource = "hub:Xenova/clip-vit-base-patch16@refs/pr/3".parse().unwrap();
        let BundleSource::Hub(name) = &hub else { panic!("{hub:?}") };
        assert_eq!(
            (name.owner.as_str(), name.name.as_str(), name.revision.as_deref()),
            ("Xenova", "clip-vit-base-patch16", Some("refs/pr/3"))
        );
        assert_eq!(hub.identity(), "hub:Xenova/clip-vit-base-patch16");
        assert_eq!(hub.default_name(), "clip-vit-base-patch16");
        let zip: BundleSource = format!(
            "https://me:secret@host.example/a/My%20SAM.zip?token=1#sha256={}",
            "a".repeat(64)
        )
        .parse()
        .unwrap();
        assert_eq!(zip.to_string(), "https://host.example/a/My%20SAM.zip");
        assert_eq!(zip.default_name(), "My-20SAM");
        let page: BundleSource =
            "https://huggingface.co/Xenova/sam-vit-base/tree/main".parse().unwrap();
        assert_eq!(page.to_string(), "hub:Xenova/sam-vit-base@main");
        let slash: BundleSource = "hub:Xenova/sam-vit-base/".parse().unwrap();
        assert_eq!(slash.to_string(), "hub:Xenova/sam-vit-base");
        let typed = "Xenova/sam-vit-base".parse::<BundleSource>().unwrap_err();
        assert!(typed.ends_with("hub:Xenova/sam-vit-base"), "{typed}");
        let fragment = "https://host.example/a.zip#md5=1".parse::<BundleSource>().unwrap_err();
        assert!(fragment.contains("sha256="), "{fragment}");
        for wrong in ["hub:clip", "hub:a/b/c", "hub:a/..", "hub:a/b@", "hub:a b/c", "hub:/x"] {
            assert!(wrong.parse::<BundleSource>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn names_of_bundles_cannot_lead_elsewhere() {
        for name in ["sam", "clip-vit-base-patch16-q8", "a.b_c"] {
            assert!(check_name(name).is_ok(), "{name}");
        }
        for name in ["", ".", "..", "../x", "/x", "a/b", "a b", ".staging", "auto", "models.lock"] {
            assert!(check_name(name).is_err(), "{name}");
        }
    }
}
