//! Settings of the Hugging Face hub, from the environment variables of its own tools.

use crate::bundles::HubSettings;
use crate::telemetry;
use anyhow::Context;
use camino::Utf8PathBuf;
use reqwest::Url;
use std::fs;

const PUBLIC: &str = "https://huggingface.co";
/// Maximum length of a token's file, bytes.
const MAX_TOKEN_FILE: usize = 4096;

/// Returns the settings of this process.
///
/// # Errors
/// Returns an error for an invalid address, which names the variable.
pub fn hub_settings() -> anyhow::Result<HubSettings> {
    let environment = |name: &str| std::env::var(name).ok().filter(|value| !value.is_empty());
    let file = |path: &Utf8PathBuf| {
        fs::read_to_string(path).ok().filter(|text| text.len() <= MAX_TOKEN_FILE)
    };
    let settings = resolve_hub_settings(&environment, &file)?;
    settings.token.iter().for_each(|token| telemetry::register_secret(token));
    Ok(settings)
}

/// Finds the settings. `environment` looks up variables and `file` reads a file.
fn resolve_hub_settings(
    environment: &dyn Fn(&str) -> Option<String>,
    file: &dyn Fn(&Utf8PathBuf) -> Option<String>,
) -> anyhow::Result<HubSettings> {
    let is_on = |name: &str| {
        environment(name).is_some_and(|value| {
            ["1", "true", "yes", "on"].contains(&value.to_ascii_lowercase().as_str())
        })
    };
    let address = environment("HF_ENDPOINT");
    // The address may contain a password, so the message does not show it.
    let mut endpoint = Url::parse(address.as_deref().unwrap_or(PUBLIC))
        .ok()
        .filter(|url| url.has_host() && matches!(url.scheme(), "http" | "https"))
        .context("HF_ENDPOINT: expected an address such as https://huggingface.co")?;
    endpoint.set_path(&format!("{}/", endpoint.path().trim_end_matches('/')));
    let home = environment("HF_HOME").map(Utf8PathBuf::from).or_else(|| {
        let cache = environment("XDG_CACHE_HOME")
            .map(Utf8PathBuf::from)
            .or_else(|| Some(Utf8PathBuf::from(environment("HOME")?).join(".cache")))?;
        Some(cache.join("huggingface"))
    });
    let below_home = |name: &str| home.as_ref().map(|home| home.join(name));
    let cache = environment("HF_HUB_CACHE")
        .or_else(|| environment("HUGGINGFACE_HUB_CACHE"))
        .map(Utf8PathBuf::from)
        .or_else(|| below_home("hub"));
    let token = environment("HF_TOKEN")
        .or_else(|| environment("HUGGING_FACE_HUB_TOKEN"))
        .or_else(|| {
            let path = environment("HF_TOKEN_PATH")
                .map(Utf8PathBuf::from)
                .or_else(|| below_home("token"))?;
            file(&path)
        })
        .map(|token| token.trim().to_owned())
        .filter(|token| !token.is_empty() && !is_on("HF_HUB_DISABLE_IMPLICIT_TOKEN"));
    Ok(HubSettings { endpoint, token, cache, is_offline: is_on("HF_HUB_OFFLINE") })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn resolve(variables: &[(&str, &str)]) -> anyhow::Result<HubSettings> {
        let of = |wanted: &str| {
            variables.iter().find(|(name, _)| *name == wanted).map(|(_, v)| (*v).to_owned())
        };
        resolve_hub_settings(&of, &|path| {
            (path == "/home/me/.cache/huggingface/token").then(|| "hf_saved\n".to_owned())
        })
    }

    #[test]
    fn variables_of_the_hubs_own_tools_are_read() {
        let saved = resolve(&[("HOME", "/home/me")]).unwrap();
        assert_eq!(saved.endpoint.as_str(), "https://huggingface.co/");
        assert_eq!(saved.token.as_deref(), Some("hf_saved"));
        assert_eq!(saved.cache.unwrap(), "/home/me/.cache/huggingface/hub");
        let set = resolve(&[
            ("HF_ENDPOINT", "https://mirror.example/hub"),
            ("HF_TOKEN", "hf_mine"),
            ("HF_HOME", "/data/hf"),
            ("HF_HUB_OFFLINE", "1"),
        ])
        .unwrap();
        assert_eq!(set.endpoint.as_str(), "https://mirror.example/hub/");
        assert_eq!((set.token.as_deref(), set.is_offline), (Some("hf_mine"), true));
        assert_eq!(set.cache.as_deref().unwrap(), "/data/hf/hub");
        assert!(!format!("{set:?}").contains("hf_mine"), "{set:?}");
        let without =
            resolve(&[("HF_TOKEN", "hf_mine"), ("HF_HUB_DISABLE_IMPLICIT_TOKEN", "1")]).unwrap();
        assert!(without.token.is_none() && without.cache.is_none());
    }

    #[test]
    fn invalid_addresses_are_reported_without_being_shown() {
        for wrong in ["me:secret@host", "ftp://secret.example"] {
            let error = resolve(&[("HF_ENDPOINT", wrong)]).unwrap_err().to_string();
            assert!(error.contains("HF_ENDPOINT") && !error.contains("secret"), "{error}");
        }
    }
}
