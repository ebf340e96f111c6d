//! A generated site: things on open ground.

use glam::DVec3;
use slag_common::Gaussians;
use slag_math::random::mix64;

use crate::bench::field::grey_gaussians;
use crate::generate::field::Field;

/// Gaussians of a tile: a thing of [`Field`].
const TILE_GAUSSIANS: usize = 1_250;
/// Highest point of the things.
const HEIGHT_M: f64 = 3.0;

/// Gaussians spread over a square, with embeddings.
pub(super) struct Site {
    /// The splat.
    pub(super) scene: Gaussians,
    /// `[n][dim]`.
    pub(super) embeddings: Vec<f32>,
    /// The field that the embeddings are of.
    pub(super) field: Field,
    /// Edge of the square, metres; its corner is the origin.
    pub(super) width_m: f64,
}

impl Site {
    /// Makes a site of about `n_gaussians` on a square of about this width. Things lie in rows, each in a tile of its own.
    pub(super) fn new(n_gaussians: usize, dim: usize, width_m: f64) -> Self {
        let field = Field::new(n_gaussians, dim);
        let n = field.cell_gaussians() * field.n_cells();
        let tiles_per_side = ((n as f64 / TILE_GAUSSIANS as f64).sqrt().ceil() as usize).max(1);
        let tile_m = width_m / tiles_per_side as f64;
        let place = |k: usize| {
            let (row, column) = (k / TILE_GAUSSIANS / tiles_per_side, k / TILE_GAUSSIANS % tiles_per_side);
            // Rows alternate in direction, so that the field's neighbours are neighbours on the ground.
            let column = if row.is_multiple_of(2) { column } else { tiles_per_side - 1 - column };
            let uniform = |axis: u64| (mix64(3 * k as u64 + axis) >> 11) as f64 / (1u64 << 53) as f64;
            let (x, y) = ((column as f64 + uniform(0)) * tile_m, (row as f64 + uniform(1)) * tile_m);
            DVec3::new(x, y, HEIGHT_M * uniform(2).powi(2))
        };
        let embeddings = (0..field.n_cells()).flat_map(|cell| field.embeddings(cell)).collect();
        Self { scene: grey_gaussians((0..n).map(place).collect()), embeddings, field, width_m }
    }

    /// Returns the number of Gaussians within a radius of a place.
    pub(super) fn n_within(&self, place: DVec3, radius_m: f64) -> usize {
        let is_within = |mean: &&DVec3| mean.distance(place) <= radius_m;
        self.scene.means_in_world.iter().filter(is_within).count()
    }

    /// Returns places whose circles of this radius lie within the square, where it is large enough for that.
    pub(super) fn places(&self, n: usize, radius_m: f64) -> Vec<DVec3> {
        let (from, to) =
            (radius_m.min(self.width_m / 2.0), (self.width_m - radius_m).max(self.width_m / 2.0));
        // Halton's sequence spreads few points evenly.
        let at = |k: usize, base: usize| from + (to - from) * halton(k + 1, base);
        (0..n).map(|k| DVec3::new(at(k, 2), at(k, 3), 1.0)).collect()
    }
}

/// Returns the k-th number of a sequence in 0..1: the digits of k behind the point, reversed.
fn halton(mut k: usize, base: usize) -> f64 {
    let (mut digit, mut value) = (1.0, 0.0);
    while k > 0 {
        digit /= base as f64;
        value += digit * (k % base) as f64;
        k /= base;
    }
    value
}
