//! Graph-based segmentation (Felzenszwalb and Huttenlocher, "Efficient Graph-Based Image Segmentation", IJCV 59(2),
//! 2004): components of any weighted graph, grown over edges of ascending weight.
//!
//! Edges are decided one after the other, but few of them join anything. Those that cannot are dropped by all threads
//! before, block by block: their ends are in one component already, or an end's component refuses even the lightest edge of
//! the block. Both stay so whatever is joined in between: components only grow, and one that refuses an edge refuses all
//! heavier ones, so that it is never joined again. The result is that of deciding each edge in turn.

use rayon::prelude::*;

use crate::union_find::{Numbering, UnionFind};

/// Edges that are looked at together.
const BLOCK: usize = 1 << 17;

/// Components of a graph while they grow.
///
/// The caller visits the edges in ascending order of weight and calls [`Self::join_if_similar`] for each, or
/// [`Self::join_all_similar`] for all; a second visit with [`Self::join_if_small`] or [`Self::join_all_small`] removes
/// components that are too small.
#[derive(Clone, Debug)]
pub struct Components {
    sets: UnionFind,
    scale: f32,
    /// `[n]`; valid for roots.
    sizes: Vec<u32>,
    /// `[n]`; valid for roots: the largest weight of an edge that the component accepts.
    thresholds: Vec<f32>,
}

impl Components {
    /// Returns the components of one vertex each. `scale`: the paper's k, "scale of observation".
    pub fn new(n_vertices: usize, scale: f32) -> Self {
        let (sets, sizes) = (UnionFind::new(n_vertices), vec![1; n_vertices]);
        Self { sets, scale, sizes, thresholds: vec![scale; n_vertices] }
    }

    /// Returns the root of a vertex's component.
    pub fn root(&mut self, vertex: u32) -> u32 {
        self.sets.root(vertex)
    }

    /// Returns the numbers of vertices of the components, `[n]`, valid for roots.
    pub fn sizes(&self) -> &[u32] {
        &self.sizes
    }

    /// Joins the components of an edge's ends if `weight` is at most the largest inner weight of either component
    /// plus `scale` over its size. Returns whether the ends are in one component now.
    pub fn join_if_similar(&mut self, a: u32, b: u32, weight: f32) -> bool {
        let (a, b) = (self.root(a), self.root(b));
        if a == b {
            return true;
        }
        let is_similar = weight <= self.thresholds[a as usize].min(self.thresholds[b as usize]);
        if !is_similar {
            return false;
        }
        let root = self.join_roots(a, b) as usize;
        self.thresholds[root] = weight + self.scale / self.sizes[root] as f32;
        true
    }

    /// Joins the components of an edge's ends if one of them has fewer than `min_size` vertices.
    pub fn join_if_small(&mut self, a: u32, b: u32, min_size: u32) {
        let (a, b) = (self.root(a), self.root(b));
        if a != b && self.sizes[a as usize].min(self.sizes[b as usize]) < min_size {
            self.join_roots(a, b);
        }
    }

    /// Calls [`Self::join_if_similar`] for edges in ascending order of weight. `of`: ends and weight of an edge.
    pub fn join_all_similar<E: Sync>(&mut self, edges: &[E], of: impl Fn(&E) -> (u32, u32, f32) + Sync) {
        for block in edges.chunks(BLOCK) {
            let components = &*self;
            let (_, _, lightest) = of(&block[0]);
            let may_join = |edge: &&E| {
                let (a, b, _) = of(edge);
                let (a, b) = (components.sets.root_of(a), components.sets.root_of(b));
                let threshold = components.thresholds[a as usize].min(components.thresholds[b as usize]);
                a != b && lightest <= threshold
            };
            let left: Vec<&E> = block.par_iter().filter(may_join).collect();
            for (a, b, weight) in left.into_iter().map(&of) {
                self.join_if_similar(a, b, weight);
            }
        }
    }

    /// Calls [`Self::join_if_small`] for edges in ascending order of weight. `of`: ends and weight of an edge.
    pub fn join_all_small<E: Sync>(
        &mut self,
        edges: &[E],
        of: impl Fn(&E) -> (u32, u32, f32) + Sync,
        min_size: u32,
    ) {
        for block in edges.chunks(BLOCK) {
            let components = &*self;
            let may_join = |edge: &&E| {
                let (a, b, _) = of(edge);
                let (a, b) = (components.sets.root_of(a), components.sets.root_of(b));
                a != b && components.sizes[a as usize].min(components.sizes[b as usize]) < min_size
            };
            let left: Vec<&E> = block.par_iter().filter(may_join).collect();
            for (a, b, _) in left.into_iter().map(&of) {
                self.join_if_small(a, b, min_size);
            }
        }
    }

    /// Joins two components, given by their roots, whatever their weights; returns the root of both.
    pub fn join_roots(&mut self, a: u32, b: u32) -> u32 {
        let is_larger = self.sizes[a as usize] >= self.sizes[b as usize];
        let (root, child) = if is_larger { (a, b) } else { (b, a) };
        self.sets.attach(child, root);
        self.sizes[root as usize] += self.sizes[child as usize];
        root
    }

    /// Numbers the components of some vertices in the order in which the vertices meet them.
    pub fn number(&mut self, vertices: impl IntoIterator<Item = u32>) -> Numbering {
        self.sets.number(vertices)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A path of two flat stretches, a step between them and one vertex apart; worked out by hand.
    #[test]
    fn a_step_separates_and_a_small_component_joins_its_neighbour() {
        let heights = [0.0_f32, 0.1, 0.2, 0.3, 5.0, 5.1, 5.2, 9.0];
        let mut edges: Vec<(f32, u32, u32)> =
            (0..7).map(|i| ((heights[i + 1] - heights[i]).abs(), i as u32, i as u32 + 1)).collect();
        edges.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut components = Components::new(8, 2.0);
        for (weight, a, b) in &edges {
            components.join_if_similar(*a, *b, *weight);
        }
        assert_eq!(components.number(0..8).of_item, [0, 0, 0, 0, 1, 1, 1, 2]);
        edges.iter().for_each(|(_, a, b)| components.join_if_small(*a, *b, 2));
        let numbering = components.number(0..8);
        assert_eq!((numbering.of_item, numbering.sizes), (vec![0, 0, 0, 0, 1, 1, 1, 1], vec![4, 4]));
    }

    /// Oracle: each edge in turn. Weights repeat, so that equal ones come in one block.
    #[test]
    fn all_at_once_is_as_one_by_one() {
        let mut random = crate::random::Random::new(17);
        for (n, n_edges, scale) in [(40, 200, 0.3_f32), (5_000, 400_000, 0.02), (200_000, 900_000, 1.5)] {
            let mut edge = || {
                let a = random.below(n);
                // Mostly near, so that components are regions and not one.
                let b = (a + 1 + random.below(6)) % n;
                ((random.below(1000) as f32) / 1000.0, a as u32, b as u32)
            };
            let mut edges: Vec<(f32, u32, u32)> = (0..n_edges).map(|_| edge()).collect();
            edges.sort_by(|a, b| a.partial_cmp(b).expect("no NaN"));
            let (mut one_by_one, mut at_once) = (Components::new(n, scale), Components::new(n, scale));
            for (weight, a, b) in &edges {
                one_by_one.join_if_similar(*a, *b, *weight);
            }
            at_once.join_all_similar(&edges, |(weight, a, b)| (*a, *b, *weight));
            let numbered = |components: &mut Components| components.number(0..n as u32);
            let expected = numbered(&mut one_by_one);
            assert!(expected.sizes.len() > n / 100 && expected.sizes.len() < n, "{}", expected.sizes.len());
            assert!(numbered(&mut at_once) == expected, "{n} vertices");
            edges.iter().for_each(|(_, a, b)| one_by_one.join_if_small(*a, *b, 30));
            at_once.join_all_small(&edges, |(weight, a, b)| (*a, *b, *weight), 30);
            assert!(numbered(&mut at_once) == numbered(&mut one_by_one), "{n} vertices, small ones joined");
        }
    }

    /// The threshold of a component falls with its size: what one vertex accepts, ten do not.
    #[test]
    fn large_components_accept_less() {
        let mut components = Components::new(12, 3.0);
        assert!(components.join_if_similar(10, 11, 1.0));
        (0..9).for_each(|i| assert!(components.join_if_similar(i, i + 1, 0.0)));
        assert!(!components.join_if_similar(9, 10, 1.0));
        let root = components.root(0);
        assert_eq!(components.sizes()[root as usize], 10);
    }
}
