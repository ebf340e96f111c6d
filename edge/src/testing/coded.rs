//! Random shards with bases and residual codes, whose radii and reaches are measured in float64.

use glam::DVec3;
use half::f16;
use slag_common::frames::Aabb;
use slag_common::shard::{
    BLOCK, Basis, CODEWORDS, ExactColumns, Fine, Positions, Residuals, ScoreErrors, ShardHeader, ShardView,
    quantise, sample,
};

use super::{BuiltShard, normalised};
use slag_math::random::Random;

#[derive(Clone, Debug)]
pub struct CodedShard {
    pub cell_id: u32,
    pub dim: usize,
    pub n_components: usize,
    pub has_basis: bool,
    /// 0: no residual code.
    pub n_subspaces: usize,
    /// Whether exact embeddings and fine residuals accompany the code. The latter are arbitrary: errors of both are
    /// stated, not measured ([`CODE_ERROR`], [`FINE_ERROR`]).
    pub is_exact: bool,
    pub centroid_lens: Vec<usize>,
    pub origin: DVec3,
}

/// Stated mean error of an exact shard's codes.
pub const CODE_ERROR: f32 = 0.0033;
pub const FINE_ERROR: f32 = 0.001;

struct Columns {
    header: ShardHeader,
    positions: Vec<[u16; 3]>,
    centroid_starts: Vec<u32>,
    centroids: Vec<i8>,
    mean: Vec<f16>,
    vectors: Vec<i8>,
    steps: Vec<f32>,
    subspace_starts: Vec<u32>,
    codewords: Vec<f16>,
    residual_scales: Vec<f32>,
    codes: Vec<u8>,
    radii: Vec<f32>,
    reaches: Vec<f32>,
}

impl CodedShard {
    /// Writes the shard and reads it back. Embeddings are the decoded ones, slightly perturbed, of unit length.
    pub fn build(&self, random: &mut Random) -> BuiltShard {
        let mut columns = self.columns(random);
        let (k, m, n) = (columns.residual_scales.len(), self.n_components, columns.positions.len());
        let fine_steps: Vec<f32> = (0..m).map(|_| 1.0 + 0.5 * random.signed()).collect();
        let fine_scales: Vec<f32> = (0..k).map(|_| 2e-4 * (1.5 + random.signed())).collect();
        let fine_values: Vec<i8> = (0..n * m).map(|_| random.bits() as i8).collect();
        let fine_errors = ScoreErrors { mean: FINE_ERROR, ..ScoreErrors::default() };
        let input_indices: Vec<u32> = (0..n as u32).collect();
        let embeddings = self.measure(&mut columns, random);
        let halves: Vec<f16> = embeddings.iter().flatten().map(|v| f16::from_f32(*v)).collect();
        let fine =
            Fine { errors: fine_errors, steps: &fine_steps, scales: &fine_scales, values: &fine_values };
        let exact = ExactColumns { input_indices: &input_indices, embeddings: &halves, fine: Some(fine) };
        let exact = self.is_exact.then_some(exact);
        let mut bytes = Vec::new();
        ShardView { exact, ..self.view(&columns) }.write(&mut bytes).expect("writes to memory");
        BuiltShard::read(&bytes, embeddings)
    }

    fn columns(&self, random: &mut Random) -> Columns {
        let (dim, m) = (self.dim, self.n_components);
        let (k, n) = (self.centroid_lens.len(), self.centroid_lens.iter().sum::<usize>());
        let mut centroid_starts = vec![0u32];
        self.centroid_lens
            .iter()
            .for_each(|len| centroid_starts.push(centroid_starts[centroid_starts.len() - 1] + *len as u32));
        let mut floats =
            |n: usize, scale: f32| -> Vec<f32> { (0..n).map(|_| random.signed() * scale).collect() };
        let (centroids, centroid_step) = quantise(&floats(k * m, 1.5 / (m as f32).sqrt()));
        let (vectors, basis_step) = quantise(&floats(m * dim, 1.2 / (dim as f32).sqrt()));
        let halves = |values: Vec<f32>| values.into_iter().map(f16::from_f32).collect();
        // The last component has no codeword if possible.
        let n_coded = if m > self.n_subspaces { m - 1 } else { m };
        let n_codewords = CODEWORDS * if self.n_subspaces == 0 { 0 } else { n_coded };
        let bounds = Aabb { min: self.origin, max: self.origin + 10.0 };
        Columns {
            header: ShardHeader {
                n_components: m as u32,
                n_subspaces: self.n_subspaces as u32,
                centroid_step,
                errors: ScoreErrors { mean: CODE_ERROR, ..ScoreErrors::default() },
                ..sample::header(self.cell_id, n, k, dim, bounds)
            },
            centroid_starts,
            centroids,
            vectors,
            steps: floats(m, 0.5).iter().map(|v| basis_step * (1.0 + v)).collect(),
            mean: halves(floats(dim, 0.5 / (dim as f32).sqrt())),
            subspace_starts: (0..=self.n_subspaces)
                .map(|g| (n_coded * g / self.n_subspaces.max(1)) as u32)
                .collect(),
            codewords: halves(floats(n_codewords, 0.5 / (m as f32).sqrt())),
            residual_scales: floats(k, 1.0).into_iter().map(f32::abs).collect(),
            codes: (0..n.div_ceil(BLOCK) * BLOCK * self.n_subspaces / 2)
                .map(|_| random.bits() as u8)
                .collect(),
            positions: (0..n).map(|_| [(); 3].map(|()| random.bits() as u16)).collect(),
            radii: vec![0.0; k],
            reaches: vec![0.0; k],
        }
    }

    fn view<'a>(&self, columns: &'a Columns) -> ShardView<'a> {
        let Columns { mean, vectors, steps, .. } = columns;
        ShardView {
            header: columns.header,
            positions: Positions::Wide(&columns.positions),
            centroid_starts: &columns.centroid_starts,
            centroids: &columns.centroids,
            radii: &columns.radii,
            basis: self.has_basis.then_some(Basis { mean, vectors, steps }),
            residuals: (self.n_subspaces > 0).then_some(Residuals {
                subspace_starts: &columns.subspace_starts,
                codewords: &columns.codewords,
                residual_scales: &columns.residual_scales,
                residual_norms: &columns.reaches,
                codes: &columns.codes,
            }),
            exact: None,
            packed_indices: None,
        }
    }

    fn measure(&self, columns: &mut Columns, random: &mut Random) -> Vec<Vec<f32>> {
        let measured = self.view(columns);
        let (mut radii, mut reaches) = (columns.radii.clone(), columns.reaches.clone());
        let mut embeddings = Vec::new();
        for (centroid, (radius, reach)) in radii.iter_mut().zip(&mut reaches).enumerate() {
            for index in measured.members(centroid) {
                let mut decoded = vec![0.0; self.dim];
                measured.decode(index, &mut decoded);
                let mut stored = vec![0.0; self.dim];
                measured.decode_centroid(centroid, &mut stored);
                let embedding =
                    normalised(decoded.iter().map(|v| *v as f32 + random.signed() * 0.02).collect());
                let from = if self.is_exact { &stored } else { &decoded };
                let squares = embedding.iter().zip(from).map(|(e, d)| (f64::from(*e) - d).powi(2));
                *radius = f32::max(*radius, squares.sum::<f64>().sqrt() as f32 * (1.0 + f32::EPSILON));
                embeddings.push(embedding);
                let Some(residuals) = &measured.residuals else { continue };
                let codewords =
                    residuals.subspace_starts.windows(2).enumerate().flat_map(|(group, starts)| {
                        let (start, len) = (starts[0] as usize, (starts[1] - starts[0]) as usize);
                        &residuals.codewords[CODEWORDS * start + residuals.code(index, group) * len..][..len]
                    });
                let length = codewords.map(|w| w.to_f64().powi(2)).sum::<f64>().sqrt() as f32;
                let scale = residuals.residual_scales[centroid];
                *reach = f32::max(*reach, length * scale * (1.0 + 2.0 * f32::EPSILON));
            }
        }
        (columns.radii, columns.reaches) = (radii, reaches);
        embeddings
    }
}
