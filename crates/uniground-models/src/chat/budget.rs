//! Budgets: the money that a question, a batch or a day can spend.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// A spending limit in US dollars, shared by everything that spends from it.
#[derive(Debug, Clone)]
pub struct Budget {
    /// The budget's owner, for people: "this question".
    of: &'static str,
    limit_usd: f64,
    account: Arc<Mutex<Account>>,
}

/// Amounts in US dollars.
#[derive(Debug, Default)]
struct Account {
    spent: f64,
    /// Amount reserved for calls in progress.
    reserved: f64,
}

/// A call that was not made because a budget has too little left.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error(
    "the budget of {of} is spent: {left_usd:.6} of {limit_usd} US dollars are left, about {wanted_usd:.6} are needed"
)]
pub struct OverBudget {
    /// The budget's owner, for people: "this question".
    pub of: &'static str,
    /// The whole budget.
    pub limit_usd: f64,
    /// Amount neither spent nor reserved for calls in progress; at least 0.
    pub left_usd: f64,
    /// Estimated cost of the call.
    pub wanted_usd: f64,
}

/// Money reserved for a call. It is released on drop unless it was settled.
#[derive(Debug)]
pub struct Reservation {
    account: Arc<Mutex<Account>>,
    reserved_usd: f64,
}

impl Budget {
    /// Creates a budget with nothing spent. `of` names its owner ("this question"). The limit can
    /// be infinite.
    #[must_use]
    pub fn new(of: &'static str, limit_usd: f64) -> Self {
        Self { of, limit_usd, account: Arc::default() }
    }

    /// Creates a budget of which some was already spent.
    #[must_use]
    pub fn with_spent(self, usd: f64) -> Self {
        lock_account(&self.account).spent = usd;
        self
    }

    /// Returns the amount spent, US dollars.
    #[must_use]
    pub fn spent_usd(&self) -> f64 {
        lock_account(&self.account).spent
    }

    /// Reserves money for a call, so that concurrent calls cannot spend the same money. An
    /// exhausted budget pays for nothing, not even for calls that are estimated to be free.
    ///
    /// # Errors
    /// Returns [`OverBudget`] if too little is left.
    pub fn reserve(&self, usd: f64) -> Result<Reservation, OverBudget> {
        let mut account = lock_account(&self.account);
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
    /// Books the actual cost of the call and releases the reservation.
    pub fn settle(self, usd: f64) {
        lock_account(&self.account).spent += usd;
    }
}

fn lock_account(account: &Mutex<Account>) -> MutexGuard<'_, Account> {
    account.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Drop for Reservation {
    fn drop(&mut self) {
        lock_account(&self.account).reserved -= self.reserved_usd;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reserved_money_is_unavailable_until_released_or_settled() {
        let budget = Budget::new("this question", 1.0);
        let first = budget.reserve(0.6).unwrap();
        let refused = budget.reserve(0.6).unwrap_err();
        assert!((refused.left_usd - 0.4).abs() < 1e-9, "{refused}");
        drop(first);
        budget.reserve(0.6).unwrap().settle(0.7);
        assert!((budget.reserve(0.4).unwrap_err().left_usd - 0.3).abs() < 1e-9);
        // A call can cost more than estimated. Then nothing is left.
        budget.reserve(0.2).unwrap().settle(0.9);
        assert!(budget.reserve(0.0).is_err());
        assert!(Budget::new("nobody", 0.0).reserve(0.0).is_err());
        assert!(Budget::new("today", 2.0).with_spent(1.5).reserve(0.6).is_err());
    }
}
