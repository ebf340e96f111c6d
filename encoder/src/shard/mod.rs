//! Stage 6: a cell's field becomes its shards.

mod photos;
mod positions;

use half::f16;
use rayon::prelude::*;
use slag_common::Gaussians;
use slag_common::appearance::AppearanceColumns;
use slag_common::hash::Hash32;
use slag_common::occupancy::Occupancy;
use slag_common::photo_poses::PhotoPoses;
use slag_common::shard::{
    Additions, Basis, ExactColumns, Fine, IndexColumn, Profile, Residuals, ScoreErrors, ShardHeader,
    ShardView,
};

use crate::cells::{Cell, CellSplit};
use crate::codebook::measure::ScoreMoments;
use crate::codebook::{self, CodebookSettings, ScoreMetricContext};
use crate::memory::{MemoryPlan, Phase};
use crate::objects::SceneObjects;
use crate::objects::shards::{CellObjects, CentroidBasis};
pub use photos::photo_poses;
use positions::QuantisedPositions;
use slag_math::matrix::Rows;

/// A cell's shard, with its entry in the manifest.
pub struct BuiltShard {
    /// The profile.
    pub profile: Profile,
    /// The file.
    pub bytes: Vec<u8>,
    /// Hard bound of a score's error.
    pub score_error_bound: f32,
    /// Measured errors of scores.
    pub score_errors: ScoreErrors,
}

/// A cell's shards.
pub struct BuiltCell {
    /// One per profile.
    pub shards: Vec<BuiltShard>,
    /// Centroids.
    pub n_centroids: u32,
    /// Subspaces of the residual code.
    pub n_subspaces: u32,
    /// Largest error of a position, world units.
    pub position_error: f64,
    /// Moments of the scores of all texts.
    pub moments: ScoreMoments,
    /// Gaussians without an embedding.
    pub n_without_evidence: usize,
}

/// The profiles to build, and their precision.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct ShardSettings {
    /// Profiles.
    pub profiles: Vec<Profile>,
    /// Precision of embeddings.
    pub codebook: CodebookSettings,
    /// Whether compact and balanced shards have the indices of their Gaussians in the input splat file, too.
    pub input_indices: bool,
    /// Whether shards tell how their Gaussians look.
    pub appearance: bool,
}

/// The embeddings of a cell's Gaussians.
pub struct CellEmbeddings {
    /// Components of an embedding.
    pub dim: usize,
    /// `[N][dim]`: unit, or zeros where there is no evidence.
    pub vectors: Vec<f32>,
    /// `[N]`: whether there is evidence.
    pub has_evidence: Vec<bool>,
}

/// Returns the bytes that building the shards of a cell of `n_gaussians` takes: embeddings in f32, in f16 and in the shard,
/// and the codebook.
pub fn working_bytes(n_gaussians: usize, dim: usize) -> u64 {
    let per_component = size_of::<f32>() + 2 * size_of::<f16>();
    (n_gaussians * (dim * per_component + codebook::working_bytes_per_embedding(dim))) as u64
}

/// Returns the bytes that building the shards of a scene's largest cell takes.
pub fn largest_cell_bytes(split: &CellSplit, dim: usize) -> u64 {
    largest_cells_bytes(split, dim, 1)
}

/// Returns the bytes that building the shards of a scene's `n` largest cells takes at the same time.
pub fn largest_cells_bytes(split: &CellSplit, dim: usize, n: usize) -> u64 {
    let mut sizes: Vec<usize> = split.cells.iter().map(|cell| cell.gaussians.len()).collect();
    sizes.sort_unstable_by_key(|n_gaussians| std::cmp::Reverse(*n_gaussians));
    sizes.iter().take(n).map(|n_gaussians| working_bytes(*n_gaussians, dim)).sum()
}

/// Reserves the bytes of the largest cell.
pub fn reserve(memory: &mut MemoryPlan, split: &CellSplit, dim: usize) {
    memory.reserve_expecting(Phase::Cells, "the largest cell", largest_cell_bytes(split, dim), 0);
}

/// Returns the bytes that cells of at most `len_bytes` are expected to take, as measured: the precision of the default needs half
/// of the coordinates, and without the exact profile there are no embeddings in f16.
pub fn expected_bytes(len_bytes: u64) -> u64 {
    len_bytes / 20 * 9
}

/// What a cell's shards carry besides Gaussians and their embeddings.
#[derive(Default)]
pub struct CellExtras<'a> {
    /// The objects of the scene, if it has any.
    pub objects: Option<&'a SceneObjects>,
    /// The free and occupied places of the cell, if they were asked for.
    pub occupancy: Option<Occupancy<'a>>,
    /// Where the photos of the cell were taken, if that was asked for.
    pub photo_poses: Option<PhotoPoses<'a>>,
}

/// Builds a cell's shards.
#[expect(clippy::too_many_arguments, reason = "the parts of a cell")]
pub fn build(
    scene: &Gaussians,
    cell_id: u32,
    cell: &Cell,
    embeddings: &CellEmbeddings,
    encoder_id: Hash32,
    score_context: &ScoreMetricContext,
    settings: &ShardSettings,
    extras: &CellExtras<'_>,
) -> BuiltCell {
    let dim = embeddings.dim;
    let (with, without): (Vec<u32>, Vec<u32>) =
        (0..cell.gaussians.len() as u32).partition(|local| embeddings.has_evidence[*local as usize]);
    let rows = Rows { values: &embeddings.vectors, width: dim, index: Some(&with) };
    let has_fine = settings.profiles.contains(&Profile::Exact);
    let codebook = codebook::build(rows, score_context, &CodebookSettings { has_fine, ..settings.codebook });
    let n_with = with.len();
    // Shard order: by centroid, then along the Morton curve, the order of locals.
    let in_order = codebook.order.iter().map(|at| with[*at as usize]);
    let locals: Vec<u32> = in_order.chain(without.iter().copied()).collect();

    let in_input = || locals.iter().map(|local| cell.gaussians[*local as usize]).collect::<Vec<u32>>();
    let appearance = settings.appearance.then(|| AppearanceColumns::of(scene, &in_input()));
    let packed_indices = settings.input_indices.then(|| IndexColumn::pack(&in_input()));
    let positions = QuantisedPositions::new(scene, cell, &locals);
    let header = ShardHeader {
        cell_id,
        n_gaussians: locals.len() as u32,
        n_centroids: codebook.radii.len() as u32,
        dim: dim as u32,
        n_components: codebook.n_components as u32,
        n_subspaces: 0,
        position_bits: cell.grid.bits,
        centroid_step: codebook.centroid_step,
        origin_in_world: cell.mean_bounds.min.to_array(),
        position_step: cell.grid.step,
        box_min: cell.bounds.min.to_array(),
        box_max: cell.bounds.max.to_array(),
        errors: codebook.errors,
        encoder_id: encoder_id.0,
    };
    let compact = ShardView {
        header,
        positions: positions.view(),
        centroid_starts: &codebook.centroid_starts,
        centroids: &codebook.centroids,
        radii: &codebook.radii,
        basis: Some(Basis { mean: &codebook.mean, vectors: &codebook.basis, steps: &codebook.basis_steps }),
        residuals: None,
        exact: None,
        packed_indices: packed_indices.as_ref().map(IndexColumn::view),
    };
    let balanced = codebook.residuals.as_ref().map_or(compact, |residuals| ShardView {
        header: ShardHeader {
            n_subspaces: residuals.code.n_subspaces() as u32,
            errors: residuals.errors,
            ..header
        },
        radii: &residuals.radii,
        residuals: Some(Residuals {
            subspace_starts: &residuals.code.subspace_starts,
            codewords: &residuals.code.codewords,
            residual_scales: &residuals.residual_scales,
            residual_norms: &residuals.residual_norms,
            codes: &residuals.codes,
        }),
        ..compact
    });
    let of_cell =
        |objects| CellObjects::new(objects, cell_id, &locals, &CentroidBasis::new(dim, compact.basis));
    let objects = extras.objects.map(of_cell);
    let objects = objects.as_ref().map(CellObjects::view);
    let largest = |radii: &[f32]| radii.iter().copied().fold(0.0, f32::max);
    let spread = codebook.errors.spread;
    let built = |profile, view: &ShardView<'_>| {
        let mut bytes = Vec::new();
        let appearance = appearance.as_ref().map(AppearanceColumns::view);
        let additions = Additions {
            objects: objects.as_ref(),
            appearance,
            occupancy: extras.occupancy.as_ref(),
            photo_poses: extras.photo_poses,
        };
        view.write_with(&mut bytes, additions).expect("writing to memory cannot fail");
        let (score_error_bound, score_errors) = match profile {
            Profile::Exact => (F16_ROUNDING, ScoreErrors { spread, ..ScoreErrors::default() }),
            _ => (largest(view.radii), view.header.errors),
        };
        BuiltShard { profile, bytes, score_error_bound, score_errors }
    };
    let shards = Profile::ALL.into_iter().filter(|profile| settings.profiles.contains(profile));
    let shards = shards.map(|profile| match profile {
        Profile::Compact => built(profile, &compact),
        Profile::Balanced => built(profile, &balanced),
        Profile::Exact => {
            let input_indices = in_input();
            let mut halves = vec![f16::ZERO; n_with * dim];
            halves.par_chunks_exact_mut(dim).zip(&locals[..n_with]).for_each(|(out, local)| {
                let embedding = &embeddings.vectors[*local as usize * dim..][..dim];
                out.iter_mut().zip(embedding).for_each(|(o, v)| *o = f16::from_f32(*v));
            });
            // Codes and fine residuals decide which embeddings readers look at.
            let fine = codebook.residuals.as_ref().and_then(|residuals| residuals.fine.as_ref());
            let fine = fine.map(|fine| Fine {
                errors: fine.errors,
                steps: &fine.steps,
                scales: &fine.scales,
                values: &fine.values,
            });
            let exact = Some(ExactColumns { input_indices: &input_indices, embeddings: &halves, fine });
            built(profile, &ShardView { radii: compact.radii, exact, packed_indices: None, ..balanced })
        }
    });
    BuiltCell {
        shards: shards.collect(),
        n_centroids: header.n_centroids,
        n_subspaces: balanced.header.n_subspaces,
        position_error: positions.error,
        moments: codebook.moments,
        n_without_evidence: without.len(),
    }
}

/// Largest distance between an embedding and its f16 form: half a step of f16 at 1, and of its denormals.
const F16_ROUNDING: f32 = 5e-4;
