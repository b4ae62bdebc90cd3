//! What a parse's folder holds, by name. The only place that knows.

use crate::error::Error;
use crate::store::Scratch;
use camino::{Utf8Path, Utf8PathBuf};
use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io;
use uniground_core::parse::ParsedScan;
use uniground_core::progress::Progress;
use uniground_core::scene::{Embeddings, FrameIndex, InstanceId, write_cloud_ply, write_instances_ply};
use uniground_core::scene_parsing::evidence::{self, EvidencePicture, Picture};
use uniground_core::scene_parsing::{ParseError, report_pictures};

/// A file a caller can have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ParseFile {
    /// The cloud in its own colours, PLY.
    Cloud,
    /// The cloud coloured by instance, PLY.
    Instances,
    /// What the instances look like: a numpy array; only where an encoder took part.
    Embeddings,
}

impl ParseFile {
    #[must_use]
    pub fn of(self, parse: &Utf8Path) -> Utf8PathBuf {
        parse.join(match self {
            Self::Cloud => "cloud.ply",
            Self::Instances => "instances.ply",
            Self::Embeddings => "embeddings.npy",
        })
    }
}

const NORMS: &str = "embedding_norms.npy";
const VIEWS: &str = "views";

/// An evidence picture of an instance; `view` counts from 0.
pub fn view(parse: &Utf8Path, instance: InstanceId, view: usize, picture: Picture) -> Utf8PathBuf {
    parse.join(VIEWS).join(view_name(instance, view, picture))
}

fn view_name(instance: InstanceId, view: usize, picture: Picture) -> String {
    let kind = match picture {
        Picture::Crop => "crop",
        Picture::Frame => "frame",
    };
    format!("{instance}-{view}-{kind}.jpg")
}

/// A photograph that views are of, as it was taken: pictures for models are drawn from it.
pub fn photograph(parse: &Utf8Path, frame: FrameIndex) -> Utf8PathBuf {
    parse.join(VIEWS).join(format!("photograph-{frame}"))
}

/// What an encoder has seen, where one took part.
///
/// # Errors
/// Unreadable files.
pub async fn read_embeddings(parse: &Utf8Path) -> Result<Option<Embeddings>, Error> {
    match tokio::fs::read(ParseFile::Embeddings.of(parse)).await {
        Ok(rows) => Ok(Some(Embeddings::read(&rows, &tokio::fs::read(parse.join(NORMS)).await?)?)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error.into()),
    }
}

/// Writes everything but the report's pictures: clouds, embeddings, evidence; `progress` is told in the two parts it takes.
///
/// # Errors
/// Those of the file system and of frames; cancellation.
pub fn write(scan: &ParsedScan, folder: &Scratch, writing: &Progress, drawing: &Progress) -> Result<(), Error> {
    let (parsed, parse) = (&scan.scene, folder.path());
    writing.report("write_clouds", 0.0).map_err(ParseError::from)?;
    write_cloud_ply(&parsed.cloud, File::create(ParseFile::Cloud.of(parse))?)?;
    write_instances_ply(parsed, File::create(ParseFile::Instances.of(parse))?)?;
    if let Some(embeddings) = &parsed.embeddings {
        embeddings.write_rows(File::create(ParseFile::Embeddings.of(parse))?)?;
        embeddings.write_norms(File::create(parse.join(NORMS))?)?;
    }
    writing.report("draw_report", 0.5).map_err(ParseError::from)?;
    super::report_files::write(parse, report_pictures::render(parsed, &scan.frames, writing)?)?;
    writing.check().map_err(ParseError::from)?;
    fs::create_dir(parse.join(VIEWS))?;
    let shown: BTreeSet<FrameIndex> = parsed.instances.iter().flat_map(|instance| &instance.views).map(|view| view.frame).collect();
    for frame in scan.frames.iter().filter(|frame| shown.contains(&frame.index)) {
        fs::copy(&frame.colour, photograph(parse, frame.index))?;
    }
    evidence::render(&scan.frames, &parsed.instances, drawing, |EvidencePicture { instance, view: at, picture, jpeg }| {
        Ok::<_, Error>(fs::write(view(parse, instance, at, picture), jpeg)?)
    })
}
