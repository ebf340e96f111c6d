//! A synthetic field of embeddings of any size with the structure of lifted ones: things of many kinds; several
//! views of a thing with different vectors, which its Gaussians weigh differently; and blends where two things
//! meet. The statistics were measured on the labelled house: views of a thing are 0.45 apart, a sixth of the
//! Gaussians lie at borders.

use glam::DVec3;
use slag_encoder::codebook::TextBank;
use slag_math::random::mix64;

const CELL: usize = 62_500;
const KINDS: usize = 400;
const THING: usize = 1_250;
const VIEWS: usize = 6;
const VIEW_NOISE: f32 = 0.45;
/// Length of the noise that a thing adds to its kind's vector.
const THING_NOISE: f32 = 0.25;
/// Length of the vector that all kinds have in common.
const COMMON: f32 = 0.4;
/// Share of the Gaussians at a border.
const BORDER: f32 = 0.16;
/// Dimensions that kinds and noise fill.
const FILLED: usize = 128;

pub struct Field {
    n_gaussians: usize,
    dim: usize,
    /// `[KINDS][dim]`.
    kinds: Vec<f32>,
}

/// A random sequence, separate for each purpose and index.
struct Noise(u64);

impl Noise {
    fn new(purpose: u64, index: usize) -> Self {
        Self(mix64(purpose << 48 | index as u64) & !0xffff_ffff)
    }

    fn uniform(&mut self) -> f32 {
        self.0 += 1;
        (mix64(self.0) >> 40) as f32 / (1u64 << 24) as f32
    }

    fn add_noise(&mut self, length: f32, out: &mut [f32]) {
        let n = out.len().min(FILLED);
        // A sum of four uniform numbers has variance 1/3.
        let scale = length / (n as f32 / 3.0).sqrt();
        for v in &mut out[..n] {
            *v += scale * ((0..4).map(|_| self.uniform()).sum::<f32>() - 2.0);
        }
    }
}

fn make_unit(vector: &mut [f32]) {
    let length = slag_math::dot(vector, vector).sqrt().max(f32::MIN_POSITIVE);
    vector.iter_mut().for_each(|v| *v /= length);
}

impl Field {
    /// Makes a field; `n_gaussians` is rounded down to whole cells (at least one).
    pub fn new(n_gaussians: usize, dim: usize) -> Self {
        let mut kinds = vec![0.0; KINDS * dim];
        let mut common = vec![0.0; dim];
        Noise::new(1, 0).add_noise(COMMON, &mut common);
        for (kind, vector) in kinds.chunks_exact_mut(dim).enumerate() {
            vector.copy_from_slice(&common);
            Noise::new(2, kind).add_noise(1.0, vector);
            make_unit(vector);
        }
        Self { n_gaussians, dim, kinds }
    }

    pub fn cell_gaussians(&self) -> usize {
        CELL.min(self.n_gaussians)
    }

    pub fn n_cells(&self) -> usize {
        self.n_gaussians / self.cell_gaussians()
    }

    /// Returns the embeddings of a cell, `[cell_gaussians][dim]`, as unit vectors.
    pub fn embeddings(&self, cell: usize) -> Vec<f32> {
        let n = self.cell_gaussians();
        let n_things = n.div_ceil(THING);
        let dim = self.dim;
        let mut views = vec![0.0; n_things * VIEWS * dim];
        for (thing, views) in views.chunks_exact_mut(VIEWS * dim).enumerate() {
            let mut random = Noise::new(3, cell * n_things + thing);
            // The square of a uniform number makes a few kinds frequent and most rare.
            let kind = (random.uniform().powi(2) * KINDS as f32) as usize;
            let mut own = self.kinds[kind.min(KINDS - 1) * dim..][..dim].to_vec();
            random.add_noise(THING_NOISE, &mut own);
            for view in views.chunks_exact_mut(dim) {
                view.copy_from_slice(&own);
                random.add_noise(VIEW_NOISE, view);
                make_unit(view);
            }
        }
        let mut out = vec![0.0; n * dim];
        for (k, out) in out.chunks_exact_mut(dim).enumerate() {
            let mut random = Noise::new(4, cell * n + k);
            let thing = k / THING;
            let is_border = random.uniform() < BORDER;
            let foreign = if is_border { 0.6 * random.uniform() } else { 0.0 };
            for (of, share) in [(thing, 1.0 - foreign), ((thing + 1) % n_things, foreign)] {
                for view in 0..VIEWS {
                    // Most Gaussians are clearly visible in some views and hardly in others.
                    let weight = share * random.uniform().powi(3);
                    let vector = &views[(of * VIEWS + view) * dim..][..dim];
                    if weight > 0.0 {
                        out.iter_mut().zip(vector).for_each(|(o, v)| *o += weight * v);
                    }
                }
            }
            make_unit(out);
        }
        out
    }

    /// Returns a text for each kind: its vector with noise as large as between texts and images.
    pub fn texts(&self) -> TextBank {
        let mut vectors = self.kinds.clone();
        for (kind, vector) in vectors.chunks_exact_mut(self.dim).enumerate() {
            Noise::new(5, kind).add_noise(0.5, vector);
            make_unit(vector);
        }
        TextBank { dim: self.dim, vectors }
    }
}

/// Places a cell's k-th Gaussian in a cube of 20 m, on a grid of 0.5 m.
pub fn place_in_cube(k: u64) -> DVec3 {
    // 41^3 places are more than a cell's Gaussians. Things are runs of k, so they stay together.
    DVec3::new((k / (41 * 41)) as f64, (k / 41 % 41) as f64, (k % 41) as f64) * 0.5
}
