//! The views that have masks of an object: only these say which Gaussians belong to it.

use super::consensus::MaskClusters;
use super::object::NONE;

/// Views in a word.
const WORD: usize = 64;

/// A set of views for each cluster of masks.
pub(super) struct ViewsOfClusters {
    words_per_cluster: usize,
    words: Vec<u64>,
}

impl ViewsOfClusters {
    pub(super) fn new(clusters: &MaskClusters, view_of_mask: &[u32]) -> Self {
        let n_views = view_of_mask.iter().max().map_or(0, |last| *last as usize + 1);
        let words_per_cluster = n_views.div_ceil(WORD);
        let mut words = vec![0u64; words_per_cluster * clusters.consensus.len()];
        for (cluster, view) in clusters.cluster_of_mask.iter().zip(view_of_mask).filter(|(c, _)| **c != NONE)
        {
            words[*cluster as usize * words_per_cluster + *view as usize / WORD] |=
                1 << (*view as usize % WORD);
        }
        Self { words_per_cluster, words }
    }

    /// Returns whether a view has a mask of a cluster.
    pub(super) fn has(&self, cluster: u32, view: u32) -> bool {
        let (word, bit) = (view as usize / WORD, view as usize % WORD);
        let words = &self.words[cluster as usize * self.words_per_cluster..][..self.words_per_cluster];
        words.get(word).is_some_and(|word| word >> bit & 1 == 1)
    }
}
