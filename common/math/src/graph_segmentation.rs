//! Graph-based segmentation (Felzenszwalb and Huttenlocher, "Efficient Graph-Based Image Segmentation", IJCV
//! 59(2), 2004): components of any weighted graph, grown over edges of ascending weight.
//!
//! Edges are decided in order, but few join anything. All threads first drop, block by block, those that cannot: their
//! ends are in one component already, or an end's component refuses even the lightest edge of the block. Both stay true
//! while others join: components only grow, and one that refuses an edge refuses all heavier ones, so it is never
//! joined again. The result is that of deciding each edge in turn.

use rayon::prelude::*;

use crate::union_find::{Numbering, UnionFind};

/// Edges tested in parallel at a time.
const BLOCK: usize = 1 << 17;

/// Components of a graph while they grow.
///
/// Visit the edges in ascending order of weight with [`Self::join_if_similar`] or [`Self::join_all_similar`], then
/// again with [`Self::join_if_small`] or [`Self::join_all_small`] to remove small components.
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
    /// `scale`: the paper's k, "scale of observation".
    pub fn new(n_vertices: usize, scale: f32) -> Self {
        let (sets, sizes) = (UnionFind::new(n_vertices), vec![1; n_vertices]);
        Self { sets, scale, sizes, thresholds: vec![scale; n_vertices] }
    }

    pub fn root(&mut self, vertex: u32) -> u32 {
        self.sets.root(vertex)
    }

    /// Vertices of the components, `[n]`, valid for roots.
    pub fn sizes(&self) -> &[u32] {
        &self.sizes
    }

    /// Joins the components of an edge's ends if `weight` is at most the largest inner weight of each plus `scale`
    /// over its size. Returns whether the ends are in one component now.
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

    /// Joins two components given by their roots; returns the common root.
    pub fn join_roots(&mut self, a: u32, b: u32) -> u32 {
        let is_larger = self.sizes[a as usize] >= self.sizes[b as usize];
        let (root, child) = if is_larger { (a, b) } else { (b, a) };
        self.sets.attach(child, root);
        self.sizes[root as usize] += self.sizes[child as usize];
        root
    }

    /// Numbers the components of some vertices in the order of first occurrence.
    pub fn number(&mut self, vertices: impl IntoIterator<Item = u32>) -> Numbering {
        self.sets.number(vertices)
    }
}

#[cfg(test)]
mod tests;
