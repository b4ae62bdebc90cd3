//! Results of a batch in item order, while it runs or afterwards.

use super::items::BatchDefaults;
use crate::answers::table;
use crate::error::Error;
use crate::{BatchService, LineFormat};
use bytes::Bytes;
use futures::{Stream, stream};
use serde::Serialize;
use serde_json::value::RawValue;
use std::sync::Arc;
use std::time::Duration;
use tokio::time::sleep;
use uniground_storage::ItemRow;
use uniground_types::answer::Answer;
use uniground_types::batch::BatchState;
use uniground_types::job::JobError;

/// The results that a caller requests, and their format.
#[derive(Debug, Clone)]
pub struct ResultRequest {
    pub batch_id: String,
    /// The first item to return.
    pub from: u32,
    pub format: LineFormat,
    /// Waits for unfinished items while the batch runs. Otherwise the stream ends before the first
    /// unfinished item.
    pub follow: bool,
}

/// Items read per page.
const PAGE: u32 = 200;
/// The polling interval of a followed batch.
const POLL_INTERVAL: Duration = Duration::from_millis(200);

/// A line of results. The answer is the stored JSON, byte for byte.
#[derive(Serialize)]
struct ResultLine<'a> {
    item: u32,
    scene_id: &'a str,
    query: &'a str,
    status: &'a str,
    answer_id: &'a str,
    answer: Option<&'a RawValue>,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<JobError>,
}

impl BatchService {
    /// Streams results in item order. The stream ends after the last item. Unless it follows the
    /// batch, it ends before the first unfinished item.
    ///
    /// # Errors
    /// [`Error::BatchNotFound`].
    pub async fn batch_results(
        &self,
        results: ResultRequest,
    ) -> Result<impl Stream<Item = Result<Bytes, Error>> + use<>, Error> {
        self.batch_row(&results.batch_id).await?;
        let defaults = Arc::new(BatchDefaults::from_stored(
            self.batch_repository.batch_defaults(&results.batch_id).await?.as_deref(),
        )?);
        let service = self.clone();
        let begin = (results.format == LineFormat::Csv)
            .then(|| Bytes::from(format!("{}\n", columns().join(","))));
        let pages = stream::try_unfold(results, move |page_request| {
            let (service, defaults) = (service.clone(), defaults.clone());
            async move { service.next_page(page_request, &defaults).await }
        });
        Ok(futures::StreamExt::chain(stream::iter(begin.map(Ok)), pages))
    }

    async fn next_page(
        &self,
        mut page_request: ResultRequest,
        defaults: &BatchDefaults,
    ) -> Result<Option<(Bytes, ResultRequest)>, Error> {
        loop {
            // Read before the items, so that items closed after this are found in the next pass.
            let (state, ..) =
                self.batch_state(&self.batch_row(&page_request.batch_id).await?).await?;
            let rows = self
                .batch_repository
                .batch_items(&page_request.batch_id, page_request.from, PAGE)
                .await?;
            let done: Vec<ItemRow> =
                rows.into_iter().take_while(|row| row.status.is_some()).collect();
            if let Some(last) = done.last() {
                page_request.from = last.item + 1;
                let page = match page_request.format {
                    LineFormat::Jsonl => to_json_lines(&done, defaults)?,
                    LineFormat::Csv => csv_rows(&done, defaults)?,
                };
                return Ok(Some((page.into(), page_request)));
            }
            if !page_request.follow || state != BatchState::Running {
                return Ok(None);
            }
            sleep(POLL_INTERVAL).await;
        }
    }
}

fn to_json_lines(rows: &[ItemRow], defaults: &BatchDefaults) -> Result<Vec<u8>, Error> {
    let mut page = Vec::new();
    for row in rows {
        let query = defaults.query_of(&row.request);
        let line = ResultLine {
            item: row.item,
            scene_id: &row.scene_id,
            query: &query,
            status: row.status.as_deref().unwrap_or_default(),
            answer_id: &row.answer_id,
            answer: row.answer.as_deref().map(serde_json::from_str).transpose()?,
            error: row.error.clone().map(|(code, detail)| JobError { code, detail }),
        };
        serde_json::to_writer(&mut page, &line)?;
        page.push(b'\n');
    }
    Ok(page)
}

fn columns() -> Vec<&'static str> {
    let before = ["item", "scene_id", "query", "status", "answer_id"];
    before.into_iter().chain(table::COLUMNS).chain(["error_code", "error"]).collect()
}

fn csv_rows(rows: &[ItemRow], defaults: &BatchDefaults) -> Result<Vec<u8>, Error> {
    table::to_csv(rows.iter().map(|row| {
        let query = defaults.query_of(&row.request);
        let answer: Option<Answer> = row.answer.as_deref().map(serde_json::from_str).transpose()?;
        let (code, detail) = row.error.clone().unwrap_or_default();
        let item = [
            row.item.to_string(),
            row.scene_id.clone(),
            query,
            row.status.clone().unwrap_or_default(),
            row.answer_id.clone(),
        ];
        Ok(item
            .into_iter()
            .chain(table::answer_cells(answer.as_ref()))
            .chain([code, detail])
            .collect())
    }))
}
