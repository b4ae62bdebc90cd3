//! The names of the files in a parse's folder. No other module knows them.

use crate::error::Error;
use camino::{Utf8Path, Utf8PathBuf};
use image::RgbImage;
use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io;
use uniground_geometry::progress::Progress;
use uniground_geometry::scene::{
    Embeddings, FrameEmbeddings, FrameIndex, FrameRef, InstanceId, write_cloud_ply,
    write_even_points, write_instances_ply,
};
use uniground_parsing::evidence::Picture;
use uniground_parsing::observation::{Observation, observe};
use uniground_parsing::scan::{ImportedScan, ParsedScan};
use uniground_parsing::{ParseError, report_pictures};
use uniground_render::{RenderScene, encode_jpeg};
use uniground_storage::{Blobs, Scratch};

/// A file of a parse that callers can download.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ParseFile {
    /// The cloud in its own colors, PLY.
    Cloud,
    /// The cloud colored by instance, PLY.
    Instances,
    /// The cloud in an order of which every prefix is an even sample, with the instances of its
    /// points. Missing in parses of versions that did not store it.
    Points,
    /// A small picture of the room from above. Missing in parses of versions that did not store it.
    Thumbnail,
    /// The embeddings of the instances as a numpy array. Present only if an encoder was used.
    Embeddings,
}

impl ParseFile {
    #[must_use]
    pub fn path_in(self, parse: &Utf8Path) -> Utf8PathBuf {
        parse.join(match self {
            Self::Cloud => "cloud.ply",
            Self::Instances => "instances.ply",
            Self::Points => "points.bin",
            Self::Thumbnail => "thumbnail.jpg",
            Self::Embeddings => "embeddings.npy",
        })
    }
}

const NORMS: &str = "embedding_norms.npy";
const SHARED: &str = "embedding_shared.npy";
const FRAME_EMBEDDINGS: [&str; 2] = ["frame_embeddings.npy", "frame_embeddings_of.npy"];
const VIEWS: &str = "views";
const FRAMES: &str = "frames.json";
const OBSERVATION: &str = "observation.json";

/// Returns the path of an evidence picture of an instance. Only parses of earlier versions store
/// such pictures. Newer ones are drawn on request. `view` counts from 0.
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

/// Returns the path of a photograph that views refer to, as a pinhole picture. Pictures for models
/// are drawn from it.
pub fn photograph(parse: &Utf8Path, frame: FrameIndex) -> Utf8PathBuf {
    parse.join(VIEWS).join(format!("photograph-{frame}"))
}

/// Reads a frame's color picture as a pinhole picture: the one stored with the parse, or the scan's
/// own. Returns `None` and logs a warning if it cannot be read.
pub fn read_photograph(
    blobs: &Blobs,
    parse: &Utf8Path,
    content: &Utf8Path,
    frame: FrameIndex,
) -> Option<RgbImage> {
    let kept = photograph(parse, frame);
    let picture = match none_if_missing(blobs.pin_file(parse, &kept)) {
        Ok(Some(file)) if file.exists() => fs::read(&file)
            .map_err(|error| error.to_string())
            .and_then(|bytes| image::load_from_memory(&bytes).map_err(|error| error.to_string()))
            .map(image::DynamicImage::into_rgb8),
        Ok(_) => {
            let frames = read_frames(blobs, parse, content).ok()??;
            let frame = frames.into_iter().find(|of| of.index == frame)?;
            let color = blobs.pin_file(content, &frame.color).map_err(|error| error.to_string());
            color.and_then(|_color| frame.decode_color().map_err(|error| error.to_string()))
        }
        Err(error) => Err(error.to_string()),
    };
    picture.inspect_err(|error| tracing::warn!(%kept, error, "photograph could not be read")).ok()
}

/// Reads the frames of a parse, with their picture files in the content's folder. Returns `None`
/// for parses of versions that did not store frames.
///
/// # Errors
/// An unreadable file.
pub fn read_frames(
    blobs: &Blobs,
    parse: &Utf8Path,
    content: &Utf8Path,
) -> Result<Option<Vec<FrameRef>>, Error> {
    let Some(bytes) = read(blobs, parse, FRAMES)? else { return Ok(None) };
    let kept: Vec<FrameRef> = serde_json::from_slice(&bytes)?;
    Ok(Some(kept.into_iter().map(|frame| frame.with_paths(|path| content.join(path))).collect()))
}

/// Paths are stored relative to the content, because its folder may move.
fn write_frames(frames: &[FrameRef], content: &Utf8Path, parse: &Utf8Path) -> Result<(), Error> {
    let relative = |path: &Utf8Path| path.strip_prefix(content).unwrap_or(path).to_owned();
    let kept: Vec<FrameRef> =
        frames.iter().map(|frame| frame.clone().with_paths(relative)).collect();
    Ok(fs::write(parse.join(FRAMES), serde_json::to_vec(&kept)?)?)
}

/// Reads what the frames of a parse saw. Returns an empty observation for parses of versions that
/// did not store it, and logs a warning if the file is damaged.
///
/// # Errors
/// An unreadable file.
pub fn read_observation(blobs: &Blobs, parse: &Utf8Path) -> io::Result<Observation> {
    let Some(bytes) = read(blobs, parse, OBSERVATION)? else { return Ok(Observation::default()) };
    Ok(serde_json::from_slice(&bytes).unwrap_or_else(|error| {
        tracing::warn!(%parse, %error, "observation is damaged; answers say nothing about unseen parts of the room");
        Observation::default()
    }))
}

/// Reads the embeddings, if an encoder was used.
///
/// # Errors
/// Unreadable files.
pub fn read_embeddings(blobs: &Blobs, parse: &Utf8Path) -> Result<Option<Embeddings>, Error> {
    let Some(rows) = read(blobs, parse, ParseFile::Embeddings.path_in(parse))? else {
        return Ok(None);
    };
    let norms = fs::read(blobs.pin_file(parse, NORMS.into())?)?;
    let shared = read(blobs, parse, SHARED)?;
    Ok(Some(Embeddings::read(&rows, &norms, shared.as_deref())?))
}

/// Reads the encoder's embeddings of whole frames. Also returns `None` for parses of versions that
/// did not store them.
///
/// # Errors
/// Unreadable files.
pub fn read_frame_embeddings(
    blobs: &Blobs,
    parse: &Utf8Path,
) -> Result<Option<FrameEmbeddings>, Error> {
    let [rows, frames] = FRAME_EMBEDDINGS;
    let Some(rows) = read(blobs, parse, rows)? else { return Ok(None) };
    Ok(Some(FrameEmbeddings::read(&rows, &fs::read(blobs.pin_file(parse, frames.into())?)?)?))
}

/// Reads a file of a published folder. Returns `None` if the folder was published without it.
/// Blocks.
///
/// # Errors
/// An unreadable file; an unavailable object store.
pub fn read(
    blobs: &Blobs,
    folder: &Utf8Path,
    file: impl AsRef<Utf8Path>,
) -> io::Result<Option<Vec<u8>>> {
    none_if_missing(blobs.pin_file(folder, file.as_ref()).and_then(fs::read))
}

fn none_if_missing<T>(got: io::Result<T>) -> io::Result<Option<T>> {
    match got {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        got => got.map(Some),
    }
}

/// Returns the path of a scan's cloud while its first parse runs, given its checkpoints.
#[must_use]
pub fn draft_points(checkpoints: &Utf8Path) -> Utf8PathBuf {
    checkpoints.join("draft_points.bin")
}

/// Writes the cloud of an imported scan in the format of [`ParseFile::Points`], without instances.
///
/// # Errors
/// Errors of the file system.
pub fn write_draft(scan: &ImportedScan, blobs: &Blobs, draft: &Utf8Path) -> io::Result<()> {
    let (cloud, scratch) = (scan.cloud(), blobs.scratch()?);
    let unfinished = scratch.path().join("points");
    let no_instances = vec![InstanceId::default(); cloud.len()];
    write_even_points(cloud, &no_instances, File::create(&unfinished)?)?;
    // Readers see the whole file or none.
    fs::rename(unfinished, draft)
}

/// Writes the files of a parse: clouds, embeddings, pictures of the report, and the photographs
/// that evidence is drawn from.
///
/// # Errors
/// Errors of the file system and of frames; cancellation.
pub fn write(
    scan: &ParsedScan,
    content: &Utf8Path,
    folder: &Scratch,
    writing: &Progress,
) -> Result<(), Error> {
    let (parsed, parse) = (&scan.scene, folder.path());
    writing.report("write_clouds", 0.0).map_err(ParseError::from)?;
    let points = || {
        Ok(write_even_points(
            &parsed.cloud,
            &parsed.instance_of_point,
            File::create(ParseFile::Points.path_in(parse))?,
        )?)
    };
    let (points, rest) = rayon::join(points, || write_rest(scan, content, parse, writing));
    points.and(rest)?;
    writing.check().map_err(ParseError::from)?;
    fs::create_dir(parse.join(VIEWS))?;
    let shown: BTreeSet<FrameIndex> = parsed
        .instances
        .iter()
        .flat_map(|instance| &instance.views)
        .map(|view| view.frame)
        .collect();
    for frame in scan.frames.iter().filter(|frame| shown.contains(&frame.index)) {
        let file = photograph(parse, frame.index);
        // The pixel coordinates of views refer to pinhole pictures.
        match frame.optics.color_lens {
            None => drop(fs::copy(&frame.color, file)?),
            Some(_) => {
                fs::write(file, encode_jpeg(&frame.decode_color().map_err(ParseError::from)?))?;
            }
        }
    }
    Ok(())
}

/// Writes everything except the ordered points, which take as long as all the rest.
fn write_rest(
    scan: &ParsedScan,
    content: &Utf8Path,
    parse: &Utf8Path,
    writing: &Progress,
) -> Result<(), Error> {
    let parsed = &scan.scene;
    write_cloud_ply(&parsed.cloud, File::create(ParseFile::Cloud.path_in(parse))?)?;
    write_instances_ply(parsed, File::create(ParseFile::Instances.path_in(parse))?)?;
    write_frames(&scan.frames, content, parse)?;
    let observation = observe(parsed, &scan.frames, writing).map_err(ParseError::from)?;
    fs::write(parse.join(OBSERVATION), serde_json::to_vec(&observation)?)?;
    if let Some(embeddings) = &parsed.embeddings {
        embeddings.write_rows(File::create(ParseFile::Embeddings.path_in(parse))?)?;
        embeddings.write_norms(File::create(parse.join(NORMS))?)?;
        embeddings.write_shared(File::create(parse.join(SHARED))?)?;
    }
    if let Some(seen) = &parsed.frame_embeddings {
        let [rows, frames] = FRAME_EMBEDDINGS.map(|file| parse.join(file));
        seen.write_rows(File::create(rows)?)?;
        seen.write_frames(File::create(frames)?)?;
    }
    writing.report("draw_report", 0.5).map_err(ParseError::from)?;
    fs::write(
        ParseFile::Thumbnail.path_in(parse),
        report_pictures::thumbnail(
            &RenderScene::with_building(parsed.cloud.clone(), &parsed.instances),
            &parsed.extent,
        ),
    )?;
    super::report_files::write(parse, report_pictures::render(parsed, &scan.frames, writing)?)
}
