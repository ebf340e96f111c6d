//! Superpoints are joined pair by pair, those with most affinity first: each join is a candidate for an object,
//! from a side of a cup to the whole table.
//!
//! The affinity of two sets is that of all their pairs that lie near each other, added up (average linkage, Sokal
//! and Michener 1958).

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

use super::affinity::Evidence;

/// A forest over superpoints.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Tree {
    /// Superpoints: nodes 0 to `n_leaves - 1`.
    pub(super) n_leaves: usize,
    /// The two parts of each further node; both have lower numbers.
    pub(super) parts: Vec<[u32; 2]>,
}

/// Two slots to be joined: affinity as bits, which have the order of positive numbers, then the slots.
type Pair = (u64, Reverse<u32>, Reverse<u32>);

impl Tree {
    /// Joins `n` superpoints until no two have evidence. Of equal affinities the pair with the lowest numbers
    /// comes first; a join goes by the number of the part that is near more others, of equally many the lower one.
    pub(super) fn new(n: usize, pairs: &[(u32, u32, Evidence)]) -> Self {
        let mut tree = Self { n_leaves: n, parts: Vec::new() };
        let mut neighbours: Vec<BTreeMap<u32, Evidence>> = vec![BTreeMap::new(); n];
        for (a, b, evidence) in pairs {
            neighbours[*a as usize].insert(*b, *evidence);
            neighbours[*b as usize].insert(*a, *evidence);
        }
        let bits = |evidence: &Evidence| evidence.affinity().to_bits();
        let pair = |a: u32, b: u32, evidence: &Evidence| -> Pair {
            (bits(evidence), Reverse(a.min(b)), Reverse(a.max(b)))
        };
        let mut waiting: BinaryHeap<Pair> =
            pairs.iter().map(|(a, b, evidence)| pair(*a, *b, evidence)).collect();
        let mut node_of: Vec<u32> = (0..n as u32).collect();
        while let Some((affinity, Reverse(a), Reverse(b))) = waiting.pop() {
            // Otherwise one of them has been joined, or has other evidence since.
            if neighbours[a as usize].get(&b).map(bits) != Some(affinity) {
                continue;
            }
            let n_of = |slot: u32| neighbours[slot as usize].len();
            let (kept, gone) = if n_of(b) > n_of(a) { (b, a) } else { (a, b) };
            tree.parts.push([node_of[a as usize], node_of[b as usize]]);
            node_of[kept as usize] = (n + tree.parts.len() - 1) as u32;
            for (other, evidence) in std::mem::take(&mut neighbours[gone as usize]) {
                neighbours[other as usize].remove(&gone);
                if other == kept {
                    continue;
                }
                let sum = neighbours[kept as usize].entry(other).or_default();
                *sum += evidence;
                let sum = *sum;
                neighbours[other as usize].insert(kept, sum);
                waiting.push(pair(kept, other, &sum));
            }
        }
        tree
    }

    pub(super) fn len(&self) -> usize {
        self.n_leaves + self.parts.len()
    }

    /// Returns the parts of a node; `None` for a superpoint.
    pub(super) fn parts_of(&self, node: usize) -> Option<[usize; 2]> {
        let at = node.checked_sub(self.n_leaves)?;
        Some(self.parts[at].map(|part| part as usize))
    }

    /// Returns the nodes that are part of no other, ascending.
    pub(super) fn roots(&self) -> impl Iterator<Item = usize> {
        let mut is_part = vec![false; self.len()];
        self.parts.iter().flatten().for_each(|part| is_part[*part as usize] = true);
        (0..self.len()).filter(move |node| !is_part[*node])
    }
}
