//! Gaussians share evidence within superpoints and objects: each superpoint becomes one more region, a mixture of
//! the masks of its Gaussians, and its Gaussians get an entry of that region.

use std::ops::Range;

use rayon::prelude::*;
use slag_math::dot;

use crate::lift::contributions::ContributionError;
use crate::lift::embeddings::MIN_MEAN_LENGTH;
use crate::lift::index::PartContributions;
use crate::lift::superpoint::{NO_SUPERPOINT, Superpoints};
use crate::lift::table::RegionTable;

/// Most masks of a mixture, heaviest first: enough for a hundred views of a few masks each.
const MAX_MASKS: usize = 256;
/// Least contributions per pair of superpoint and region: a superpoint has several Gaussians.
const ENTRIES_PER_SUM: u64 = 8;
/// Evidence of a filled Gaussian, pixels: almost none.
const FILLED_WEIGHT_PX: f32 = 1e-3;

/// Direction of each of a part's Gaussians, in 8 bits; zeros without evidence.
pub(super) fn sketches(contributions: &PartContributions, region_points: &[Point]) -> Vec<[i8; AXES]> {
    let sketch_of = |k: usize| -> [i8; AXES] {
        let mut sum = sum_of(contributions, k, region_points);
        make_unit(&mut sum);
        sum.map(|c| (127.0 * c).round() as i8)
    };
    (0..contributions.part.locals.len()).into_par_iter().map(sketch_of).collect()
}

/// Contributions by region, `(region, weight)`.
pub(super) type Sums = Vec<(u32, f32)>;

/// A part's summed contributions, by superpoint. `gaussians`: scene indices of the part's Gaussians.
pub(super) fn part_sums(
    contributions: &PartContributions,
    gaussians: &[u32],
    superpoints: &Superpoints,
) -> Vec<(usize, Sums)> {
    let superpoint_of = |k: u32| superpoints.of_gaussian[gaussians[k as usize] as usize];
    // By superpoint, then by Gaussian.
    let mut members: Vec<(u32, u32)> = (0..gaussians.len() as u32)
        .into_par_iter()
        .map(|k| (superpoint_of(k), k))
        .filter(|(superpoint, _)| *superpoint != NO_SUPERPOINT)
        .collect();
    members.par_sort_unstable();
    let of_superpoint = |members: &[(u32, u32)]| -> (usize, Sums) {
        let entries = members.iter().flat_map(|(_, k)| contributions.entries(*k as usize));
        (members[0].0 as usize, summed_by_key(entries.collect()))
    };
    let runs: Vec<&[(u32, u32)]> = members.chunk_by(|a, b| a.0 == b.0).collect();
    runs.into_par_iter().map(of_superpoint).collect()
}

/// Bytes of a partition's sums of `n_entries` contributions.
pub(super) fn sums_bytes(n_entries: u64) -> u64 {
    n_entries / ENTRIES_PER_SUM * size_of::<(u32, f32)>() as u64
}

/// Sums values by key, ascending by key.
fn summed_by_key(mut entries: Vec<(u32, f32)>) -> Vec<(u32, f32)> {
    // Stable sort: values are added in the given order.
    entries.sort_by_key(|(key, _)| *key);
    let sum = |run: &[(u32, f32)]| (run[0].0, run.iter().map(|(_, v)| f64::from(*v)).sum::<f64>() as f32);
    entries.chunk_by(|a, b| a.0 == b.0).map(sum).collect()
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct MixtureRegion {
    pub(super) region: u32,
    pub(super) length: f32,
}

/// A Gaussian's additional entry, and the remaining share of its own.
struct AddedEntry {
    region: u32,
    weight: f32,
    kept: f32,
}

/// A scene's superpoints as regions of its table.
#[derive(Debug, PartialEq)]
pub(super) struct Mixtures {
    /// Relative to the Gaussian's own entries.
    pub(super) weight: f32,
    /// `[N]`.
    pub(super) of_gaussian: Vec<u32>,
    /// By superpoint; `None` without evidence.
    pub(super) regions: Vec<Option<MixtureRegion>>,
}

impl Mixtures {
    /// Appends a region for each superpoint with evidence. `sums`: of each superpoint, one run a part.
    pub(super) fn new(
        weight: f32,
        superpoints: Superpoints,
        sums: Vec<Sums>,
        table: &mut RegionTable,
        mask_points: &[Point],
    ) -> Result<Self, ContributionError> {
        let of_table = &*table;
        let mixture = |entries: Vec<(u32, f32)>| -> Vec<(u32, f32)> {
            let masks_of = |(region, weight): (u32, f32)| {
                of_table.masks_of(region as usize).map(move |(mask, share)| (mask, weight * share))
            };
            let mut masks = summed_by_key(summed_by_key(entries).into_iter().flat_map(masks_of).collect());
            masks.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
            masks.truncate(MAX_MASKS);
            masks.sort_by_key(|(mask, _)| *mask);
            let total: f32 = masks.iter().map(|(_, share)| share).sum();
            masks.iter_mut().for_each(|(_, share)| *share /= total);
            masks
        };
        let with_length = |entries| {
            let mixture = mixture(entries);
            let mut sum = [0.0; AXES];
            mixture.iter().for_each(|(mask, share)| add(&mut sum, *share, &mask_points[*mask as usize]));
            (mixture, length(&sum))
        };
        let mixtures: Vec<(Vec<(u32, f32)>, f32)> = sums.into_par_iter().map(with_length).collect();
        let mut region = |(mixture, length): (Vec<(u32, f32)>, f32)| match length > MIN_MEAN_LENGTH {
            true => Ok(Some(MixtureRegion { region: table.append_mixture(&mixture)?, length })),
            false => Ok(None),
        };
        let regions = mixtures.into_iter().map(&mut region).collect::<Result<_, ContributionError>>()?;
        Ok(Self { weight, of_gaussian: superpoints.of_gaussian, regions })
    }

    /// Adds its superpoint's entry to each Gaussian of a part. With `fill`, Gaussians without evidence take that alone.
    pub(super) fn apply(
        &self,
        contributions: &mut PartContributions,
        gaussians: &[u32],
        region_points: &[Point],
        fill: bool,
    ) {
        let share = self.weight / (1.0 + self.weight);
        let entry_of = |k: usize| -> Option<AddedEntry> {
            let superpoint = self.of_gaussian[gaussians[k] as usize];
            let MixtureRegion { region, length: of_mixture } = (*self.regions.get(superpoint as usize)?)?;
            let own = length(&sum_of(contributions, k, region_points));
            if contributions.total_weights[k] > 0.0 && own > MIN_MEAN_LENGTH * contributions.total_weights[k]
            {
                let weight = share * own / of_mixture;
                (share > 0.0).then_some(AddedEntry { region, weight, kept: 1.0 - share })
            } else {
                fill.then_some(AddedEntry { region, weight: FILLED_WEIGHT_PX, kept: 0.0 })
            }
        };
        let added: Vec<Option<AddedEntry>> = (0..gaussians.len()).into_par_iter().map(entry_of).collect();
        let n_entries = contributions.regions.len() + added.iter().flatten().count();
        let (mut regions, mut weights) = (Vec::with_capacity(n_entries), Vec::with_capacity(n_entries));
        let mut start = 0;
        for (k, added) in added.into_iter().enumerate() {
            let entries = start..contributions.starts[k + 1] as usize;
            start = entries.end;
            let kept = added.as_ref().map_or(1.0, |added| added.kept);
            if kept > 0.0 {
                regions.extend(&contributions.regions[entries.clone()]);
                weights.extend(contributions.weights[entries].iter().map(|weight| weight * kept));
            } else {
                contributions.total_weights[k] = FILLED_WEIGHT_PX;
            }
            if let Some(AddedEntry { region, weight, .. }) = added {
                regions.push(region);
                weights.push(weight);
            }
            contributions.starts[k + 1] = regions.len() as u64;
        }
        (contributions.regions, contributions.weights) = (regions, weights);
    }
}

/// Number of principal axes: 48 keep nine tenths of the variance of mask vectors of 512 components (measured).
pub(super) const AXES: usize = 48;

/// Coordinates along the principal axes.
pub(super) type Point = [f32; AXES];

#[inline(always)]
pub(super) fn add(sum: &mut Point, weight: f32, point: &Point) {
    sum.iter_mut().zip(point).for_each(|(s, p)| *s += weight * p);
}

pub(super) fn length(point: &Point) -> f32 {
    dot(point, point).sqrt()
}

/// Zeros stay zeros.
pub(super) fn make_unit(point: &mut Point) {
    let length = length(point);
    if length > 0.0 {
        point.iter_mut().for_each(|c| *c /= length);
    }
}

pub(super) fn points_of_regions(
    table: &RegionTable,
    mask_points: &[Point],
    regions: Range<usize>,
) -> Vec<Point> {
    let point = |region: usize| {
        let mut sum = [0.0; AXES];
        table.masks_of(region).for_each(|(mask, share)| add(&mut sum, share, &mask_points[mask as usize]));
        sum
    };
    regions.into_par_iter().map(point).collect()
}

pub(super) fn sum_of(contributions: &PartContributions, k: usize, region_points: &[Point]) -> Point {
    let mut sum = [0.0; AXES];
    for (region, weight) in contributions.entries(k) {
        add(&mut sum, weight, &region_points[region as usize]);
    }
    sum
}
