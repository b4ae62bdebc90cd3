//! Disjoint sets whose representative is always the smallest member, so that results do not depend
//! on union order.

/// Disjoint sets over `0..len`.
#[derive(Debug, Clone)]
pub struct UnionFind {
    parent: Vec<u32>,
}

impl UnionFind {
    /// Creates `len` sets of one element each.
    #[must_use]
    pub fn new(len: usize) -> Self {
        Self { parent: (0..len as u32).collect() }
    }

    /// Returns the smallest member of `i`'s set.
    pub fn find(&mut self, i: u32) -> u32 {
        let mut i = i;
        while self.parent[i as usize] != i {
            let above = self.parent[self.parent[i as usize] as usize];
            self.parent[i as usize] = above;
            i = above;
        }
        i
    }

    /// Joins two sets. Returns the representative of the joined set.
    pub fn union(&mut self, a: u32, b: u32) -> u32 {
        let (a, b) = (self.find(a), self.find(b));
        let (low, high) = (a.min(b), a.max(b));
        self.parent[high as usize] = low;
        low
    }

    /// Returns a label in `0..n` for each element, numbered in order of each set's smallest member,
    /// and `n`.
    #[must_use]
    pub fn into_labels(mut self) -> (Vec<u32>, usize) {
        let mut labels = vec![0; self.parent.len()];
        let mut count = 0;
        for i in 0..self.parent.len() as u32 {
            let root = self.find(i);
            labels[i as usize] = if root == i {
                count += 1;
                count - 1
            } else {
                labels[root as usize]
            };
        }
        (labels, count as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Any order of the same unions gives the same labels.
        #[test]
        fn labels_do_not_depend_on_union_order(mut pairs in prop::collection::vec((0_u32..30, 0_u32..30), 0..40), seed in any::<u64>()) {
            let label = |pairs: &[(u32, u32)]| {
                let mut sets = UnionFind::new(30);
                for &(a, b) in pairs { sets.union(a, b); }
                sets.into_labels()
            };
            let forward = label(&pairs);
            let turn = (seed as usize) % pairs.len().max(1);
            pairs.rotate_left(turn);
            pairs.reverse();
            prop_assert_eq!(label(&pairs), forward);
        }
    }
}
