//! Chooses the package registries: those configured for pip and npm, or the public ones.
//!
//! Reads only the addresses. An `.npmrc` may also contain tokens, which are ignored.

use crate::packages::{Registries, Registry};
use anyhow::Context;
use camino::Utf8PathBuf;
use reqwest::Url;
use std::fs;

const PYPI: &str = "https://pypi.org/simple";
const NPM: &str = "https://registry.npmjs.org";
/// System-wide configuration file of pip.
const PIP_CONF: &str = "/etc/pip.conf";

/// Returns the registries to use.
///
/// # Errors
/// Returns an error for an invalid address, with the setting that contains it.
pub fn registries() -> anyhow::Result<Registries> {
    let environment = |name: &str| std::env::var(name).ok().filter(|value| !value.is_empty());
    let file = |path: &Utf8PathBuf| fs::read_to_string(path).ok();
    resolve_registries(&environment, &file)
}

/// Finds the registries. `environment` looks up variables and `file` reads a file.
fn resolve_registries(
    environment: &dyn Fn(&str) -> Option<String>,
    file: &dyn Fn(&Utf8PathBuf) -> Option<String>,
) -> anyhow::Result<Registries> {
    let home = environment("HOME").map(Utf8PathBuf::from);
    let below_home = |path: &str| home.as_ref().map(|home| home.join(path));
    let of_user = environment("XDG_CONFIG_HOME")
        .map_or_else(|| below_home(".config"), |folder| Some(folder.into()));
    let pip_files = [
        environment("PIP_CONFIG_FILE").map(Utf8PathBuf::from),
        of_user.map(|folder| folder.join("pip/pip.conf")),
        below_home(".pip/pip.conf"),
        Some(PIP_CONF.into()),
    ];
    let npm_files = [
        Some(".npmrc".into()),
        environment("NPM_CONFIG_USERCONFIG")
            .or_else(|| environment("npm_config_userconfig"))
            .map(Utf8PathBuf::from),
        below_home(".npmrc"),
    ];
    let first = |variables: &[&str],
                 files: &[Option<Utf8PathBuf>],
                 read: &dyn Fn(&str) -> Option<String>| {
        let variables =
            variables.iter().find_map(|name| Some((environment(name)?, (*name).to_owned())));
        variables.or_else(|| {
            files.iter().flatten().find_map(|path| Some((read(&file(path)?)?, path.to_string())))
        })
    };
    let pypi = first(&["PIP_INDEX_URL"], &pip_files, &pip_index_url);
    let npm = first(&["NPM_CONFIG_REGISTRY", "npm_config_registry"], &npm_files, &npm_registry_url);
    Ok(Registries {
        pypi: registry(
            pypi,
            PYPI,
            "Set another index with PIP_INDEX_URL, or index-url in pip.conf",
        )?,
        npm: registry(
            npm,
            NPM,
            "Set another registry with NPM_CONFIG_REGISTRY, or registry in .npmrc",
        )?,
    })
}

fn registry(
    told: Option<(String, String)>,
    public: &str,
    remedy: &str,
) -> anyhow::Result<Registry> {
    let (address, by) =
        told.map_or_else(|| (public.to_owned(), None), |(address, by)| (address, Some(by)));
    // The address may contain a password, so the message does not show it.
    let base = Url::parse(&address).ok().filter(Url::has_host);
    let base = base.with_context(|| {
        format!("{}: invalid registry address", by.as_deref().unwrap_or_default())
    })?;
    let remedy = by.map_or_else(
        || format!("{remedy}."),
        |by| format!("{remedy}. The current one comes from {by}."),
    );
    Ok(Registry { base, remedy })
}

/// Returns `index-url` from the `global` section of a pip configuration.
fn pip_index_url(text: &str) -> Option<String> {
    let mut section = "";
    for line in text.lines().map(str::trim) {
        if let Some(name) = line.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
            section = name.trim();
        } else if let Some((key, value)) = line.split_once(['=', ':'])
            && section == "global"
            && matches!(key.trim(), "index-url" | "index_url")
        {
            return Some(value.trim().to_owned());
        }
    }
    None
}

/// Returns the value of the line `registry=`. Ignores all other lines.
fn npm_registry_url(text: &str) -> Option<String> {
    text.lines().find_map(|line| {
        let (key, value) = line.split_once('=')?;
        (key.trim() == "registry").then(|| value.trim().trim_matches(['"', '\'']).to_owned())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn resolve_for_test(
        variables: &[(&str, &str)],
        files: &[(&str, &str)],
    ) -> anyhow::Result<[String; 2]> {
        let of = |pairs: &[(&str, &str)], wanted: &str| {
            pairs.iter().find(|(name, _)| *name == wanted).map(|(_, value)| (*value).to_owned())
        };
        let told =
            resolve_registries(&|name| of(variables, name), &|path| of(files, path.as_str()))?;
        Ok([told.pypi.base.to_string(), told.npm.base.to_string()])
    }

    #[test]
    fn public_registries_are_the_default() {
        assert_eq!(
            resolve_for_test(&[], &[]).unwrap(),
            ["https://pypi.org/simple", "https://registry.npmjs.org/"]
        );
    }

    #[test]
    fn variables_override_files_and_user_files_override_system_files() {
        let files = [
            (
                "/home/me/.config/pip/pip.conf",
                "[install]\nindex-url = https://no.example/\n[global]\ntimeout: 9\nindex-url = https://user.example/simple\n",
            ),
            ("/etc/pip.conf", "[global]\nindex-url = https://machine.example/simple\n"),
            (
                "/home/me/.npmrc",
                "//host.example/:_authToken=abc\n@scope:registry=https://no.example/\nregistry = \"https://npm.example/\"\n",
            ),
        ];
        let home = ("HOME", "/home/me");
        assert_eq!(
            resolve_for_test(&[home], &files).unwrap(),
            ["https://user.example/simple", "https://npm.example/"]
        );
        let nobody = resolve_for_test(&[], &files).unwrap();
        assert_eq!(nobody, ["https://machine.example/simple", "https://registry.npmjs.org/"]);
        let variables = [
            home,
            ("PIP_INDEX_URL", "https://a.example/simple"),
            ("npm_config_registry", "https://b.example"),
        ];
        assert_eq!(
            resolve_for_test(&variables, &files).unwrap(),
            ["https://a.example/simple", "https://b.example/"]
        );
    }

    #[test]
    fn invalid_addresses_are_reported_without_being_shown() {
        let error =
            resolve_for_test(&[("PIP_INDEX_URL", "me:secret@host")], &[]).unwrap_err().to_string();
        assert!(error.contains("PIP_INDEX_URL") && !error.contains("secret"), "{error}");
    }
}
