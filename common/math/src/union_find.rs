//! Disjoint sets with path halving (Tarjan and van Leeuwen, "Worst-case Analysis of Set Union Algorithms", JACM
//! 31(2), 1984).

/// Stands for the number of an item that [`UnionFind::number`] was not given.
pub const NOT_NUMBERED: u32 = u32::MAX;

/// A partition of the items `0..n` into disjoint sets, each represented by one of its items, the root.
#[derive(Clone, Debug)]
pub struct UnionFind {
    parents: Vec<u32>,
}

/// Consecutive numbers for the sets of a partition.
#[derive(Clone, Debug, PartialEq)]
pub struct Numbering {
    /// `[n]`: the number of each item's set, [`NOT_NUMBERED`] for omitted items.
    pub of_item: Vec<u32>,
    /// Number of numbered items in each set.
    pub sizes: Vec<u32>,
}

impl UnionFind {
    /// Begins with sets of one item.
    pub fn new(n: usize) -> Self {
        Self { parents: (0..n as u32).collect() }
    }

    pub fn root(&mut self, mut item: u32) -> u32 {
        while self.parents[item as usize] != item {
            let grandparent = self.parents[self.parents[item as usize] as usize];
            self.parents[item as usize] = grandparent;
            item = grandparent;
        }
        item
    }

    /// Returns the root of an item's set without path halving, so that threads can share it.
    pub fn root_of(&self, mut item: u32) -> u32 {
        while self.parents[item as usize] != item {
            item = self.parents[item as usize];
        }
        item
    }

    pub fn attach(&mut self, child: u32, root: u32) {
        self.parents[child as usize] = root;
    }

    /// Numbers the sets of some items in the order of first occurrence.
    pub fn number(&mut self, items: impl IntoIterator<Item = u32>) -> Numbering {
        let mut number_of_root = vec![NOT_NUMBERED; self.parents.len()];
        let mut of_item = vec![NOT_NUMBERED; self.parents.len()];
        let mut sizes = Vec::new();
        for item in items {
            let number = &mut number_of_root[self.root(item) as usize];
            if *number == NOT_NUMBERED {
                *number = sizes.len() as u32;
                sizes.push(0);
            }
            sizes[*number as usize] += 1;
            of_item[item as usize] = *number;
        }
        Numbering { of_item, sizes }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    /// Oracle: labels rewritten at every union.
    #[test]
    fn sets_are_those_of_relabelling() {
        let mut random = Random::new(3);
        for n in [1_usize, 2, 50, 300] {
            let (mut sets, mut labels) = (UnionFind::new(n), (0..n).collect::<Vec<_>>());
            for _ in 0..n {
                let (a, b) = (random.below(n), random.below(n));
                let (root, child) = (sets.root(a as u32), sets.root(b as u32));
                assert_eq!(root == child, labels[a] == labels[b]);
                sets.attach(child, root);
                let (kept, replaced) = (labels[a], labels[b]);
                labels.iter_mut().filter(|label| **label == replaced).for_each(|label| *label = kept);
            }
            let Numbering { of_item, sizes } = sets.number((0..n as u32).filter(|item| item % 3 != 1));
            let numbered = |i: &usize| i % 3 != 1;
            let mut order: Vec<usize> = Vec::new();
            for i in (0..n).filter(numbered) {
                if !order.contains(&labels[i]) {
                    order.push(labels[i]);
                }
                assert_eq!(order[of_item[i] as usize], labels[i]);
            }
            let size =
                |label: &usize| (0..n).filter(numbered).filter(|i| labels[*i] == *label).count() as u32;
            assert_eq!(sizes, order.iter().map(size).collect::<Vec<_>>());
            assert!((0..n).filter(|i| !numbered(i)).all(|i| of_item[i] == NOT_NUMBERED));
        }
    }
}
