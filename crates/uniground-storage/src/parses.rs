//! Finished parses and their instances.

use super::database::{Database, to_unsigned};
use super::growth::ContinuedParse;
use super::records::{InstanceRecord, ParseRecord, RECORD_VERSION};
use super::{JobLease, SceneRow, StoreError, now};
use sqlx::any::AnyRow;
use sqlx::{AnyConnection, FromRow, Row};
use std::sync::Arc;
use uniground_geometry::boxes::Aabb;
use uniground_geometry::scene::{ImportReport, Instance, InstanceId, ParseReport};
use uniground_parsing::pointed::find_identical;
use uniground_types::settings::{ParseModels, ParseSettings};

/// A finished parse as stored, with JSON columns as text. [`record`](Self::record) parses them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ParseRow {
    pub id: String,
    pub content_hash: String,
    pub settings_hash: String,
    settings: String,
    models: String,
    import_report: String,
    parse_report: String,
    extent: String,
    pub created_at: String,
}

impl FromRow<'_, AnyRow> for ParseRow {
    fn from_row(row: &AnyRow) -> sqlx::Result<Self> {
        Ok(Self {
            id: row.try_get("id")?,
            content_hash: row.try_get("content_hash")?,
            settings_hash: row.try_get("settings_hash")?,
            settings: row.try_get("settings")?,
            models: row.try_get("models")?,
            import_report: row.try_get("import_report")?,
            parse_report: row.try_get("parse_report")?,
            extent: row.try_get("extent")?,
            created_at: row.try_get("created_at")?,
        })
    }
}

impl ParseRow {
    /// Returns whether its files were lost or damaged, so that it remains only for its answers.
    #[must_use]
    pub fn is_retired(&self) -> bool {
        self.settings_hash.contains(":retired:")
    }

    /// Parses the JSON columns, as far as this version can read them.
    #[must_use]
    pub fn record(&self) -> ParseRecord {
        ParseRecord::read(
            &self.settings,
            &self.models,
            &self.import_report,
            &self.parse_report,
            &self.extent,
        )
    }
}

/// A parse to be inserted; its blobs are in place.
pub struct NewParse<'a> {
    pub id: &'a str,
    pub content_hash: &'a str,
    pub settings_hash: &'a str,
    pub settings: &'a ParseSettings,
    pub models: &'a ParseModels,
    pub import: &'a ImportReport,
    pub report: &'a ParseReport,
    pub extent: &'a Aabb,
    pub instances: &'a [Instance],
    /// What it takes over from another parse, if it continues one.
    pub continued: Option<ContinuedParse<'a>>,
    /// The lease of the job that made it.
    pub lease: &'a JobLease,
}

/// Repository of parses and their instances.
#[derive(Clone)]
pub struct ParseRepository {
    pub(super) database: Arc<Database>,
}

impl ParseRepository {
    /// Inserts a parse and its instances in one transaction. Returns `false` and writes nothing
    /// when a parse of the same content and settings exists, or the content is gone because its
    /// last scene was deleted meanwhile.
    ///
    /// # Errors
    /// [`StoreError`]; [`StoreError::LeaseLost`] if the lease of its job has passed to another
    /// worker.
    pub async fn insert_parse(&self, parse: NewParse<'_>) -> Result<bool, StoreError> {
        let NewParse {
            id,
            content_hash,
            settings_hash,
            settings,
            models,
            import,
            report,
            extent,
            instances,
            continued,
            lease,
        } = &parse;
        let mut tx = self.database.writer.begin().await?;
        lease.check(&mut tx).await?;
        let inserted = sqlx::query(
            "INSERT INTO parses (id, content_hash, settings_hash, settings, models, import_report, parse_report, extent, created_at,
                                 record_version)
             SELECT $1, $2, $3, $4, $5, $6, $7, $8, $9, $10 WHERE EXISTS (SELECT 1 FROM contents WHERE hash = $2) ON CONFLICT DO NOTHING",
        )
        .bind(id)
        .bind(content_hash)
        .bind(settings_hash)
        .bind(serde_json::to_string(settings)?)
        .bind(serde_json::to_string(models)?)
        .bind(serde_json::to_string(import)?)
        .bind(serde_json::to_string(report)?)
        .bind(serde_json::to_string(extent)?)
        .bind(now())
        .bind(i64::from(RECORD_VERSION))
        .execute(&mut *tx)
        .await?;
        if inserted.rows_affected() == 0 {
            tx.rollback().await?;
            return Ok(false);
        }
        for instance in *instances {
            insert_instance(&mut tx, id, instance).await?;
        }
        match continued {
            Some(continued) => self.continue_parse(&mut tx, id, continued).await?,
            None => inherit(&mut tx, &parse, instances.len()).await?,
        }
        tx.commit().await?;
        Ok(true)
    }

    /// # Errors
    /// [`StoreError::Database`].
    pub async fn parse(&self, id: &str) -> Result<Option<ParseRow>, StoreError> {
        Ok(sqlx::query_as("SELECT * FROM parses WHERE id = $1")
            .bind(id)
            .fetch_optional(&self.database.reader)
            .await?)
    }

    /// Returns the number of changes of a parse since it was made: names, corrections, found
    /// instances. Returns `None` when the parse is deleted.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn changes_of_parse(&self, id: &str) -> Result<Option<i64>, StoreError> {
        Ok(sqlx::query_scalar("SELECT changes FROM parses WHERE id = $1")
            .bind(id)
            .fetch_optional(&self.database.reader)
            .await?)
    }

    /// Returns the parse of this content under these settings, if it exists.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn find_parse(
        &self,
        content_hash: &str,
        settings_hash: &str,
    ) -> Result<Option<ParseRow>, StoreError> {
        let sql = "SELECT * FROM parses WHERE content_hash = $1 AND settings_hash = $2";
        Ok(sqlx::query_as(sql)
            .bind(content_hash)
            .bind(settings_hash)
            .fetch_optional(&self.database.reader)
            .await?)
    }

    /// Returns all parses, oldest first.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn all_parses(&self) -> Result<Vec<ParseRow>, StoreError> {
        Ok(sqlx::query_as("SELECT * FROM parses ORDER BY id")
            .fetch_all(&self.database.reader)
            .await?)
    }

    /// Retires a parse whose files are lost or damaged: it is not used for new requests, so the
    /// next parse of the same content is computed again. Its answers and scenes keep it until then.
    /// Returns the scenes that the caller must parse again, with the settings of this parse.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn retire_parse(&self, id: &str) -> Result<Vec<SceneRow>, StoreError> {
        let mut tx = self.database.writer.begin().await?;
        let sql = "UPDATE parses SET settings_hash = settings_hash || ':retired:' || id WHERE id = $1 AND settings_hash NOT LIKE '%:retired:%'";
        let retired = sqlx::query(sql).bind(id).execute(&mut *tx).await?.rows_affected() > 0;
        let scenes = sqlx::query_as("SELECT * FROM scenes WHERE parse_id = $1 ORDER BY id")
            .bind(id)
            .fetch_all(&mut *tx)
            .await?;
        tx.commit().await?;
        // If it was retired before, those scenes were returned then.
        Ok(if retired { scenes } else { Vec::new() })
    }

    /// Returns all instances of a parse, ordered by id.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn instances(&self, parse_id: &str) -> Result<Vec<Instance>, StoreError> {
        let bodies: Vec<String> =
            sqlx::query_scalar("SELECT body FROM instances WHERE parse_id = $1 ORDER BY id")
                .bind(parse_id)
                .fetch_all(&self.database.reader)
                .await?;
        bodies.iter().map(|body| Ok(serde_json::from_str::<InstanceRecord>(body)?.into())).collect()
    }

    /// Appends an instance that was found for a question, and returns its id. Returns the existing
    /// id if the same object was found before. Returns `None` when the parse is deleted, no scene
    /// uses it, or it has `most` found instances already.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn insert_pointed_instance(
        &self,
        parse_id: &str,
        found: &Instance,
        most: usize,
    ) -> Result<Option<InstanceId>, StoreError> {
        let mut tx = self.database.writer.begin().await?;
        let is_found = self.database.engine.json_has_field("body", "found_for");
        let before =
            format!("SELECT body FROM instances WHERE parse_id = $1 AND {is_found} ORDER BY id");
        let before: Vec<String> = sqlx::query_scalar(sqlx::AssertSqlSafe(before))
            .bind(parse_id)
            .fetch_all(&mut *tx)
            .await?;
        let before: Vec<Instance> = before
            .iter()
            .map(|body| Ok(serde_json::from_str::<InstanceRecord>(body)?.into()))
            .collect::<Result<_, StoreError>>()?;
        let last = "SELECT max(id) FROM instances WHERE parse_id = $1 AND EXISTS (SELECT 1 FROM scenes WHERE parse_id = $1)";
        let last: Option<i64> = sqlx::query_scalar(last).bind(parse_id).fetch_one(&mut *tx).await?;
        let last: Option<u32> = last.map(to_unsigned).transpose()?;
        let (known, full) =
            (find_identical(&before, found).map(|known| known.id), before.len() >= most);
        let Some(id) = last.map(|last| InstanceId(last + 1)).filter(|_| known.is_none() && !full)
        else {
            tx.rollback().await?;
            return Ok(known);
        };
        insert_instance(&mut tx, parse_id, &Instance { id, ..found.clone() }).await?;
        note_change(&mut tx, parse_id).await?;
        tx.commit().await?;
        Ok(Some(id))
    }
}

/// Counts a change of a parse, which invalidates cached copies of it.
pub(super) async fn note_change(tx: &mut AnyConnection, parse_id: &str) -> Result<(), StoreError> {
    sqlx::query("UPDATE parses SET changes = changes + 1 WHERE id = $1")
        .bind(parse_id)
        .execute(tx)
        .await?;
    Ok(())
}

/// Copies names, corrections and found instances from a retired parse to its replacement. The same
/// scan under the same settings has the same instances.
async fn inherit(
    tx: &mut AnyConnection,
    new: &NewParse<'_>,
    instances: usize,
) -> Result<(), StoreError> {
    let retired = "SELECT id FROM parses WHERE content_hash = $1 AND settings_hash LIKE $2 || ':retired:%' ORDER BY id DESC LIMIT 1";
    let retired: Option<String> = sqlx::query_scalar(retired)
        .bind(new.content_hash)
        .bind(new.settings_hash)
        .fetch_optional(&mut *tx)
        .await?;
    let Some(retired) = retired else { return Ok(()) };
    let same = "SELECT count(*) FROM instances AS old JOIN instances AS new USING (id, body) WHERE old.parse_id = $1 AND new.parse_id = $2";
    let same: i64 =
        sqlx::query_scalar(same).bind(&retired).bind(new.id).fetch_one(&mut *tx).await?;
    if same != instances as i64 {
        tracing::warn!(
            parse_id = new.id,
            retired,
            "new parse has other instances; corrections and names were not carried over"
        );
        return Ok(());
    }
    for sql in [
        "INSERT INTO instances (parse_id, id, body, record_version) SELECT $2, id, body, record_version FROM instances
         WHERE parse_id = $1 AND id > (SELECT max(id) FROM instances WHERE parse_id = $2)",
        "UPDATE corrections SET parse_id = $2 WHERE parse_id = $1",
        "INSERT INTO instance_names (parse_id, model, prompt_version, instance_id, name, created_at)
         SELECT $2, model, prompt_version, instance_id, name, created_at FROM instance_names WHERE parse_id = $1 ON CONFLICT DO NOTHING",
        "INSERT INTO name_indexes (parse_id, model, prompt_version, created_at)
         SELECT $2, model, prompt_version, created_at FROM name_indexes WHERE parse_id = $1 ON CONFLICT DO NOTHING",
    ] {
        sqlx::query(sql).bind(&retired).bind(new.id).execute(&mut *tx).await?;
    }
    Ok(())
}

/// Inserts one instance of a parse.
pub(super) async fn insert_instance(
    tx: &mut AnyConnection,
    parse_id: &str,
    instance: &Instance,
) -> Result<(), StoreError> {
    sqlx::query(
        "INSERT INTO instances (parse_id, id, body, record_version) VALUES ($1, $2, $3, $4)",
    )
    .bind(parse_id)
    .bind(i64::from(instance.id.0))
    .bind(serde_json::to_string(&InstanceRecord::from(instance))?)
    .bind(i64::from(RECORD_VERSION))
    .execute(tx)
    .await?;
    Ok(())
}
