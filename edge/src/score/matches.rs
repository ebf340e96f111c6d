//! Gaussians found by a search, and its cost.

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Index of the shard in the searched slice.
    pub shard: u32,
    pub index: u32,
    /// The Gaussian's own score if the shard has a code or embedding that the precision uses; else its centroid's.
    pub score: f32,
}

/// Adjacent matching Gaussians of one shard that share a score.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Run {
    /// Index of the shard in the searched slice.
    pub shard: u32,
    pub start: u32,
    /// One past the last member.
    pub end: u32,
    /// Score of the centroid, or of a Gaussian scored individually.
    pub score: f32,
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Matches {
    /// Disjoint runs, by shard and start, ascending.
    pub runs: Vec<Run>,
    pub n_gaussians: u64,
    pub effort: Effort,
}

/// Work done beyond scoring centroids.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Effort {
    pub n_rescored: u64,
    pub n_fine_read: u64,
    pub n_embeddings_read: u64,
}

impl std::ops::AddAssign for Effort {
    fn add_assign(&mut self, other: Self) {
        self.n_rescored += other.n_rescored;
        self.n_fine_read += other.n_fine_read;
        self.n_embeddings_read += other.n_embeddings_read;
    }
}
