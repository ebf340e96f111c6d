//! The synthetic scene: a plain of Gaussians, numbered along a Morton curve as in a cell. A view shows a square of the
//! plain, cut into a grid of regions. Some Gaussians of the square are hidden; Gaussians near a border contribute to two
//! or four regions.

use slag_encoder::lift::{Contribution, ViewContributions};
use slag_math::random::mix64;

use super::options::LiftOptions;

/// Gaussians per block of the enumeration, a power of four.
const BLOCK: u64 = 4096;
/// Share of visible Gaussians in a view's square.
const SHARE_IN_SIGHT: f64 = 0.6;
/// Levels of masks; one mask per level covers each region.
const LEVELS: usize = 4;
/// Regions per mask, where masks of several levels overlap.
const REGIONS_PER_MASK: usize = 3;

/// A plain of Gaussians and its views.
pub(super) struct Plain<'a> {
    pub(super) options: &'a LiftOptions,
    pub(super) n_gaussians_of_cell: Vec<usize>,
    /// Points of the square lattice along an edge, a power of two.
    edge: u64,
}

impl<'a> Plain<'a> {
    pub(super) fn new(options: &'a LiftOptions) -> Self {
        let n = options.n_gaussians;
        // Halved until small enough, as a split at medians does.
        let mut n_cells = 1;
        while n.div_ceil(n_cells) > options.cell_gaussians.max(1) {
            n_cells *= 2;
        }
        let bound = |cell: usize| (cell as u128 * n as u128 / n_cells as u128) as usize;
        let n_gaussians_of_cell = (0..n_cells).map(|cell| bound(cell + 1) - bound(cell)).collect();
        let mut edge = 64;
        while edge * edge < n as u64 {
            edge *= 2;
        }
        Self { options, n_gaussians_of_cell, edge }
    }

    pub(super) fn largest_cell(&self) -> usize {
        self.n_gaussians_of_cell.iter().copied().max().unwrap_or(0)
    }

    /// Returns the first Gaussian at or behind a place along the curve.
    fn gaussian_at(&self, place: u64) -> u64 {
        let n_places = u128::from(self.edge) * u128::from(self.edge);
        (u128::from(place) * self.options.n_gaussians as u128).div_ceil(n_places) as u64
    }

    fn place_of(&self, gaussian: u64) -> u64 {
        let n_places = u128::from(self.edge) * u128::from(self.edge);
        (u128::from(gaussian) * n_places / self.options.n_gaussians as u128) as u64
    }

    /// Returns a view's contributions, and how many Gaussians have any.
    pub(super) fn view(&self, view: u64) -> (ViewContributions, u64) {
        let LiftOptions { n_gaussians, n_visible, n_masks, entries_per_visible, dim, .. } = *self.options;
        let share = (n_visible as f64 / SHARE_IN_SIGHT / n_gaussians as f64).min(1.0);
        let width = (share.sqrt() * self.edge as f64).max(1.0);
        let corner = |axis| uniform(view, axis) * (self.edge as f64 - width);
        let (left, top) = (corner(1), corner(2));
        let n_across = (((n_masks * REGIONS_PER_MASK) as f64).sqrt() as u32).max(1);
        // A border of width b (in regions) on two sides gives (1 + b)^2 contributions per Gaussian.
        let border = entries_per_visible.sqrt() - 1.0;
        let mut entries_of_cell: Vec<(u32, Vec<Contribution>)> = Vec::new();
        let (mut cell, mut first_of_cell, mut n_seen) = (0, 0, 0);
        let overlaps = |from: f64, low: u64| from < (low + 64) as f64 && low as f64 <= from + width;
        for block in 0..self.edge * self.edge / BLOCK {
            let (x, y) = (compact_bits(block) * 64, compact_bits(block >> 1) * 64);
            if !overlaps(left, x) || !overlaps(top, y) {
                continue;
            }
            for gaussian in self.gaussian_at(block * BLOCK)..self.gaussian_at((block + 1) * BLOCK) {
                let place = self.place_of(gaussian);
                let u = (compact_bits(place) as f64 - left) / width;
                let v = (compact_bits(place >> 1) as f64 - top) / width;
                let random = mix64(view << 40 ^ gaussian);
                if !(0.0..1.0).contains(&u)
                    || !(0.0..1.0).contains(&v)
                    || (random >> 40) as f64 >= SHARE_IN_SIGHT * (1u64 << 24) as f64
                {
                    continue;
                }
                n_seen += 1;
                while gaussian >= first_of_cell + self.n_gaussians_of_cell[cell] as u64 {
                    first_of_cell += self.n_gaussians_of_cell[cell] as u64;
                    cell += 1;
                }
                if entries_of_cell.last().is_none_or(|(last, _)| *last != cell as u32) {
                    entries_of_cell.push((cell as u32, Vec::new()));
                }
                let Some((_, entries)) = entries_of_cell.last_mut() else { continue };
                let columns = neighbours(u * f64::from(n_across), border);
                for row in neighbours(v * f64::from(n_across), border) {
                    for column in columns.clone() {
                        let exponent = (mix64(random ^ u64::from(row * 3 + column)) >> 48) as f32 / 65536.0;
                        let weight = 10f32.powf(exponent * 4.5 - 3.0);
                        let local = (gaussian - first_of_cell) as u32;
                        entries.push(Contribution { local, region: row * n_across + column, weight });
                    }
                }
            }
        }
        let per_level = (n_masks / LEVELS).max(1) as u64;
        let masks = |region: u64| {
            let mask = |level| (level * per_level + mix64(region << 8 ^ level) % per_level) as u32;
            (0..LEVELS.min(n_masks) as u64).map(mask).collect()
        };
        let masks_of_region = (0..u64::from(n_across * n_across)).map(masks).collect();
        let mask_vectors = (0..n_masks as u64).flat_map(|mask| unit_vector(view << 20 ^ mask, dim)).collect();
        (ViewContributions { dim, mask_vectors, masks_of_region, entries_of_cell }, n_seen)
    }
}

/// Returns the regions along an axis that a Gaussian at `at` contributes to, ascending.
fn neighbours(at: f64, border: f64) -> std::ops::RangeInclusive<u32> {
    let own = at as u32;
    let reaches_before = own > 0 && at - f64::from(own) < border;
    own - u32::from(reaches_before)..=own
}

/// Returns a unit vector near a common direction, like an encoder's embeddings.
fn unit_vector(seed: u64, dim: usize) -> Vec<f32> {
    let component = |c: u64| 0.5 * uniform(7, c) + uniform(mix64(seed), c) - 0.75;
    let raw: Vec<f64> = (0..dim as u64).map(component).collect();
    let length = raw.iter().map(|c| c * c).sum::<f64>().sqrt();
    raw.into_iter().map(|c| (c / length) as f32).collect()
}

fn uniform(seed: u64, index: u64) -> f64 {
    (mix64(seed.wrapping_mul(0x2545_f491_4f6c_dd1d) ^ index) >> 11) as f64 / (1u64 << 53) as f64
}

/// Gathers every second bit, which gives a coordinate of a place along the Morton curve.
fn compact_bits(place: u64) -> u64 {
    let mut v = place & 0x5555_5555_5555_5555;
    v = (v | v >> 1) & 0x3333_3333_3333_3333;
    v = (v | v >> 2) & 0x0f0f_0f0f_0f0f_0f0f;
    v = (v | v >> 4) & 0x00ff_00ff_00ff_00ff;
    v = (v | v >> 8) & 0x0000_ffff_0000_ffff;
    (v | v >> 16) & 0xffff_ffff
}
