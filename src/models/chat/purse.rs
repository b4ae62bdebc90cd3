//! Money that may be spent: a question's, a batch's, a day's.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// What may be spent, shared by everything that spends from it. US dollars.
#[derive(Debug, Clone)]
pub struct Purse {
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
    held: f64,
}

#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("the budget of {of} is spent: {limit_usd} US dollars, of which {left_usd:.6} are left and about {wanted_usd:.6} are needed")]
pub struct OverBudget {
    pub of: &'static str,
    pub limit_usd: f64,
    pub left_usd: f64,
    pub wanted_usd: f64,
}

/// Money put aside for a call; what was not settled goes back.
#[derive(Debug)]
pub struct Hold {
    account: Arc<Mutex<Account>>,
    held_usd: f64,
}

impl Purse {
    #[must_use]
    pub fn new(of: &'static str, limit_usd: f64) -> Self {
        Self { of, limit_usd, account: Arc::default() }
    }

    /// A purse of which some was spent before.
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

    /// Puts money aside for a call: calls at the same time can not spend the same money. An empty purse pays for nothing, not even for
    /// what seems to be free.
    ///
    /// # Errors
    /// [`OverBudget`].
    pub fn hold(&self, usd: f64) -> Result<Hold, OverBudget> {
        let mut account = locked(&self.account);
        let left_usd = self.limit_usd - account.spent - account.held;
        if left_usd <= 0.0 || usd > left_usd {
            return Err(OverBudget { of: self.of, limit_usd: self.limit_usd, left_usd: left_usd.max(0.0), wanted_usd: usd });
        }
        account.held += usd;
        Ok(Hold { account: self.account.clone(), held_usd: usd })
    }
}

impl Hold {
    /// The call is paid for; what was held goes back.
    pub fn settle(self, usd: f64) {
        locked(&self.account).spent += usd;
    }
}

fn locked(account: &Mutex<Account>) -> MutexGuard<'_, Account> {
    account.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Drop for Hold {
    fn drop(&mut self) {
        locked(&self.account).held -= self.held_usd;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_held_can_not_be_held_twice_and_comes_back() {
        let purse = Purse::new("this question", 1.0);
        let first = purse.hold(0.6).unwrap();
        let refused = purse.hold(0.6).unwrap_err();
        assert!((refused.left_usd - 0.4).abs() < 1e-9, "{refused}");
        drop(first);
        purse.hold(0.6).unwrap().settle(0.7);
        assert!((purse.hold(0.4).unwrap_err().left_usd - 0.3).abs() < 1e-9);
        // A call may cost more than thought: then nothing is left.
        purse.hold(0.2).unwrap().settle(0.9);
        assert!(purse.hold(0.0).is_err());
        assert!(Purse::new("nobody", 0.0).hold(0.0).is_err());
        assert!(Purse::new("today", 2.0).with_spent(1.5).hold(0.6).is_err());
    }
}
