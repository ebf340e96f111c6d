//! Stage 6: a cell's field becomes its shards.

use glam::DVec3;
use half::f16;
use rayon::prelude::*;
use slag_common::appearance::AppearanceColumns;
use slag_common::hash::Hash32;
use slag_common::landmarks::{BuiltLandmarks, Landmark};
use slag_common::objects::Objects;
use slag_common::photo_poses::BuiltPhotoPoses;
use slag_common::shard::{
    Additions, ExactColumns, IndexColumn, PositionForm, Positions, Profile, Residuals, ScoreErrors,
    ShardHeader, ShardView,
};
use slag_common::{Gaussians, View};
use slag_math::matrix::Rows;

use crate::cells::{Cell, CellSplit};
use crate::codebook::measure::ScoreMoments;
use crate::codebook::{self, Codebook, CodebookResiduals, CodebookSettings, ScoreMetricContext};
use crate::memory::{MemoryPlan, Phase};
use crate::objects::SceneObjects;
use crate::objects::shards::{CellObjects, CentroidBasis};

pub struct BuiltShard {
    pub profile: Profile,
    pub bytes: Vec<u8>,
    pub score_error_bound: f32,
    pub score_errors: ScoreErrors,
}

pub struct BuiltCell {
    /// One per profile.
    pub shards: Vec<BuiltShard>,
    pub n_centroids: u32,
    pub n_subspaces: u32,
    pub position_error: f64,
    pub moments: ScoreMoments,
    pub n_without_evidence: usize,
}

#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct ShardSettings {
    pub profiles: Vec<Profile>,
    /// Precision of embeddings.
    pub codebook: CodebookSettings,
    /// Whether compact and balanced shards have the indices of their Gaussians in the input splat file, too.
    pub input_indices: bool,
    /// Whether compact shards tell how their Gaussians and objects look, as the others do.
    pub compact_appearance: bool,
}

impl ShardSettings {
    /// Whether some shards have the appearance of Gaussians and objects.
    pub fn have_appearance(&self) -> bool {
        self.compact_appearance || self.profiles.iter().any(|profile| *profile != Profile::Compact)
    }
}

pub struct CellEmbeddings {
    pub dim: usize,
    /// `[N][dim]`: unit, or zeros without evidence.
    pub vectors: Vec<f32>,
    pub has_evidence: Vec<bool>,
}

/// Bytes to build the shards of a cell: embeddings in f32, in f16 and in the shard, and the codebook.
pub(crate) fn working_bytes(n_gaussians: usize, dim: usize) -> u64 {
    let per_component = size_of::<f32>() + 2 * size_of::<f16>();
    (n_gaussians * (dim * per_component + codebook::working_bytes_per_embedding(dim))) as u64
}

pub(crate) fn largest_cell_bytes(split: &CellSplit, dim: usize) -> u64 {
    let largest = split.cells.iter().map(|cell| cell.gaussians.len()).max();
    largest.map_or(0, |n_gaussians| working_bytes(n_gaussians, dim))
}

pub(crate) fn reserve(memory: &mut MemoryPlan, split: &CellSplit, dim: usize) {
    memory.reserve(Phase::Cells, "the largest cell", largest_cell_bytes(split, dim));
}

#[derive(Clone, Copy)]
pub struct ShardBuilder<'a> {
    pub scene: &'a Gaussians,
    pub encoder_id: Hash32,
    pub score_context: &'a ScoreMetricContext,
    pub settings: &'a ShardSettings,
}

/// A cell's Gaussians in the order of its shards: by centroid, then along the Morton curve; those without evidence
/// last. Three numbers name a Gaussian: its place in this order, its *local* (its place in [`Cell::gaussians`] and in
/// [`CellEmbeddings`]) and its index in the input.
struct ShardOrder<'a> {
    cell: &'a Cell,
    /// By place: the local.
    locals: Vec<u32>,
    n_with_evidence: usize,
}

impl ShardOrder<'_> {
    fn in_input(&self) -> Vec<u32> {
        self.locals.iter().map(|local| self.cell.gaussians[*local as usize]).collect()
    }

    /// Embeddings in f16, `[n_with_evidence][dim]`.
    fn halves(&self, embeddings: &CellEmbeddings) -> Vec<f16> {
        let dim = embeddings.dim;
        let mut halves = vec![f16::ZERO; self.n_with_evidence * dim];
        halves.par_chunks_exact_mut(dim).zip(&self.locals).for_each(|(out, local)| {
            let embedding = &embeddings.vectors[*local as usize * dim..][..dim];
            out.iter_mut().zip(embedding).for_each(|(o, v)| *o = f16::from_f32(*v));
        });
        halves
    }
}

impl ShardBuilder<'_> {
    pub fn build(
        &self,
        cell_id: u32,
        cell: &Cell,
        embeddings: &CellEmbeddings,
        objects: Option<&SceneObjects>,
        additions: Additions<'_>,
    ) -> BuiltCell {
        let (settings, dim) = (self.settings, embeddings.dim);
        let (codebook, order) = self.codebook(cell, embeddings);
        let positions = QuantisedPositions::new(self.scene, cell, &order.locals);
        let packed_indices = settings.input_indices.then(|| IndexColumn::pack(&order.in_input()));
        let compact = ShardView {
            header: self.header(cell_id, cell, &codebook, dim),
            positions: positions.view(),
            centroid_starts: &codebook.centroid_starts,
            centroids: &codebook.centroids,
            radii: &codebook.radii,
            basis: Some(codebook.stored_basis()),
            residuals: None,
            exact: None,
            packed_indices: packed_indices.as_ref().map(IndexColumn::view),
        };
        let balanced = with_residuals(&compact, codebook.residuals.as_ref());
        let of_cell = |objects| {
            CellObjects::new(objects, cell_id, &order.locals, &CentroidBasis::new(dim, compact.basis))
        };
        let objects = objects.map(of_cell);
        let objects = objects.as_ref().map(CellObjects::view);
        let appearance =
            settings.have_appearance().then(|| AppearanceColumns::of(self.scene, &order.in_input()));
        let appearance = appearance.as_ref().map(AppearanceColumns::view);
        let additions = Additions { objects, appearance, ..additions };
        let chosen = Profile::ALL.into_iter().filter(|profile| settings.profiles.contains(profile));
        let shards = chosen.map(|profile| match profile {
            Profile::Compact if settings.compact_appearance => built(profile, &compact, additions),
            Profile::Compact => {
                let objects = objects.map(|objects| Objects { thumbnails: None, ..objects });
                built(profile, &compact, Additions { appearance: None, objects, ..additions })
            }
            Profile::Balanced => built(profile, &balanced, additions),
            Profile::Exact => {
                let exact = Some(ExactColumns {
                    input_indices: &order.in_input(),
                    embeddings: &order.halves(embeddings),
                    // Codes and fine residuals decide which embeddings readers look at.
                    fine: codebook.fine(),
                });
                let view = ShardView { radii: compact.radii, exact, packed_indices: None, ..balanced };
                built(profile, &view, additions)
            }
        });
        BuiltCell {
            shards: shards.collect(),
            n_centroids: compact.header.n_centroids,
            n_subspaces: balanced.header.n_subspaces,
            position_error: positions.error,
            moments: codebook.moments,
            n_without_evidence: order.locals.len() - order.n_with_evidence,
        }
    }

    fn codebook<'c>(&self, cell: &'c Cell, embeddings: &CellEmbeddings) -> (Codebook, ShardOrder<'c>) {
        let (with, without): (Vec<u32>, Vec<u32>) =
            (0..cell.gaussians.len() as u32).partition(|local| embeddings.has_evidence[*local as usize]);
        let rows = Rows { values: &embeddings.vectors, width: embeddings.dim, index: Some(&with) };
        let has_fine = self.settings.profiles.contains(&Profile::Exact);
        let settings = CodebookSettings { has_fine, ..self.settings.codebook };
        let codebook = codebook::build(rows, self.score_context, &settings);
        let in_order = codebook.order.iter().map(|at| with[*at as usize]);
        let locals = in_order.chain(without).collect();
        (codebook, ShardOrder { cell, locals, n_with_evidence: with.len() })
    }

    fn header(&self, cell_id: u32, cell: &Cell, codebook: &Codebook, dim: usize) -> ShardHeader {
        ShardHeader {
            cell_id,
            n_gaussians: cell.gaussians.len() as u32,
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
            encoder_id: self.encoder_id.0,
        }
    }
}

/// Balanced shard of a compact one; the same if no residual code is needed.
fn with_residuals<'a>(compact: &ShardView<'a>, residuals: Option<&'a CodebookResiduals>) -> ShardView<'a> {
    let Some(residuals) = residuals else { return *compact };
    ShardView {
        header: ShardHeader {
            n_subspaces: residuals.code.n_subspaces() as u32,
            errors: residuals.errors,
            ..compact.header
        },
        radii: &residuals.radii,
        residuals: Some(Residuals {
            subspace_starts: &residuals.code.subspace_starts,
            codewords: &residuals.code.codewords,
            residual_scales: &residuals.residual_scales,
            residual_norms: &residuals.residual_norms,
            codes: &residuals.codes,
        }),
        ..*compact
    }
}

fn built(profile: Profile, view: &ShardView<'_>, additions: Additions<'_>) -> BuiltShard {
    let mut bytes = Vec::new();
    view.write_with(&mut bytes, additions).expect("writing to memory cannot fail");
    let (score_error_bound, score_errors) = match profile {
        Profile::Exact => {
            (F16_ROUNDING, ScoreErrors { spread: view.header.errors.spread, ..ScoreErrors::default() })
        }
        _ => (view.radii.iter().copied().fold(0.0, f32::max), view.header.errors),
    };
    BuiltShard { profile, bytes, score_error_bound, score_errors }
}

/// Largest distance between an embedding and its f16 form: half a step of f16 at 1, and of its denormals.
const F16_ROUNDING: f32 = 5e-4;

/// Photos of each cell: a photo belongs to the cell nearest to its camera, so a robot has the cameras of the area that
/// it fetched and no photo twice.
pub fn photo_poses(split: &CellSplit, views: &[&View]) -> Vec<BuiltPhotoPoses> {
    let mut of_cells = vec![BuiltPhotoPoses::default(); split.cells.len()];
    for view in views {
        if let Some(cell) = split.nearest(view.position_in_world()) {
            of_cells[cell].push(split.cells[cell].mean_bounds.min, view);
        }
    }
    of_cells
}

/// Landmarks of each cell: each belongs to the nearest cell.
pub fn landmarks(split: &CellSplit, code_version: u32, all: &[Landmark]) -> Vec<BuiltLandmarks> {
    let mut of_cells = vec![Vec::new(); split.cells.len()];
    for landmark in all {
        if let Some(cell) = split.nearest(landmark.position_in_world) {
            of_cells[cell].push(*landmark);
        }
    }
    of_cells.iter().map(|landmarks| BuiltLandmarks::pack(code_version, landmarks)).collect()
}

struct QuantisedPositions {
    /// Largest rounding of a stored position, per axis: half a step, or that of readers' doubles if coarser.
    error: f64,
    columns: Columns,
}

enum Columns {
    Packed(Vec<u32>),
    Wide(Vec<[u16; 3]>),
    Full(Vec<[u32; 3]>),
}

impl QuantisedPositions {
    /// Rounds the means of a cell's Gaussians, in the order of `locals`.
    fn new(scene: &Gaussians, cell: &Cell, locals: &[u32]) -> Self {
        let (step, bits) = (cell.grid.step, cell.grid.bits);
        let largest: [f64; 3] = std::array::from_fn(|axis| ((1u64 << bits[axis]) - 1) as f64);
        let origin = cell.mean_bounds.min;
        let mut error = step.into_iter().fold(0.0, f64::max) / 2.0;
        let steps = locals.iter().map(|local| {
            let mean = scene.means_in_world[cell.gaussians[*local as usize] as usize];
            let offset: DVec3 = mean - origin;
            let steps: [u32; 3] = std::array::from_fn(|axis| match step[axis] > 0.0 {
                true => (offset[axis] / step[axis]).round().clamp(0.0, largest[axis]) as u32,
                false => 0,
            });
            let stored = origin + DVec3::from(steps.map(f64::from)) * DVec3::from(step);
            error = (stored - mean).abs().max_element().max(error);
            steps
        });
        let columns = match PositionForm::of(bits) {
            PositionForm::Wide => Columns::Wide(steps.map(|at| at.map(|v| v as u16)).collect()),
            PositionForm::Full => Columns::Full(steps.collect()),
            PositionForm::Packed => {
                let pack = |[x, y, z]: [u32; 3]| {
                    let (y, z) = (u64::from(y) << bits[0], u64::from(z) << (bits[0] + bits[1]));
                    (u64::from(x) | y | z) as u32
                };
                Columns::Packed(steps.map(pack).collect())
            }
        };
        Self { error, columns }
    }

    fn view(&self) -> Positions<'_> {
        match &self.columns {
            Columns::Packed(words) => Positions::Packed(words),
            Columns::Wide(steps) => Positions::Wide(steps),
            Columns::Full(steps) => Positions::Full(steps),
        }
    }
}
