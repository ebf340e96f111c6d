//! Which points belong to which centroid.

use std::ops::Range;

/// Points in the order of their centroids.
pub(super) struct Members {
    /// By place in that order: the point.
    pub(super) order: Vec<u32>,
    /// `[K + 1]`: first place of each centroid.
    pub(super) starts: Vec<u32>,
}

impl Members {
    pub(super) fn new(codes: &[u32], n_centroids: usize) -> Self {
        let mut starts = vec![0u32; n_centroids + 1];
        codes.iter().for_each(|centroid| starts[*centroid as usize + 1] += 1);
        (0..n_centroids).for_each(|centroid| starts[centroid + 1] += starts[centroid]);
        let mut next = starts.clone();
        let mut order = vec![0; codes.len()];
        for (point, centroid) in codes.iter().enumerate() {
            order[next[*centroid as usize] as usize] = point as u32;
            next[*centroid as usize] += 1;
        }
        Self { order, starts }
    }

    pub(super) fn places(&self, centroid: usize) -> Range<usize> {
        self.starts[centroid] as usize..self.starts[centroid + 1] as usize
    }
}
