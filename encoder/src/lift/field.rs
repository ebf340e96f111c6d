//! The factorised field of a cell: sparse sums over the scene's region vectors, and the embeddings
//! and scores that follow from it.

use rayon::prelude::*;
use slag_common::container::{self, AlignedBytes, ContainerError, Layout};

use super::buckets::SumEntry;
use super::sums::ViewSums;

/// Below this length of the mean vector the masks that saw a Gaussian cancel: what is left of
/// them is rounding noise of f32 sums and of the models, so it is flagged as no evidence.
pub const MIN_MEAN_LENGTH: f32 = 1e-3;

const REGIONS_MAGIC: [u8; 8] = *b"SLAGREGN";
const FIELD_MAGIC: [u8; 8] = *b"SLAGFELD";
const VERSION: u32 = 1;

/// `V_r` and `n_r` of every region of the scene.
#[derive(Clone, Debug, PartialEq)]
pub struct RegionTable {
    /// Components of a vector.
    pub dim: usize,
    /// `[n][dim]`: the sum of the vectors of the masks that cover the region.
    pub vectors: Vec<f32>,
    /// `[n]`: how many masks cover it.
    pub n_masks: Vec<f32>,
}

/// A field or region table that cannot be used.
pub type FieldError = ContainerError;

impl RegionTable {
    /// A table without regions.
    pub fn new(dim: usize) -> Self {
        Self { dim, vectors: Vec::new(), n_masks: Vec::new() }
    }

    /// Returns the number of regions.
    pub fn len(&self) -> usize {
        self.n_masks.len()
    }

    /// Returns whether there are none.
    pub fn is_empty(&self) -> bool {
        self.n_masks.is_empty()
    }

    /// Appends a view's regions and returns the number of the first.
    pub fn append(&mut self, view: &ViewSums) -> u32 {
        let first = self.len() as u32;
        for masks in &view.masks_of_region {
            let at = self.vectors.len();
            self.vectors.resize(at + self.dim, 0.0);
            for mask in masks {
                let vector = &view.mask_vectors[*mask as usize * self.dim..][..self.dim];
                add_scaled(&mut self.vectors[at..], 1.0, vector);
            }
            self.n_masks.push(masks.len() as f32);
        }
        first
    }

    /// Returns `q · V_r` for every region.
    pub fn scores(&self, query: &[f32]) -> Vec<f32> {
        self.vectors.par_chunks_exact(self.dim).map(|vector| dot(vector, query)).collect()
    }

    /// Returns the file form.
    pub fn to_bytes(&self) -> Vec<u8> {
        let header = [self.dim as u64, self.len() as u64];
        let sections = [
            (1, container::bytes_of(&header)),
            (2, container::bytes_of(&self.vectors)),
            (3, container::bytes_of(&self.n_masks)),
        ];
        let mut out = Vec::new();
        container::write(&mut out, REGIONS_MAGIC, VERSION, &sections).expect("writing to memory cannot fail");
        out
    }

    /// Reads the file form.
    ///
    /// # Errors
    /// [`FieldError`], naming the byte.
    pub fn from_bytes(bytes: &AlignedBytes) -> Result<Self, FieldError> {
        let layout = Layout::check(bytes, REGIONS_MAGIC, VERSION)?;
        let [dim, n]: [u64; 2] = layout.value(bytes, 1, "header")?;
        let vectors = layout.column::<f32>(2, "vectors", (n as usize).saturating_mul(dim as usize))?;
        let n_masks = layout.column::<f32>(3, "mask counts", n as usize)?;
        Ok(Self {
            dim: dim as usize,
            vectors: bytemuck::pod_collect_to_vec(&bytes[vectors]),
            n_masks: bytemuck::pod_collect_to_vec(&bytes[n_masks]),
        })
    }
}

/// The sparse sums of one cell's Gaussians, row by row.
#[derive(Clone, Debug, PartialEq)]
pub struct CellField {
    /// `[N]`: index of each Gaussian in the input file.
    pub input_indices: Vec<u32>,
    /// `[N + 1]`: where each Gaussian's entries start.
    pub starts: Vec<u64>,
    /// Region of each entry.
    pub regions: Vec<u32>,
    /// Sum of each entry.
    pub weights: Vec<f32>,
    /// `[N]`: `Σ_r a(k, r) n_r`, the evidence for the embedding.
    pub total_weights: Vec<f32>,
    /// `[N]`: length of the mean vector, 0 where there is no evidence.
    pub mean_lengths: Vec<f32>,
}

impl CellField {
    /// Sorts a cell's entries by Gaussian, keeping their order (views by name, then regions) within
    /// it, and finds every Gaussian's total weight and mean length.
    pub fn new(input_indices: Vec<u32>, entries: &[SumEntry], table: &RegionTable) -> Self {
        let n = input_indices.len();
        let mut starts = vec![0u64; n + 1];
        entries.iter().for_each(|e| starts[e.local as usize + 1] += 1);
        (0..n).for_each(|i| starts[i + 1] += starts[i]);
        let mut next = starts.clone();
        let mut regions = vec![0; entries.len()];
        let mut weights = vec![0.0; entries.len()];
        for entry in entries {
            let at = &mut next[entry.local as usize];
            regions[*at as usize] = entry.region;
            weights[*at as usize] = entry.weight;
            *at += 1;
        }
        let mut field = Self {
            input_indices,
            starts,
            regions,
            weights,
            total_weights: Vec::new(),
            mean_lengths: Vec::new(),
        };
        (field.total_weights, field.mean_lengths) = (0..n)
            .into_par_iter()
            .map_init(|| vec![0.0; table.dim], |mean, k| field.mean(k, table, mean))
            .unzip();
        field
    }

    /// Returns the number of Gaussians.
    pub fn len(&self) -> usize {
        self.input_indices.len()
    }

    /// Returns whether the cell holds none.
    pub fn is_empty(&self) -> bool {
        self.input_indices.is_empty()
    }

    fn entries(&self, k: usize) -> impl Iterator<Item = (usize, f32)> + '_ {
        let range = self.starts[k] as usize..self.starts[k + 1] as usize;
        self.regions[range.clone()].iter().map(|r| *r as usize).zip(self.weights[range].iter().copied())
    }

    /// Writes the mean vector and returns (total weight, its length or 0 without evidence).
    fn mean(&self, k: usize, table: &RegionTable, mean: &mut [f32]) -> (f32, f32) {
        mean.fill(0.0);
        let mut total_weight = 0.0f64;
        for (region, weight) in self.entries(k) {
            total_weight += f64::from(weight) * f64::from(table.n_masks[region]);
            add_scaled(mean, weight, &table.vectors[region * table.dim..][..table.dim]);
        }
        if total_weight <= 0.0 {
            return (0.0, 0.0);
        }
        let scale = (1.0 / total_weight) as f32;
        mean.iter_mut().for_each(|c| *c *= scale);
        let length = dot(mean, mean).sqrt();
        // A length that is NaN or infinite is no evidence either.
        (total_weight as f32, if (MIN_MEAN_LENGTH..f32::INFINITY).contains(&length) { length } else { 0.0 })
    }

    /// Returns whether a Gaussian has an embedding.
    pub fn has_evidence(&self, k: usize) -> bool {
        self.mean_lengths[k] > 0.0
    }

    /// Writes the unit embedding of a Gaussian, or zeros where it has no evidence.
    pub fn embedding(&self, k: usize, table: &RegionTable, out: &mut [f32]) {
        let (_, length) = self.mean(k, table, out);
        if length > 0.0 {
            out.iter_mut().for_each(|c| *c *= 1.0 / length);
        } else {
            out.fill(0.0);
        }
    }

    /// Returns the cosine of every Gaussian's embedding with a unit query, from the query's score
    /// with each region ([`RegionTable::scores`]); NaN where there is no evidence.
    pub fn cosines(&self, region_scores: &[f32]) -> Vec<f32> {
        let cosine = |k: usize| {
            if !self.has_evidence(k) {
                return f32::NAN;
            }
            let sum: f64 = self.entries(k).map(|(r, w)| f64::from(w) * f64::from(region_scores[r])).sum();
            (sum / (f64::from(self.total_weights[k]) * f64::from(self.mean_lengths[k]))) as f32
        };
        (0..self.len()).into_par_iter().map(cosine).collect()
    }

    /// Returns the file form.
    pub fn to_bytes(&self) -> Vec<u8> {
        let header = [self.len() as u64, self.regions.len() as u64];
        let sections = [
            (1, container::bytes_of(&header)),
            (2, container::bytes_of(&self.input_indices)),
            (3, container::bytes_of(&self.starts)),
            (4, container::bytes_of(&self.regions)),
            (5, container::bytes_of(&self.weights)),
            (6, container::bytes_of(&self.total_weights)),
            (7, container::bytes_of(&self.mean_lengths)),
        ];
        let mut out = Vec::new();
        container::write(&mut out, FIELD_MAGIC, VERSION, &sections).expect("writing to memory cannot fail");
        out
    }

    /// Reads the file form, whose regions are below `n_regions`.
    ///
    /// # Errors
    /// [`FieldError`], naming the byte.
    pub fn from_bytes(bytes: &AlignedBytes, n_regions: usize) -> Result<Self, FieldError> {
        let layout = Layout::check(bytes, FIELD_MAGIC, VERSION)?;
        let [n, n_entries]: [u64; 2] = layout.value(bytes, 1, "header")?;
        let (n, n_entries) = (n as usize, n_entries as usize);
        let field = Self {
            input_indices: bytemuck::pod_collect_to_vec(&bytes[layout.column::<u32>(2, "input indices", n)?]),
            starts: bytemuck::pod_collect_to_vec(
                &bytes[layout.column::<u64>(3, "starts", n.saturating_add(1))?],
            ),
            regions: bytemuck::pod_collect_to_vec(&bytes[layout.column::<u32>(4, "regions", n_entries)?]),
            weights: bytemuck::pod_collect_to_vec(&bytes[layout.column::<f32>(5, "weights", n_entries)?]),
            total_weights: bytemuck::pod_collect_to_vec(&bytes[layout.column::<f32>(6, "total weights", n)?]),
            mean_lengths: bytemuck::pod_collect_to_vec(&bytes[layout.column::<f32>(7, "mean lengths", n)?]),
        };
        let consistent = field.starts.windows(2).all(|w| w[0] <= w[1])
            && field.starts[0] == 0
            && field.starts[n] as usize == n_entries
            && field.regions.iter().all(|r| (*r as usize) < n_regions);
        if consistent {
            return Ok(field);
        }
        let what = "starts or regions refer to what is not there".into();
        Err(ContainerError::Damaged { offset_bytes: 0, what })
    }
}

/// Adds `factor * vector`, component by component: the compiler makes SIMD of it, the order of the
/// sums stays that of the calls.
fn add_scaled(sum: &mut [f32], factor: f32, vector: &[f32]) {
    sum.iter_mut().zip(vector).for_each(|(s, v)| *s += factor * v);
}

/// Returns the scalar product, summed in 16 fixed lanes.
pub fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0f32; 16];
    let (a_blocks, a_rest) = a.as_chunks::<16>();
    let (b_blocks, b_rest) = b.as_chunks::<16>();
    for (x, y) in a_blocks.iter().zip(b_blocks) {
        for lane in 0..16 {
            lanes[lane] += x[lane] * y[lane];
        }
    }
    let rest: f32 = a_rest.iter().zip(b_rest).map(|(x, y)| x * y).sum();
    lanes.iter().sum::<f32>() + rest
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::lift::ViewSums;

    /// The paper's equation in float64, mask by mask: no regions, no sparse rows.
    fn oracle(k: u32, views: &[ViewSums], dim: usize) -> (f64, Option<Vec<f64>>) {
        let mut sum = vec![0.0f64; dim];
        let mut total = 0.0f64;
        for view in views {
            for entry in view.entries_of_cell.iter().flat_map(|(_, entries)| entries).filter(|e| e.local == k)
            {
                for mask in &view.masks_of_region[entry.region as usize] {
                    let w = f64::from(entry.weight);
                    total += w;
                    (0..dim)
                        .for_each(|c| sum[c] += w * f64::from(view.mask_vectors[*mask as usize * dim + c]));
                }
            }
        }
        let length = sum.iter().map(|c| c * c).sum::<f64>().sqrt();
        let is_clear = total > 0.0 && length / total > 2e-3;
        (total, is_clear.then(|| sum.iter().map(|c| c / length).collect()))
    }

    prop_compose! {
        fn any_view(dim: usize, n_gaussians: u32)(
            n_masks in 1usize..5,
            seeds in prop::collection::vec(-1.0f32..1.0, 5 * dim),
            regions in prop::collection::vec(prop::collection::btree_set(0u32..5, 1..4), 1..6),
            raw in prop::collection::btree_map((0..n_gaussians, 0u32..6), 1e-3f32..100.0, 0..40),
        ) -> ViewSums {
            let masks_of_region: Vec<Vec<u32>> = regions.iter().map(|set| {
                let mut masks: Vec<u32> = set.iter().map(|m| m % n_masks as u32).collect();
                masks.dedup();
                masks.sort_unstable();
                masks.dedup();
                masks
            }).collect();
            let mut mask_vectors = seeds[..n_masks * dim].to_vec();
            for vector in mask_vectors.chunks_mut(dim) {
                vector[0] += 0.01;
                let length = dot(vector, vector).sqrt();
                vector.iter_mut().for_each(|c| *c /= length);
            }
            let entries: Vec<SumEntry> = raw.into_iter()
                .map(|((local, region), weight)| SumEntry { local, region: region % masks_of_region.len() as u32, weight })
                .collect();
            ViewSums { dim, mask_vectors, masks_of_region, entries_of_cell: vec![(0, entries)] }
        }
    }

    proptest! {
        #[test]
        fn embeddings_and_cosines_equal_the_papers_equation(
            views in prop::collection::vec(any_view(7, 9), 1..6),
            query in prop::collection::vec(-1.0f32..1.0, 7),
        ) {
            let mut table = RegionTable::new(7);
            let mut entries = Vec::new();
            for view in &views {
                let first = table.append(view);
                entries.extend(view.entries_of_cell[0].1.iter().map(|e| SumEntry { region: e.region + first, ..*e }));
            }
            let field = CellField::new((0..9).collect(), &entries, &table);
            let cosines = field.cosines(&table.scores(&query));
            let mut embedding = vec![0.0; 7];
            for k in 0..9u32 {
                let (total, expected) = oracle(k, &views, 7);
                prop_assert!((f64::from(field.total_weights[k as usize]) - total).abs() <= 1e-6 * total);
                let Some(expected) = expected else { continue };
                field.embedding(k as usize, &table, &mut embedding);
                let cosine: f64 = expected.iter().zip(&query).map(|(e, q)| e * f64::from(*q)).sum();
                prop_assert!(embedding.iter().zip(&expected).all(|(a, b)| (f64::from(*a) - b).abs() < 1e-3));
                prop_assert!((f64::from(cosines[k as usize]) - cosine).abs() < 2e-3);
            }
            let bytes = AlignedBytes::copy_of(&field.to_bytes());
            prop_assert_eq!(CellField::from_bytes(&bytes, table.len()).expect("valid"), field);
            let bytes = AlignedBytes::copy_of(&table.to_bytes());
            prop_assert_eq!(RegionTable::from_bytes(&bytes).expect("valid"), table);
        }
    }

    #[test]
    fn masks_that_cancel_are_no_evidence() {
        let view = ViewSums {
            dim: 2,
            mask_vectors: vec![1.0, 0.0, -1.0, 0.0],
            masks_of_region: vec![vec![0], vec![1]],
            entries_of_cell: Vec::new(),
        };
        let mut table = RegionTable::new(2);
        table.append(&view);
        let entry = |local, region| SumEntry { local, region, weight: 3.0 };
        let field = CellField::new(vec![0, 1, 2], &[entry(0, 0), entry(0, 1), entry(1, 1)], &table);
        assert_eq!((0..3).map(|k| field.has_evidence(k)).collect::<Vec<_>>(), [false, true, false]);
        assert!(field.cosines(&table.scores(&[1.0, 0.0]))[0].is_nan());
        assert_eq!(field.total_weights, [6.0, 3.0, 0.0]);
    }
}
