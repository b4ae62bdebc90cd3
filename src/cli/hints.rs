//! Adds a last line to errors: a command or setting that helps.

use camino::Utf8Path;
use std::io;
use uniground_client::ClientError;
use uniground_core::ingest::{IngestError, IngestErrorKind};
use uniground_core::models::neural::ModelError;
use uniground_core::scan::ScanError;
use uniground_storage::StoreError;
use uniground_types::job::JobError;

/// A failed parse, with the error of its job.
#[derive(Debug, thiserror::Error)]
#[error("the scan could not be parsed: {} ({})", .0.detail, .0.code)]
pub struct ParseFailed(pub JobError);

/// Problem codes that are caused by the scan itself.
const OF_SCANS: [&str; 16] = [
    "archive_unreadable",
    "archive_entry_unsafe",
    "unknown_layout",
    "layout_incomplete",
    "scene_file_malformed",
    "scene_file_missing",
    "intrinsics_missing",
    "intrinsics_invalid",
    "frame_count_mismatch",
    "pose_invalid",
    "cloud_empty",
    "scene_empty",
    "no_usable_frames",
    "frame_unreadable",
    "convention_mismatch",
    "scan_too_costly",
];

/// Adds a hint to the most common errors.
pub fn with_help(error: anyhow::Error) -> anyhow::Error {
    if let Some(help) = local_help(&error) {
        return with_last_line(&error, help);
    }
    match error.chain().find_map(|cause| cause.downcast_ref::<ClientError>()) {
        Some(ClientError::Transport(transport)) if transport.is_connect() => {
            // The origin leaves out a password in the address.
            let address = transport
                .url()
                .map_or_else(|| "this address".into(), |url| url.origin().ascii_serialization());
            let why = error.chain().last().map(ToString::to_string).unwrap_or_default();
            let help = "Is it running? `uniground serve` starts one. For another address, use \
                        --server, or UNIGROUND_SERVER";
            anyhow::anyhow!("cannot connect to the server at {address}: {why}\n{help}")
        }
        Some(ClientError::Problem(problem)) if problem.status == 401 => {
            let help =
                match std::env::var_os("UNIGROUND_API_KEY").is_some_and(|key| !key.is_empty()) {
                    true => "this server does not accept the key in UNIGROUND_API_KEY",
                    false => "set UNIGROUND_API_KEY to your key",
                };
            with_last_line(
                &error,
                &format!("{help}; an administrator can create one with `uniground key create`"),
            )
        }
        Some(ClientError::Problem(problem)) if problem.code == "scope_missing" => with_last_line(
            &error,
            "an administrator can create a key with more rights: `uniground key create NAME \
             --scope write`",
        ),
        Some(ClientError::Problem(problem)) if problem.code == "scene_not_found" => {
            with_last_line(&error, "`uniground scenes` lists all scenes")
        }
        Some(ClientError::BadAddress(_)) => with_last_line(
            &error,
            "the address must look like http://127.0.0.1:8080. Set it with --server, or \
             UNIGROUND_SERVER",
        ),
        Some(ClientError::Unexpected { .. }) => with_last_line(
            &error,
            "Is this a uniground server? For another address, use --server, or UNIGROUND_SERVER",
        ),
        _ => error,
    }
}

/// Returns a hint for errors of this machine.
fn local_help(error: &anyhow::Error) -> Option<&'static str> {
    error.chain().find_map(|cause| {
        if let Some(error) = cause.downcast_ref::<io::Error>()
            && error.kind() == io::ErrorKind::AddrInUse
        {
            return Some(
                "another program uses this port. Stop it, or choose another port with --listen, \
                 for example --listen 127.0.0.1:8081",
            );
        }
        match (cause.downcast_ref(), cause.downcast_ref()) {
            (Some(StoreError::InUse), _) => {
                Some("stop that server, or choose another folder with --data-dir")
            }
            (_, Some(ModelError::NoLibrary { .. })) => {
                Some("`uniground models fetch` downloads it, with the default models")
            }
            _ => None,
        }
    })
}

/// Adds the name of the scan and a hint to an error about it.
pub fn with_scan_hint(error: anyhow::Error, scan: &Utf8Path) -> anyhow::Error {
    let code = error.chain().find_map(|cause| match (cause.downcast_ref(), cause.downcast_ref()) {
        (Some(ClientError::Problem(problem)), _) => Some(problem.code.as_str()),
        (_, Some(ParseFailed(job))) => Some(job.code.as_str()),
        _ => None,
    });
    let local =
        error.chain().find_map(|cause| match (cause.downcast_ref(), cause.downcast_ref()) {
            (Some(ScanError::Ingest(ingest)), _) | (_, Some(ingest)) => Some(ingest),
            _ => None,
        });
    let is_named = error.to_string().contains(scan.as_str());
    let ended = |help: &str| match is_named {
        true => with_last_line(&error, help),
        false => anyhow::anyhow!("{scan}: {error:#}\n{help}"),
    };
    match (code, local.map(IngestError::kind)) {
        (Some("up_unknown"), _) | (_, Some(IngestErrorKind::UpUnknown)) => {
            ended("on the command line: --up and the axis of the files that points up")
        }
        (Some("unit_unknown"), _) | (_, Some(IngestErrorKind::UnitUnknown)) => {
            ended("on the command line: --metres-per-unit and the length of a unit")
        }
        (None, None | Some(IngestErrorKind::Cancelled)) => error,
        (Some(code), _) if !OF_SCANS.contains(&code) => error,
        _ => ended(&format!(
            "`uniground import {} --check` shows how the scan is read and what is wrong with it",
            quote_for_shell(scan.as_str())
        )),
    }
}

/// Appends a hint as the last line of an error.
pub fn with_last_line(error: &anyhow::Error, help: &str) -> anyhow::Error {
    anyhow::anyhow!("{error:#}\n{help}")
}

/// Quotes a word for a shell, if needed.
pub fn quote_for_shell(word: &str) -> String {
    let is_plain = |c: char| c.is_alphanumeric() || "-_./:@%+=,".contains(c);
    match !word.is_empty() && word.chars().all(is_plain) {
        true => word.to_owned(),
        false => format!("'{}'", word.replace('\'', r"'\''")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_port_in_use_and_a_folder_in_use_say_what_to_do() {
        let port = anyhow::Error::from(io::Error::from(io::ErrorKind::AddrInUse));
        let port = with_help(port.context("cannot listen on 127.0.0.1:8080")).to_string();
        assert!(port.starts_with("cannot listen") && port.contains("--listen"), "{port}");
        let folder = with_help(StoreError::InUse.into()).to_string();
        assert!(folder.contains("--data-dir"), "{folder}");
    }

    #[test]
    fn words_are_quoted_for_the_shell() {
        assert_eq!(quote_for_shell("scans/room-1.zip"), "scans/room-1.zip");
        assert_eq!(quote_for_shell("living room"), "'living room'");
        assert_eq!(quote_for_shell("Anna's"), r"'Anna'\''s'");
    }
}
