//! Money that may be spent: a question's, a batch's, a day's.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// What may be spent, shared by everything that spends from it. US dollars.
#[derive(Debug, Clone)]
pub struct Budget {
    /// Whose it is, for people: "this question".
    of: &'static str,
    limit_usd: f64,
    account: Arc<Mutex<Account>>,
}

/// US dollars.
#[derive(Debug, Default)]
struct Account {
    spent: f64,
    /// For calls under way.
    reserved: f64,
}

/// A call that was not made, because a budget has too little left.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error(
    "the budget of {of} is spent: {limit_usd} US dollars, of which {left_usd:.6} are left and about {wanted_usd:.6} are needed"
)]
pub struct OverBudget {
    /// Whose budget it is, for people: "this question".
    pub of: &'static str,
    /// The whole budget.
    pub limit_usd: f64,
    /// Neither spent nor put aside for calls under way; at least 0.
    pub left_usd: f64,
    /// What the call was thought to cost.
    pub wanted_usd: f64,
}

/// Money put aside for a call; what was not settled goes back.
#[derive(Debug)]
pub struct Reservation {
    account: Arc<Mutex<Account>>,
    reserved_usd: f64,
}

impl Budget {
    /// A budget of which nothing is spent. `of` says whose it is ("this question"); the limit may
    /// be infinite.
    #[must_use]
    pub fn new(of: &'static str, limit_usd: f64) -> Self {
        Self { of, limit_usd, account: Arc::default() }
    }

    /// A budget of which some was spent before.
    #[must_use]
    pub fn with_spent(self, usd: f64) -> Self {
        locked(&self.account).spent = usd;
        self
    }

    /// US dollars.
    #[must_use]
    pub fn spent_usd(&self) -> f64 {
        locked(&self.account).spent
    }

    /// Puts money aside for a call: calls at the same time can not spend the same money. An empty
    /// budget pays for nothing, not even for what seems to be free.
    ///
    /// # Errors
    /// [`OverBudget`].
    pub fn reserve(&self, usd: f64) -> Result<Reservation, OverBudget> {
        let mut account = locked(&self.account);
        let left_usd = self.limit_usd - account.spent - account.reserved;
        if left_usd <= 0.0 || usd > left_usd {
            return Err(OverBudget {
                of: self.of,
                limit_usd: self.limit_usd,
                left_usd: left_usd.max(0.0),
                wanted_usd: usd,
            });
        }
        account.reserved += usd;
        Ok(Reservation { account: self.account.clone(), reserved_usd: usd })
    }
}

impl Reservation {
    /// The call is paid for; what was reserved goes back.
    pub fn settle(self, usd: f64) {
        locked(&self.account).spent += usd;
    }
}

fn locked(account: &Mutex<Account>) -> MutexGuard<'_, Account> {
    account.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Drop for Reservation {
    fn drop(&mut self) {
        locked(&self.account).reserved -= self.reserved_usd;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_reserved_can_not_be_reserved_twice_and_comes_back() {
        let budget = Budget::new("this question", 1.0);
        let first = budget.reserve(0.6).unwrap();
        let refused = budget.reserve(0.6).unwrap_err();
        assert!((refused.left_usd - 0.4).abs() < 1e-9, "{refused}");
        drop(first);
        budget.reserve(0.6).unwrap().settle(0.7);
        assert!((budget.reserve(0.4).unwrap_err().left_usd - 0.3).abs() < 1e-9);
        // A call may cost more than thought: then nothing is left.
        budget.reserve(0.2).unwrap().settle(0.9);
        assert!(budget.reserve(0.0).is_err());
        assert!(Budget::new("nobody", 0.0).reserve(0.0).is_err());
        assert!(Budget::new("today", 2.0).with_spent(1.5).reserve(0.6).is_err());
    }
}
