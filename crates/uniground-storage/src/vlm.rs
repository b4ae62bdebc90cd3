//! Rows of vision-language models: names they gave, and money spent on them.

use super::database::{Database, replace_nul, to_unsigned};
use super::parses::note_change;
use super::{StoreError, now};
use sqlx::AnyConnection;
use std::collections::BTreeMap;
use std::sync::Arc;

/// A request to reserve money.
#[derive(Debug, Clone, Copy)]
pub struct SpendRequest<'a> {
    /// UTC date.
    pub day: &'a str,
    /// US dollars, as all amounts here.
    pub usd: f64,
    pub key_id: Option<&'a str>,
    /// Daily limits for all keys together, and for this key.
    pub daily_usd: Option<f64>,
    pub key_daily_usd: Option<f64>,
}

/// The owner of a daily budget.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BudgetOwner {
    Server,
    Key,
}

/// The budget is too small for the request.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BudgetExceeded {
    pub whose: BudgetOwner,
    pub limit_usd: f64,
    pub left_usd: f64,
}

/// Repository of the names that models gave to instances.
#[derive(Clone)]
pub struct NameRepository {
    pub(super) database: Arc<Database>,
}

impl NameRepository {
    /// Returns the names of a parse's instances, by id, from one model with one version of the
    /// prompt.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn instance_names(
        &self,
        parse_id: &str,
        model: &str,
        prompt_version: u32,
    ) -> Result<BTreeMap<u32, String>, StoreError> {
        let sql = "SELECT instance_id, name FROM instance_names WHERE parse_id = $1 AND model = $2 AND prompt_version = $3";
        let rows: Vec<(i64, String)> = sqlx::query_as(sql)
            .bind(parse_id)
            .bind(model)
            .bind(i64::from(prompt_version))
            .fetch_all(&self.database.reader)
            .await?;
        Ok(rows
            .into_iter()
            .map(|(id, name)| Ok((to_unsigned(id)?, name)))
            .collect::<sqlx::Result<_>>()?)
    }

    /// Stores names. Existing names stay. Stores nothing when the parse is deleted.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn insert_instance_names(
        &self,
        parse_id: &str,
        model: &str,
        prompt_version: u32,
        names: &BTreeMap<u32, String>,
    ) -> Result<(), StoreError> {
        let sql = "INSERT INTO instance_names (parse_id, model, prompt_version, instance_id, name, created_at)
                   SELECT $1, $2, $3, $4, $5, $6 WHERE EXISTS (SELECT 1 FROM parses WHERE id = $1) ON CONFLICT DO NOTHING";
        let mut tx = self.database.writer.begin().await?;
        for (id, name) in names {
            sqlx::query(sql)
                .bind(parse_id)
                .bind(model)
                .bind(i64::from(prompt_version))
                .bind(i64::from(*id))
                .bind(&*replace_nul(name))
                .bind(now())
                .execute(&mut *tx)
                .await?;
        }
        tx.commit().await
    }

    /// Stores that a model has named every instance of a parse that can be named.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn complete_name_index(
        &self,
        parse_id: &str,
        model: &str,
        prompt_version: u32,
    ) -> Result<(), StoreError> {
        let sql = "INSERT INTO name_indexes (parse_id, model, prompt_version, created_at)
                   SELECT $1, $2, $3, $4 WHERE EXISTS (SELECT 1 FROM parses WHERE id = $1) ON CONFLICT DO NOTHING";
        let mut tx = self.database.writer.begin().await?;
        let insert =
            sqlx::query(sql).bind(parse_id).bind(model).bind(i64::from(prompt_version)).bind(now());
        insert.execute(&mut *tx).await?;
        note_change(&mut tx, parse_id).await?;
        tx.commit().await
    }

    /// Returns the model that last completed the names of a parse, for one version of the prompt.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn name_index(
        &self,
        parse_id: &str,
        prompt_version: u32,
    ) -> Result<Option<String>, StoreError> {
        let sql = "SELECT model FROM name_indexes WHERE parse_id = $1 AND prompt_version = $2 ORDER BY created_at DESC, model LIMIT 1";
        Ok(sqlx::query_scalar(sql)
            .bind(parse_id)
            .bind(i64::from(prompt_version))
            .fetch_optional(&self.database.reader)
            .await?)
    }
}

/// Repository of the money spent on models, by day.
#[derive(Clone)]
pub struct SpendingRepository {
    pub(super) database: Arc<Database>,
}

impl SpendingRepository {
    /// Returns the money spent on a day, US dollars.
    ///
    /// # Errors
    /// [`StoreError::Database`].
    pub async fn spending_on_day(&self, day: &str) -> Result<f64, StoreError> {
        let usd: Option<f64> = sqlx::query_scalar("SELECT usd FROM spending WHERE day = $1")
            .bind(day)
            .fetch_optional(&self.database.reader)
            .await?;
        Ok(usd.unwrap_or(0.0))
    }

    /// Reserves money for a model call under a new id, if the daily budgets have enough left.
    /// Counts all processes together, and calls in progress with their estimated cost. A budget
    /// that is used up allows no calls, not even calls that seem to be free.
    ///
    /// # Errors
    /// [`StoreError::LeaseLost`]: the lease of this process has expired; [`StoreError::Database`].
    pub async fn reserve_spending(
        &self,
        id: &str,
        wish: &SpendRequest<'_>,
    ) -> Result<Result<(), BudgetExceeded>, StoreError> {
        let SpendRequest { day, usd, key_id, daily_usd, key_daily_usd } = *wish;
        let mut tx = self.database.writer.begin().await?;
        let of_all = "SELECT coalesce((SELECT usd FROM spending WHERE day = $1), 0.0)
                           + coalesce((SELECT sum(usd) FROM reservations WHERE day = $1), 0.0)";
        let of_key = "SELECT coalesce((SELECT usd FROM key_spending WHERE day = $1 AND key_id = $2), 0.0)
                           + coalesce((SELECT sum(usd) FROM reservations WHERE day = $1 AND key_id = $2), 0.0)";
        for (whose, sql, limit_usd) in
            [(BudgetOwner::Key, of_key, key_daily_usd), (BudgetOwner::Server, of_all, daily_usd)]
        {
            let Some(limit_usd) = limit_usd else { continue };
            let spent = sqlx::query_scalar(sql).bind(day);
            let spent = if whose == BudgetOwner::Key { spent.bind(key_id) } else { spent };
            let spent: f64 = spent.fetch_one(&mut *tx).await?;
            let left_usd = limit_usd - spent;
            if left_usd <= 0.0 || usd > left_usd {
                tx.rollback().await?;
                return Ok(Err(BudgetExceeded { whose, limit_usd, left_usd: left_usd.max(0.0) }));
            }
        }
        // A process that was removed from the cluster spends nothing: others have taken over its
        // work.
        let sql = "INSERT INTO reservations (id, day, usd, key_id, member)
                   SELECT $1, $2, $3, $4, $5 WHERE EXISTS (SELECT 1 FROM members WHERE id = $5)";
        let query = sqlx::query(sql)
            .bind(id)
            .bind(day)
            .bind(usd)
            .bind(key_id)
            .bind(self.database.members.id().to_string());
        if query.execute(&mut *tx).await?.rows_affected() == 0 {
            tx.rollback().await?;
            return Err(StoreError::LeaseLost);
        }
        tx.commit().await?;
        Ok(Ok(()))
    }

    /// Replaces a reservation with the actual cost of the call.
    ///
    /// # Errors
    /// [`StoreError`].
    pub async fn settle_spending(&self, id: &str, usd: f64) -> Result<(), StoreError> {
        let mut tx = self.database.writer.begin().await?;
        let reserved: Option<(String, Option<String>)> =
            sqlx::query_as("DELETE FROM reservations WHERE id = $1 RETURNING day, key_id")
                .bind(id)
                .fetch_optional(&mut *tx)
                .await?;
        if let Some((day, key_id)) = reserved {
            add_spending(&mut tx, &day, key_id.as_deref(), usd).await?;
        }
        tx.commit().await
    }

    /// Counts the reservations of processes that are gone as spent.
    ///
    /// # Errors
    /// [`StoreError`].
    pub(super) async fn settle_abandoned_reservations(&self) -> Result<(), StoreError> {
        let left = "DELETE FROM reservations WHERE member IS NULL OR member NOT IN (SELECT id FROM members) RETURNING day, key_id, usd";
        let mut tx = self.database.writer.begin().await?;
        let left: Vec<(String, Option<String>, f64)> =
            sqlx::query_as(left).fetch_all(&mut *tx).await?;
        for (day, key_id, usd) in left {
            add_spending(&mut tx, &day, key_id.as_deref(), usd).await?;
        }
        tx.commit().await
    }
}

/// Adds spending to the totals of a day: of everybody, and of a key.
async fn add_spending(
    tx: &mut AnyConnection,
    day: &str,
    key_id: Option<&str>,
    usd: f64,
) -> Result<(), StoreError> {
    let sql = "INSERT INTO spending (day, usd) VALUES ($1, $2) ON CONFLICT (day) DO UPDATE SET usd = spending.usd + $2";
    sqlx::query(sql).bind(day).bind(usd).execute(&mut *tx).await?;
    if let Some(key_id) = key_id {
        let sql = "INSERT INTO key_spending (key_id, day, usd) VALUES ($1, $2, $3)
                   ON CONFLICT (key_id, day) DO UPDATE SET usd = key_spending.usd + $3";
        sqlx::query(sql).bind(key_id).bind(day).bind(usd).execute(tx).await?;
    }
    Ok(())
}
