//! Masks that other views contradict count less: a mask's agreement is its mean cosine with the embeddings that the other
//! views give its Gaussians.

use rayon::prelude::*;
use slag_math::dot;
use slag_math::stats::median;

use super::points::{AXES, Point, add, length, sum_of};
use super::settings::LEAST_MASK_WEIGHT;
use super::views::FirstRegions;
use crate::lift::part::PartContributions;
use crate::lift::table::RegionTable;

/// Gaussians that a thread works on at a time. A constant, because votes are added up chunk by chunk.
const CHUNK: usize = 4096;
/// Smallest share of a Gaussian's sum that the other views must hold to have a say about a view.
const LEAST_REST: f32 = 1e-3;

/// The other views' embeddings of a region's Gaussians.
#[derive(Clone, Copy)]
struct Vote {
    /// Weighted sum of unit directions.
    direction: Point,
    weight: f32,
}

impl Default for Vote {
    fn default() -> Self {
        Self { direction: [0.0; AXES], weight: 0.0 }
    }
}

/// The votes of a part's Gaussians.
pub(super) struct PartVotes(Vec<Vec<(u32, Vote)>>);

/// The votes of all Gaussians so far, by region.
pub(super) struct Votes(Vec<Vote>);

impl Votes {
    /// Bytes of a region's vote.
    pub(super) const BYTES_PER_REGION: usize = size_of::<Vote>();

    pub(super) fn new(n_regions: usize) -> Self {
        Self(vec![Vote::default(); n_regions])
    }

    /// Returns the votes of a part's Gaussians by region, chunk by chunk.
    pub(super) fn of_part(
        contributions: &PartContributions,
        first_regions: &FirstRegions,
        region_points: &[Point],
    ) -> PartVotes {
        let n = contributions.total_weights.len();
        let of_chunk = |first: usize| -> Vec<(u32, Vote)> {
            let gaussians = first..(first + CHUNK).min(n);
            let entries =
                contributions.starts[gaussians.start] as usize..contributions.starts[gaussians.end] as usize;
            let mut regions: Vec<u32> = contributions.regions[entries].to_vec();
            regions.sort_unstable();
            regions.dedup();
            let mut votes = vec![Vote::default(); regions.len()];
            for k in gaussians {
                let entries = contributions.entries_of(k);
                let whole = sum_of(contributions, entries.clone(), region_points);
                let least = LEAST_REST * length(&whole);
                for view in first_regions.cut(contributions, entries) {
                    let mut rest = whole;
                    add(&mut rest, -1.0, &sum_of(contributions, view.entries.clone(), region_points));
                    let of_rest = length(&rest);
                    if of_rest.is_nan() || of_rest <= least {
                        continue;
                    }
                    for entry in view.entries {
                        let weight = contributions.weights[entry];
                        if let Ok(at) = regions.binary_search(&contributions.regions[entry]) {
                            add(&mut votes[at].direction, weight / of_rest, &rest);
                            votes[at].weight += weight;
                        }
                    }
                }
            }
            regions.into_iter().zip(votes).collect()
        };
        let firsts: Vec<usize> = (0..n).step_by(CHUNK).collect();
        PartVotes(firsts.into_par_iter().map(of_chunk).collect())
    }

    /// Adds the votes of a part.
    pub(super) fn add(&mut self, of_part: PartVotes) {
        for (region, vote) in of_part.0.into_iter().flatten() {
            let sum = &mut self.0[region as usize];
            add(&mut sum.direction, 1.0, &vote.direction);
            sum.weight += vote.weight;
        }
    }

    /// Returns the agreement of each mask to a power. A mask without votes gets the median agreement.
    pub(super) fn agreements(&self, table: &RegionTable, mask_points: &[Point], power: f32) -> Vec<f32> {
        let mut of_masks = vec![Vote::default(); mask_points.len()];
        for (region, vote) in self.0.iter().enumerate() {
            for (mask, _) in table.masks_of(region) {
                let sum = &mut of_masks[mask as usize];
                add(&mut sum.direction, 1.0, &vote.direction);
                sum.weight += vote.weight;
            }
        }
        let cosine = |(vote, point): (&Vote, &Point)| {
            (vote.weight > 0.0).then(|| dot(&vote.direction, point) / vote.weight)
        };
        let cosines: Vec<Option<f32>> = of_masks.iter().zip(mask_points).map(cosine).collect();
        let mut known: Vec<f32> = cosines.iter().flatten().copied().collect();
        let median = median(&mut known).unwrap_or(1.0);
        let weight = |cosine: &Option<f32>| cosine.unwrap_or(median).max(LEAST_MASK_WEIGHT).powf(power);
        cosines.iter().map(weight).collect()
    }
}
