//! Results of a batch, in the order of its items, while they are made or afterwards.

use crate::error::Error;
use crate::service::Service;
use crate::store::ItemRow;
use bytes::Bytes;
use futures::{Stream, stream};
use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;
use std::time::Duration;
use tokio::time::sleep;
use uniground_types::answer::Answer;
use uniground_types::batch::BatchState;
use uniground_types::job::JobError;

/// How results are written.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum ResultFormat {
    /// A `BatchResult` a line.
    #[default]
    Jsonl,
    /// A row an item: the figures of the answer.
    Csv,
}

/// What results are wanted, and how.
#[derive(Debug, Clone)]
pub struct Results {
    pub batch_id: String,
    /// The first item.
    pub from: u32,
    pub format: ResultFormat,
    /// Wait for items that are still asked, while the batch runs; else end at the first that is.
    pub follow: bool,
}

/// Items read together.
const PAGE: u32 = 200;
/// How often a batch is looked at that is followed.
const LOOK_EVERY: Duration = Duration::from_millis(200);

/// A line of results; the answer is passed on as it is kept, byte for byte.
#[derive(Serialize)]
struct Line<'a> {
    item: u32,
    scene_id: &'a str,
    query: &'a str,
    status: &'a str,
    answer_id: &'a str,
    answer: Option<&'a RawValue>,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<JobError>,
}

/// The question's words, whatever else its item has.
#[derive(Deserialize)]
struct Asked {
    #[serde(default)]
    query: String,
}

impl Service {
    /// Streams results in item order. The stream ends with the last item, or, unless it follows, before the first that is not done.
    ///
    /// # Errors
    /// [`Error::BatchNotFound`].
    pub async fn batch_results(&self, results: Results) -> Result<impl Stream<Item = Result<Bytes, Error>> + use<>, Error> {
        self.batch_row(&results.batch_id).await?;
        let service = self.clone();
        let begin = (results.format == ResultFormat::Csv).then(|| Bytes::from(format!("{}\n", COLUMNS.join(","))));
        let pages = stream::try_unfold(results, move |wanted| {
            let service = service.clone();
            async move { service.next_page(wanted).await }
        });
        Ok(futures::StreamExt::chain(stream::iter(begin.map(Ok)), pages))
    }

    async fn next_page(&self, mut wanted: Results) -> Result<Option<(Bytes, Results)>, Error> {
        loop {
            // Looked at before the items: what is closed after this is found next time.
            let (state, ..) = self.batch_state(&self.batch_row(&wanted.batch_id).await?).await?;
            let rows = self.store.batch_items(&wanted.batch_id, wanted.from, PAGE).await?;
            let done: Vec<ItemRow> = rows.into_iter().take_while(|row| row.status.is_some()).collect();
            if let Some(last) = done.last() {
                wanted.from = last.item + 1;
                let page = match wanted.format {
                    ResultFormat::Jsonl => lines(&done)?,
                    ResultFormat::Csv => table(&done)?,
                };
                return Ok(Some((page.into(), wanted)));
            }
            if !wanted.follow || state != BatchState::Running {
                return Ok(None);
            }
            sleep(LOOK_EVERY).await;
        }
    }
}

fn lines(rows: &[ItemRow]) -> Result<Vec<u8>, Error> {
    let mut page = Vec::new();
    for row in rows {
        let Asked { query } = serde_json::from_str(&row.request).unwrap_or(Asked { query: String::new() });
        let line = Line {
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

const COLUMNS: [&str; 17] = [
    "item",
    "scene_id",
    "query",
    "status",
    "answer_id",
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
    "error_code",
    "error",
];

fn table(rows: &[ItemRow]) -> Result<Vec<u8>, Error> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    let broken = |error: csv::Error| Error::Io(std::io::Error::other(error));
    for row in rows {
        let Asked { query } = serde_json::from_str(&row.request).unwrap_or(Asked { query: String::new() });
        let answer: Option<Answer> = row.answer.as_deref().map(serde_json::from_str).transpose()?;
        let of = |value: &dyn Fn(&Answer) -> Option<String>| answer.as_ref().and_then(value).unwrap_or_default();
        let side = |axis: usize, size: bool| {
            of(&|answer| answer.aabb.map(|b| if size { b.size[axis].to_string() } else { b.center[axis].to_string() }))
        };
        let (code, detail) = row.error.clone().unwrap_or_default();
        let cells: [String; COLUMNS.len()] = [
            row.item.to_string(),
            row.scene_id.clone(),
            query,
            row.status.clone().unwrap_or_default(),
            row.answer_id.clone(),
            of(&|answer| answer.answer.predicted_id.map(|id| id.to_string())),
            of(&|answer| Some(answer.confidence.to_string())),
            of(&|answer| answer.count.map(|count| count.to_string())),
            side(0, false),
            side(1, false),
            side(2, false),
            side(0, true),
            side(1, true),
            side(2, true),
            of(&|answer| Some(answer.usage.cost_usd.to_string())),
            code,
            detail,
        ];
        writer.write_record(&cells).map_err(broken)?;
    }
    writer.into_inner().map_err(|error| Error::Io(std::io::Error::other(error.to_string())))
}
