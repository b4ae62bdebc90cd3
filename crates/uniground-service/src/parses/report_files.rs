//! The pictures of a parse on disk: `report/<name>.jpg` and their titles in `report/index.json`,
//! below the parse's folder.

use super::files::read;
use crate::error::Error;
use camino::{Utf8Path, Utf8PathBuf};
use serde::{Deserialize, Serialize};
use std::fs;
use tokio::task::spawn_blocking;
use uniground_parsing::report_pictures::ReportPicture;
use uniground_storage::Blobs;

const FOLDER: &str = "report";
const INDEX: &str = "index.json";

/// The entry of a picture in the index.
#[derive(Serialize, Deserialize)]
pub(super) struct Entry {
    pub name: String,
    pub title: String,
}

/// Writes the pictures of a parse into its folder.
pub(super) fn write(parse: &Utf8Path, pictures: Vec<ReportPicture>) -> Result<(), Error> {
    fs::create_dir(parse.join(FOLDER))?;
    let mut index = Vec::with_capacity(pictures.len());
    for ReportPicture { name, title, jpeg } in pictures {
        fs::write(picture(parse, &name), jpeg)?;
        index.push(Entry { name, title });
    }
    Ok(fs::write(parse.join(FOLDER).join(INDEX), serde_json::to_vec(&index)?)?)
}

/// Returns the file of a picture. `name` is one of the index.
pub(super) fn picture(parse: &Utf8Path, name: &str) -> Utf8PathBuf {
    parse.join(FOLDER).join(format!("{name}.jpg"))
}

/// Returns all pictures of a parse. Parses of earlier versions have none.
pub(super) async fn index(blobs: Blobs, parse: Utf8PathBuf) -> Result<Vec<Entry>, Error> {
    let index =
        spawn_blocking(move || read(&blobs, &parse, parse.join(FOLDER).join(INDEX))).await??;
    index.map_or_else(|| Ok(Vec::new()), |bytes| Ok(serde_json::from_slice(&bytes)?))
}
