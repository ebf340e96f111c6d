//! Source of the vectors of a push.

use std::path::PathBuf;

use glam::DVec3;
use half::f16;
use slag_common::Hash32;
use slag_common::container::ContainerError;
use slag_common::manifest::CellRecord;
use slag_common::shard::{Profile, ShardLayout};

use crate::store::{StoreError, StoreReader};

/// The Gaussians of a cell that have an embedding, in a fixed order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CellVectors {
    /// `[n]` index in the input splat file.
    pub input_indices: Vec<u32>,
    /// `[n]` means, world frame.
    pub means_in_world: Vec<DVec3>,
    /// `[n][dim]` unit embeddings.
    pub embeddings: Vec<f16>,
    /// Gaussians of the cell without an embedding; the columns omit them.
    pub n_without_evidence: u64,
}

impl CellVectors {
    /// Checks that the columns have matching lengths.
    pub(super) fn check(&self, cell_id: u32, dim: u32) -> Result<(), SourceError> {
        let (n_indices, n_means) = (self.input_indices.len(), self.means_in_world.len());
        let n_components = self.embeddings.len();
        if n_means == n_indices && Some(n_components) == n_indices.checked_mul(dim as usize) {
            return Ok(());
        }
        Err(SourceError::Columns { cell_id, n_indices, n_means, n_components, dim })
    }
}

/// Reads the embeddings of a cell, in the same order at each call.
pub trait VectorSource: Send + Sync {
    /// Returns a cell's vectors.
    ///
    /// # Errors
    /// [`SourceError`].
    fn load(&self, cell: &CellRecord) -> Result<CellVectors, SourceError>;
}

/// Why the vectors of a cell cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// The scene was published without this profile.
    #[error("cell {cell_id} has no shard of profile {profile}; encode the scene with that profile")]
    NoShard {
        /// The cell.
        cell_id: u32,
        /// The profile needed.
        profile: Profile,
    },
    /// The shard cannot be read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The shard is damaged.
    #[error("{}: {cause}", path.display())]
    Shard {
        /// The shard's file.
        path: PathBuf,
        /// The damage.
        cause: ContainerError,
    },
    /// The columns differ in length.
    #[error(
        "cell {cell_id}: {n_indices} indices, {n_means} means, {n_components} components; expected one mean and {dim} components an index; this is a bug, please report it"
    )]
    Columns {
        /// The cell.
        cell_id: u32,
        /// Indices.
        n_indices: usize,
        /// Means.
        n_means: usize,
        /// Components of all embeddings.
        n_components: usize,
        /// Components of one embedding.
        dim: u32,
    },
    /// The shard is intact, but differs from the manifest.
    #[error("{}: {what} is {found}, the manifest says {expected}; encode again", path.display())]
    Mismatch {
        /// The shard's file.
        path: PathBuf,
        /// Which value.
        what: &'static str,
        /// In the manifest.
        expected: String,
        /// In the shard.
        found: String,
    },
}

/// The `exact` shards of a store: embeddings as f16.
#[derive(Clone, Debug)]
pub struct ExactShards {
    reader: StoreReader,
}

impl ExactShards {
    /// Uses the current generation of a store.
    pub fn new(reader: StoreReader) -> Self {
        Self { reader }
    }
}

impl VectorSource for ExactShards {
    fn load(&self, cell: &CellRecord) -> Result<CellVectors, SourceError> {
        let none = SourceError::NoShard { cell_id: cell.cell_id, profile: Profile::Exact };
        let Some(record) = cell.shards.get(&Profile::Exact) else { return Err(none) };
        let path = self.reader.object_path(record.hash);
        let bytes = self.reader.read_object(record.hash)?;
        let layout =
            ShardLayout::check(&bytes).map_err(|cause| SourceError::Shard { path: path.clone(), cause })?;
        let shard = layout.view(&bytes);
        let Some(exact) = shard.exact else { return Err(none) };
        let encoder = &self.reader.manifest().encoder;
        let agree = |what, expected: &dyn ToString, found: &dyn ToString| {
            let (expected, found) = (expected.to_string(), found.to_string());
            if expected == found {
                return Ok(());
            }
            Err(SourceError::Mismatch { path: path.clone(), what, expected, found })
        };
        agree("cell id", &cell.cell_id, &shard.header.cell_id)?;
        agree("number of Gaussians", &cell.n_gaussians, &shard.header.n_gaussians)?;
        agree("dimension", &encoder.dim, &shard.header.dim)?;
        agree("encoder id", &encoder.id, &Hash32(shard.header.encoder_id))?;
        let n = shard.n_with_evidence();
        Ok(CellVectors {
            input_indices: exact.input_indices[..n].to_vec(),
            means_in_world: (0..n).map(|i| shard.position_in_world(i)).collect(),
            embeddings: exact.embeddings.to_vec(),
            n_without_evidence: u64::from(shard.header.n_gaussians) - n as u64,
        })
    }
}
