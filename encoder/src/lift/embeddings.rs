//! The embeddings of many Gaussians at once, from their contributions.
//!
//! A component is a sum over hundreds of region vectors, far more than fit a cache. So neighbouring Gaussians, which
//! share most of their regions, are processed together, a block of components at a time. Components are summed in the
//! order of the entries, and products are rounded before they are added: the bits are the same on any machine.

use std::ops::Range;

use pulp::Simd;
use rayon::prelude::*;

use super::index::PartContributions;
use super::table::RegionTable;
use slag_math::dot;
use slag_math::simd::{InstructionSet, Work};

/// Shortest mean vector with evidence. Below it, masks cancel: the rest is rounding noise of f32 contributions and of
/// the models.
pub(super) const MIN_MEAN_LENGTH: f32 = 1e-3;
/// Gaussians processed together: their embeddings stay in a core's cache until scaled.
const CHUNK: usize = 512;
const BLOCK: usize = 128;
/// Registers for sums: enough to hide the latency of an addition. A block fills them at any width.
const REGISTERS: usize = 8;
const UNSEEN: u32 = u32::MAX;

struct Scratch {
    /// `[n_regions]`: index of each region in the chunk, or [`UNSEEN`].
    place_of_region: Vec<u32>,
    regions: Vec<u32>,
    /// By entry: index of its region in the chunk.
    places: Vec<u32>,
    /// A block of components of the chunk's region vectors.
    vectors: Vec<[f32; BLOCK]>,
}

/// Writes the unit embeddings of a part's Gaussians to `out` (`[N][dim]`) and returns the lengths of their mean
/// vectors; both are 0 without evidence.
pub(super) fn write_embeddings(
    contributions: &PartContributions,
    table: &RegionTable,
    out: &mut [f32],
) -> Vec<f32> {
    write_embeddings_on(InstructionSet::widest(), contributions, table, out)
}

fn write_embeddings_on(
    instructions: InstructionSet,
    contributions: &PartContributions,
    table: &RegionTable,
    out: &mut [f32],
) -> Vec<f32> {
    let dim = table.dim();
    let mut lengths = vec![0.0; contributions.total_weights.len()];
    out.par_chunks_mut(CHUNK * dim).zip(lengths.par_chunks_mut(CHUNK)).enumerate().for_each_init(
        || Scratch {
            place_of_region: vec![UNSEEN; table.len()],
            regions: Vec::new(),
            places: Vec::new(),
            vectors: Vec::new(),
        },
        |scratch, (chunk, (out, lengths))| {
            let first = chunk * CHUNK;
            scratch.number_regions(contributions, first..first + lengths.len());
            lengths.copy_from_slice(&instructions.dispatch(Chunk {
                contributions,
                table,
                first,
                scratch,
                out,
            }));
            scratch.forget_regions();
        },
    );
    lengths
}

/// Scales a sum of region vectors to unit length and returns the mean vector's length; zeros and 0 without evidence.
#[inline(always)]
pub(super) fn make_unit(sum: &mut [f32], total_weight: f32) -> f32 {
    let scale = if total_weight > 0.0 { total_weight.recip() } else { 0.0 };
    sum.iter_mut().for_each(|c| *c *= scale);
    let length = dot(sum, sum).sqrt();
    if !(MIN_MEAN_LENGTH..=f32::MAX).contains(&length) {
        sum.fill(0.0);
        return 0.0;
    }
    let scale = length.recip();
    sum.iter_mut().for_each(|c| *c *= scale);
    length
}

impl Scratch {
    fn number_regions(&mut self, contributions: &PartContributions, gaussians: Range<usize>) {
        let entries =
            contributions.starts[gaussians.start] as usize..contributions.starts[gaussians.end] as usize;
        self.places.clear();
        for region in &contributions.regions[entries] {
            let place = &mut self.place_of_region[*region as usize];
            if *place == UNSEEN {
                *place = self.regions.len() as u32;
                self.regions.push(*region);
            }
            self.places.push(*place);
        }
    }

    fn forget_regions(&mut self) {
        self.regions.drain(..).for_each(|region| self.place_of_region[region as usize] = UNSEEN);
    }
}

struct Chunk<'a> {
    contributions: &'a PartContributions,
    table: &'a RegionTable,
    first: usize,
    scratch: &'a mut Scratch,
    /// `[n][dim]`.
    out: &'a mut [f32],
}

impl<S: Simd> Work<S> for Chunk<'_> {
    type Output = Vec<f32>;

    #[inline(always)]
    fn run(self, simd: S) -> Vec<f32> {
        let Self { contributions, table, first, scratch, out } = self;
        let Scratch { regions, places, vectors, .. } = scratch;
        let dim = table.dim();
        let first_entry = contributions.starts[first] as usize;
        for from in (0..dim).step_by(BLOCK) {
            let width = BLOCK.min(dim - from);
            vectors.resize(vectors.len().max(regions.len()), [0.0; BLOCK]);
            for (vector, region) in vectors.iter_mut().zip(&*regions) {
                table.components(*region as usize, from, &mut vector[..width]);
            }
            for (embedding, at) in out.chunks_exact_mut(dim).zip(contributions.starts[first..].windows(2)) {
                let entries = at[0] as usize..at[1] as usize;
                let places = &places[entries.start - first_entry..entries.end - first_entry];
                let mut sum = [0.0; BLOCK];
                add_vectors(simd, vectors, places, &contributions.weights[entries], &mut sum);
                embedding[from..from + width].copy_from_slice(&sum[..width]);
            }
        }
        let make_unit = |(sum, total): (&mut [f32], &f32)| make_unit(sum, *total);
        out.chunks_exact_mut(dim).zip(&contributions.total_weights[first..]).map(make_unit).collect()
    }
}

/// Writes the sum of `weight * vector` over some entries; sums stay in registers until all entries are added.
#[inline(always)]
fn add_vectors<S: Simd>(
    simd: S,
    vectors: &[[f32; BLOCK]],
    places: &[u32],
    weights: &[f32],
    out: &mut [f32; BLOCK],
) {
    for (step, out) in S::as_mut_simd_f32s(out).0.chunks_exact_mut(REGISTERS).enumerate() {
        let mut sum = [simd.splat_f32s(0.0); REGISTERS];
        for (place, weight) in places.iter().zip(weights) {
            let weight = simd.splat_f32s(*weight);
            let vector = S::as_simd_f32s(&vectors[*place as usize]).0;
            let vector = &vector[step * REGISTERS..][..REGISTERS];
            for i in 0..REGISTERS {
                // Not fused: machines without fused multiply-add would differ.
                sum[i] = simd.add_f32s(sum[i], simd.mul_f32s(weight, vector[i]));
            }
        }
        out.copy_from_slice(&sum);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lift::tests::{Scene, scene_of};

    /// Every instruction set of the machine gives the bits of scalar code.
    #[test]
    fn every_width_of_vectors_gives_the_same_bits() {
        for dim in [1, 7, 64, 130, 512] {
            let scene = scene_of(dim, 600, 11);
            let Scene { index, table, .. } = &scene;
            let raw = index.read(0..index.parts.len()).expect("reads");
            for contributions in index.transpose(&raw, table).expect("transposes") {
                let results: Vec<(Vec<f32>, Vec<f32>)> = InstructionSet::available()
                    .iter()
                    .map(|set| {
                        let mut out = vec![f32::NAN; contributions.total_weights.len() * dim];
                        (write_embeddings_on(*set, &contributions, table, &mut out), out)
                    })
                    .collect();
                assert!(results.iter().all(|r| *r == results[0]), "dim {dim}");
            }
        }
    }
}
