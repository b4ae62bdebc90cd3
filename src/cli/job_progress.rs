//! Uploads a scan and shows the progress of the upload and of the parse.

use super::hints;
use super::scan_file::ScanFile;
use bytes::Bytes;
use futures::Stream;
use http_body::{Body, Frame, SizeHint};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::fs::File;
use std::io::{self, IsTerminal};
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;
use tokio_util::io::ReaderStream;
use uniground_client::{Client, ClientError};
use uniground_types::job::{Job, JobState};
use uniground_types::placement::FrameChoice;
use uniground_types::scenes::Created;

const SENDING: &str = "{bar:40} {percent:>3}%  {msg:<20} {bytes} of {total_bytes}, {eta} left";
const PARSING: &str = "{bar:40} {percent:>3}%  {msg}";

/// Uploads a scan. `query` holds the query parameters of the API.
///
/// # Errors
/// Returns an error if a file cannot be read, or a [`ClientError`].
pub async fn upload_scan(
    client: &Client,
    scan: &ScanFile,
    query: &[(&str, &str)],
) -> anyhow::Result<Created> {
    let (file, bytes) = scan.bytes()?;
    let bar = progress_bar(bytes, SENDING).with_message("uploading");
    let sent =
        client.upload(reqwest::Body::wrap(UploadBody::new(file, bytes, bar.clone())), query).await;
    bar.finish_and_clear();
    Ok(sent?)
}

/// Adds the frames of a scan to a scene.
///
/// # Errors
/// Returns an error if a file cannot be read, or a [`ClientError`].
pub async fn add_frames(
    client: &Client,
    scan: &ScanFile,
    scene_id: &str,
    world: FrameChoice,
) -> anyhow::Result<Created> {
    let (file, bytes) = scan.bytes()?;
    let bar = progress_bar(bytes, SENDING).with_message("uploading");
    let sent = client
        .add_frames(scene_id, world, reqwest::Body::wrap(UploadBody::new(file, bytes, bar.clone())))
        .await;
    bar.finish_and_clear();
    Ok(sent?)
}

/// Follows a job until it ends: a progress bar on a terminal, otherwise one line per stage.
///
/// # Errors
/// [`ClientError`].
pub async fn follow_job(client: &Client, job_id: &str) -> Result<Job, ClientError> {
    let (bar, mut stage) = (progress_bar(1000, PARSING), None);
    bar.enable_steady_tick(Duration::from_millis(200));
    let job = client
        .follow_job(job_id, |job| {
            update_bar(&bar, job);
            if !io::stderr().is_terminal()
                && stage != job.stage
                && job.stage.is_some()
                && !job.state.is_final()
            {
                stage.clone_from(&job.stage);
                eprintln!("{:>5.1} %  {}", job.progress * 100.0, stage_of(job));
            }
        })
        .await;
    bar.finish_and_clear();
    job
}

/// Returns the result message of a parse.
///
/// # Errors
/// Returns the reason if the parse failed or was cancelled.
pub fn describe_outcome(job: &Job) -> anyhow::Result<String> {
    match (job.state, &job.error) {
        (JobState::Succeeded, _) => Ok(job.message.clone().unwrap_or_default()),
        (_, Some(error)) => Err(hints::ParseFailed(error.clone()).into()),
        (state, None) => anyhow::bail!("the parse was {}", state.as_str()),
    }
}

fn progress_bar(length: u64, template: &str) -> ProgressBar {
    let bar = ProgressBar::with_draw_target(Some(length), ProgressDrawTarget::stderr());
    // The templates are constants; a test checks that they parse.
    if let Ok(style) = ProgressStyle::with_template(template) {
        bar.set_style(style);
    }
    bar
}

fn update_bar(bar: &ProgressBar, job: &Job) {
    let eta = job.eta_s.map_or_else(|| "estimating".to_owned(), |s| format!("{s:.1} s left"));
    bar.set_position((job.progress * 1000.0) as u64);
    bar.set_message(format!("{:<20} {eta}", stage_of(job)));
}

fn stage_of(job: &Job) -> &str {
    match job.state {
        JobState::Queued => "queued",
        _ => job.stage.as_deref().unwrap_or_default(),
    }
}

/// A file as a request body. It has a known length, so that a server without space rejects it
/// before the first byte.
struct UploadBody {
    stream: ReaderStream<tokio::fs::File>,
    left: u64,
    bar: ProgressBar,
}

impl UploadBody {
    fn new(file: File, bytes: u64, bar: ProgressBar) -> Self {
        Self {
            stream: ReaderStream::with_capacity(tokio::fs::File::from_std(file), 256 << 10),
            left: bytes,
            bar,
        }
    }
}

impl Body for UploadBody {
    type Data = Bytes;
    type Error = io::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<io::Result<Frame<Bytes>>>> {
        let chunk = Pin::new(&mut self.stream).poll_next(context);
        if let Poll::Ready(Some(Ok(chunk))) = &chunk {
            self.left = self.left.saturating_sub(chunk.len() as u64);
            self.bar.inc(chunk.len() as u64);
        }
        chunk.map(|chunk| chunk.map(|chunk| chunk.map(Frame::data)))
    }

    fn size_hint(&self) -> SizeHint {
        SizeHint::with_exact(self.left)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_progress_bar_templates_are_valid() {
        assert!(
            [SENDING, PARSING]
                .iter()
                .all(|template| ProgressStyle::with_template(template).is_ok())
        );
    }
}
