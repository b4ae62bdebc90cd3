//! Errors end with the command that helps: a last line, for somebody who does not know the manual
//! by heart.

use camino::Utf8Path;
use uniground_client::ClientError;
use uniground_core::ingest::{IngestError, IngestErrorKind};
use uniground_core::scan::ScanError;
use uniground_types::job::JobError;

/// A parse that failed, as its job tells.
#[derive(Debug, thiserror::Error)]
#[error("the scan could not be parsed: {} ({})", .0.detail, .0.code)]
pub struct ParseFailed(pub JobError);

/// Codes of problems that are the scan's own: what a service says of one it can not read.
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

/// An error with what helps, where it is one of those that everybody meets.
pub fn with_help(error: anyhow::Error) -> anyhow::Error {
    match error.chain().find_map(|cause| cause.downcast_ref::<ClientError>()) {
        Some(ClientError::Transport(transport)) if transport.is_connect() => {
            // A password in the address is no part of the origin.
            let address = transport
                .url()
                .map_or_else(|| "this address".into(), |url| url.origin().ascii_serialization());
            let why = error.chain().last().map(ToString::to_string).unwrap_or_default();
            let help = "is it running? `uniground serve` starts one; one at another address: --server, or UNIGROUND_SERVER";
            anyhow::anyhow!("no server answers at {address}: {why}\n{help}")
        }
        Some(ClientError::Problem(problem)) if problem.status == 401 => {
            let help =
                match std::env::var_os("UNIGROUND_API_KEY").is_some_and(|key| !key.is_empty()) {
                    true => "the key in UNIGROUND_API_KEY is none that this server takes",
                    false => "set UNIGROUND_API_KEY to your key",
                };
            with_last_line(
                &error,
                &format!("{help}; `uniground key create` makes one, with an admin's key"),
            )
        }
        Some(ClientError::Problem(problem)) if problem.code == "scope_missing" => with_last_line(
            &error,
            "`uniground key create NAME --scope write` makes a key that may more, with an admin's key",
        ),
        Some(ClientError::Problem(problem)) if problem.code == "scene_not_found" => {
            with_last_line(&error, "`uniground scenes` lists what there is")
        }
        Some(ClientError::BadAddress(_)) => with_last_line(
            &error,
            "an address is like http://127.0.0.1:8080: --server, or UNIGROUND_SERVER",
        ),
        Some(ClientError::Unexpected { .. }) => with_last_line(
            &error,
            "is this a server of uniground? another address: --server, or UNIGROUND_SERVER",
        ),
        _ => error,
    }
}

/// What is wrong with a scan, which scan, and how more is learned of it.
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
            with_last_line("say which axis of the files points up: --up z, or x, y, -x, -y, -z")
        }
        (None, None | Some(IngestErrorKind::Cancelled)) => error,
        (Some(code), _) if !OF_SCANS.contains(&code) => error,
        _ => with_last_line(&format!(
            "`uniground import {} --check` tells how a scan is read, and what is wrong with it",
            quote_for_shell(scan.as_str())
        )),
    }
}

/// An error whose last line is what helps.
pub fn with_last_line(error: &anyhow::Error, help: &str) -> anyhow::Error {
    anyhow::anyhow!("{error:#}\n{help}")
}

/// A word as a shell takes it for one.
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
    fn words_are_quoted_for_the_shell() {
        assert_eq!(quote_for_shell("scans/room-1.zip"), "scans/room-1.zip");
        assert_eq!(quote_for_shell("living room"), "'living room'");
        assert_eq!(quote_for_shell("Anna's"), r"'Anna'\''s'");
    }
}
