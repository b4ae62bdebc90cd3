//! Lists of answers: one page as JSON, or all of them as lines or as a table.

use super::table;
use crate::error::Error;
use crate::{ParsedScenes, SceneLookup, Transcripts};
use bytes::Bytes;
use futures::{Stream, StreamExt, stream};
use serde::Deserialize;
use std::sync::Arc;
use uniground_storage::{AnswerFilter, AnswerRepository, AnswerRow, split_page};
use uniground_types::answer::Answer;

/// Format of a list of records.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum LineFormat {
    /// One JSON object per line.
    #[default]
    Jsonl,
    /// A table with the numeric fields, one row per record.
    Csv,
}

/// Answers read per page.
const PAGE: u32 = 200;

/// Returns stored answers, their lists and their pictures.
#[derive(Clone)]
pub struct AnswerService {
    pub(crate) answer_repository: AnswerRepository,
    pub(crate) transcripts: Arc<Transcripts>,
    pub(crate) parsed_scenes: Arc<ParsedScenes>,
    pub(crate) scene_lookup: Arc<SceneLookup>,
}

impl AnswerService {
    /// Returns a page of stored answers, newest first, as a JSON list. Each answer is byte for byte
    /// as it was first returned.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn answers(
        &self,
        filter: &AnswerFilter,
        limit: u32,
        cursor: Option<&str>,
    ) -> Result<String, Error> {
        let (rows, next) = split_page(
            self.answer_repository.answers(filter, limit + 1, cursor).await?,
            limit,
            |row| &row.id,
        );
        let answers: Vec<&str> = rows.iter().map(|row| row.body.as_str()).collect();
        Ok(format!(
            "{{\"answers\":[{}],\"next_cursor\":{}}}",
            answers.join(","),
            serde_json::to_string(&next)?
        ))
    }

    /// Streams all matching answers, one per line.
    pub fn all_answers(
        &self,
        filter: AnswerFilter,
        format: LineFormat,
    ) -> impl Stream<Item = Result<Bytes, Error>> + use<> {
        let service = self.clone();
        let begin =
            (format == LineFormat::Csv).then(|| Bytes::from(format!("{}\n", columns().join(","))));
        let pages = stream::try_unfold((filter, None::<String>), move |(filter, cursor)| {
            let service = service.clone();
            async move {
                let rows =
                    service.answer_repository.answers(&filter, PAGE, cursor.as_deref()).await?;
                let Some(last) = rows.last() else { return Ok(None) };
                let cursor = Some(last.id.clone());
                let page = match format {
                    LineFormat::Jsonl => rows
                        .iter()
                        .flat_map(|row| [row.body.as_str(), "\n"])
                        .collect::<String>()
                        .into_bytes(),
                    LineFormat::Csv => csv_rows(&rows)?,
                };
                Ok(Some((Bytes::from(page), (filter, cursor))))
            }
        });
        stream::iter(begin.map(Ok)).chain(pages)
    }
}

fn columns() -> Vec<&'static str> {
    ["answer_id", "scene_id", "query", "status"].into_iter().chain(table::COLUMNS).collect()
}

fn csv_rows(rows: &[AnswerRow]) -> Result<Vec<u8>, Error> {
    table::to_csv(rows.iter().map(|row| {
        let answer: Answer = serde_json::from_str(&row.body)?;
        let status = serde_json::to_value(answer.status)?.as_str().unwrap_or_default().to_owned();
        let figures = table::answer_cells(Some(&answer));
        Ok([answer.id, answer.scene_id, answer.query, status].into_iter().chain(figures).collect())
    }))
}
