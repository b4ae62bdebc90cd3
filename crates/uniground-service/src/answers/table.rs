//! Formats the figures of an answer as cells of a table.

use crate::error::Error;
use std::io;
use uniground_types::answer::Answer;

/// The names of the columns.
pub const COLUMNS: [&str; 10] = [
    "predicted_id",
    "confidence",
    "count",
    "center_x",
    "center_y",
    "center_z",
    "size_x",
    "size_y",
    "size_z",
    "cost_usd",
];

/// Returns the cells of an answer in the order of [`COLUMNS`]. Missing values are empty.
pub fn answer_cells(answer: Option<&Answer>) -> [String; COLUMNS.len()] {
    let Some(answer) = answer else { return Default::default() };
    let [center, size] =
        [answer.aabb.map(|aabb| aabb.center), answer.aabb.map(|aabb| aabb.size.into())];
    let number = |number: Option<String>| number.unwrap_or_default();
    let axis =
        |of: Option<nalgebra::Point3<f32>>, axis: usize| number(of.map(|of| of[axis].to_string()));
    [
        number(answer.answer.predicted_id.map(|id| id.to_string())),
        answer.confidence.to_string(),
        number(answer.count.map(|count| count.to_string())),
        axis(center, 0),
        axis(center, 1),
        axis(center, 2),
        axis(size, 0),
        axis(size, 1),
        axis(size, 2),
        answer.usage.cost_usd.to_string(),
    ]
}

/// Formats rows as CSV, without a header.
pub fn to_csv(rows: impl Iterator<Item = Result<Vec<String>, Error>>) -> Result<Vec<u8>, Error> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    for row in rows {
        writer.write_record(&row?).map_err(|error| Error::Io(io::Error::other(error)))?;
    }
    writer.into_inner().map_err(|error| Error::Io(io::Error::other(error.to_string())))
}
