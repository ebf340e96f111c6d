//! Stage 6: a cell's field becomes its shards.

pub mod cells;

use half::f16;
use rayon::prelude::*;
use slag_common::Gaussians;
use slag_common::hash::Hash32;
use slag_common::shard::{Profile, ShardHeader, ShardParts};

use crate::palette::{self, EmbeddingSource, PaletteSettings};
use cells::Cell;

/// A cell's shards as bytes, with what the manifest says of them.
pub struct BuiltCell {
    /// The bytes of each profile.
    pub shards: Vec<(Profile, Vec<u8>)>,
    /// Palette rows.
    pub n_rows: u32,
    /// Largest row radius.
    pub score_error_bound: f32,
    /// Largest error of a position, world units.
    pub position_error: f64,
    /// Gaussians without an embedding.
    pub n_without_evidence: usize,
}

/// The embeddings of a cell's Gaussians.
pub struct CellEmbeddings {
    /// Components of an embedding.
    pub dim: usize,
    /// `[N][dim]`: unit, or zeros where there is no evidence.
    pub vectors: Vec<f32>,
    /// `[N]`: whether there is.
    pub has_evidence: Vec<bool>,
}

impl CellEmbeddings {
    fn get(&self, local: u32) -> &[f32] {
        &self.vectors[local as usize * self.dim..][..self.dim]
    }
}

/// Returns the bytes that a cell of `n_gaussians` takes while its shards are built: embeddings in f32,
/// in f16 and in the shard, their projection for the palette, and the palette's lists.
pub fn working_bytes(n_gaussians: usize, dim: usize) -> u64 {
    let per_component = size_of::<f32>() + 2 * size_of::<f16>();
    (n_gaussians * (dim * per_component + palette::WORKING_BYTES_PER_EMBEDDING)) as u64
}

struct WithEvidence<'a> {
    embeddings: &'a CellEmbeddings,
    /// Locals of the Gaussians that have an embedding.
    locals: &'a [u32],
}

impl EmbeddingSource for WithEvidence<'_> {
    fn len(&self) -> usize {
        self.locals.len()
    }
    fn dim(&self) -> usize {
        self.embeddings.dim
    }
    fn embedding(&self, index: usize, out: &mut [f32]) {
        out.copy_from_slice(self.embeddings.get(self.locals[index]));
    }
}

/// Builds a cell's shards.
pub fn build(
    scene: &Gaussians,
    cell_id: u32,
    cell: &Cell,
    embeddings: &CellEmbeddings,
    encoder_id: Hash32,
    settings: &PaletteSettings,
) -> BuiltCell {
    let (mut locals, without): (Vec<u32>, Vec<u32>) =
        (0..cell.gaussians.len() as u32).partition(|local| embeddings.has_evidence[*local as usize]);
    let palette = palette::build(&WithEvidence { embeddings, locals: &locals }, settings);
    let n_rows = palette.radii.len();

    // Shard order: by row, then along the Morton curve, which is the order of locals.
    let mut row_starts = vec![0u32; n_rows + 1];
    palette.codes.iter().for_each(|row| row_starts[*row as usize + 1] += 1);
    (0..n_rows).for_each(|row| row_starts[row + 1] += row_starts[row]);
    let mut keyed: Vec<(u32, u32)> = palette.codes.iter().copied().zip(locals.iter().copied()).collect();
    keyed.sort_unstable();
    locals = keyed.into_iter().map(|(_, local)| local).chain(without.iter().copied()).collect();

    let origin = cell.mean_bounds.min;
    let position_step = (cell.mean_bounds.size() / f64::from(u16::MAX)).to_array();
    let positions: Vec<[u16; 3]> = locals
        .iter()
        .map(|local| {
            let offset = scene.means_in_world[cell.gaussians[*local as usize] as usize] - origin;
            // A flat axis has step 0 and every offset 0.
            std::array::from_fn(|a| {
                if position_step[a] > 0.0 { (offset[a] / position_step[a]).round() as u16 } else { 0 }
            })
        })
        .collect();
    let header = ShardHeader {
        cell_id,
        n_gaussians: locals.len() as u32,
        n_rows: n_rows as u32,
        dim: embeddings.dim as u32,
        origin_in_world: origin.to_array(),
        position_step,
        box_min: cell.bounds.min.to_array(),
        box_max: cell.bounds.max.to_array(),
        encoder_id: encoder_id.0,
    };
    let input_indices: Vec<u32> = locals.iter().map(|local| cell.gaussians[*local as usize]).collect();
    let n_with = locals.len() - without.len();
    let dim = embeddings.dim;
    let mut exact = vec![f16::ZERO; n_with * dim];
    exact.par_chunks_exact_mut(dim).zip(&locals[..n_with]).for_each(|(out, local)| {
        out.iter_mut().zip(embeddings.get(*local)).for_each(|(o, v)| *o = f16::from_f32(*v));
    });
    let shards = Profile::ALL
        .into_iter()
        .map(|profile| {
            let parts = ShardParts {
                header,
                positions: &positions,
                row_starts: &row_starts,
                palette: &palette.rows,
                radii: &palette.radii,
                exact: (profile == Profile::Exact).then_some((&input_indices, &exact)),
            };
            let mut bytes = Vec::new();
            parts.write(&mut bytes).expect("writing to memory cannot fail");
            (profile, bytes)
        })
        .collect();
    BuiltCell {
        shards,
        n_rows: n_rows as u32,
        score_error_bound: palette.radii.iter().copied().fold(0.0, f32::max),
        position_error: position_step.into_iter().fold(0.0, f64::max) / 2.0,
        n_without_evidence: without.len(),
    }
}
