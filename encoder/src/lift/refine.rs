//! What may be done better than the paper's plain average; each part on its own, nothing by default.
//!
//! | field of [`Aggregation`] | what it changes |
//! |---|---|
//! | `min_region_share`, `min_view_share` | contributions of a region at whose edge a Gaussian lies, of views that hardly see it, are left out |
//! | `min_weight_px` | a Gaussian that hardly shows anywhere has no evidence |
//! | `wholeness` | a mask counts less that the photo's edge cuts off |
//! | `equalisation` | views count less by how near, and how little aslant, they see a Gaussian |
//! | `agreement` | a mask counts as far as it agrees with what other views say of its Gaussians |
//! | `median_steps` | views that disagree count less: steps towards the geometric median |
//! | `superpoint` | a Gaussian's row takes a part of its superpoint's |
//! | `coarse` | then a part of a larger superpoint's |
//! | `fill` | a Gaussian without evidence takes its superpoint's row |
//!
//! The result is again sparse contributions over regions: masks that count for less are in the [`RegionTable`], and a
//! superpoint is one more region of it, a mixture of masks. So scores, shards and what is published agree, and a
//! row has two entries more at most.
//!
//! Everything here is decided among the vectors' coordinates along a few principal axes, and in one order: the
//! results do not depend on threads or on the memory budget.

use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use slag_common::Gaussians;

use super::contributions::ContributionError;
use super::field::MIN_MEAN_LENGTH;
use super::photos::{self, LEAST_MASK_WEIGHT, Photo};
use super::table::RegionTable;
use super::transpose::{ContributionIndex, PartContributions};
use crate::cells::CellSplit;
use crate::lift::superpoint::{Graph, NO_SUPERPOINT, Sketches, SuperpointSettings, Superpoints};
use slag_math::axes::principal_coordinates;
use slag_math::dot;

/// Principal axes: nine tenths of the squares of mask vectors of 512 components (measured).
const AXES: usize = 48;
/// Gaussians worked on at a time by a thread; a constant, because contributions are taken chunk by chunk.
const CHUNK: usize = 4096;
/// Distance on the unit sphere below which the median's steps no longer tell views apart.
const MEDIAN_RESOLUTION: f32 = 0.1;
/// Masks of a superpoint's mixture at most, the heaviest: some hundred views of a few masks each.
const MIXTURE_MASKS: usize = 256;
/// Evidence that a filled Gaussian states, pixels: next to nothing.
const FILLED_WEIGHT_PX: f32 = 1e-3;
/// What is left of a Gaussian's sum without a view must be this part of it to say anything of the view.
const LEAST_REST: f32 = 1e-3;

/// How the contributions of all views become embeddings. The default is the paper's plain average.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Aggregation {
    /// Sums below this part of the Gaussian's largest in the same view are left out, 0..=1.
    pub min_region_share: f32,
    /// Views in which a Gaussian has less than this part of the weight that it has in its best are left out, 0..=1.
    pub min_view_share: f32,
    /// Gaussians with less weight over all views have no evidence, pixels.
    pub min_weight_px: f32,
    /// A mask counts the part of its outline that the photo's edge does not cut off, to this power; 0: once.
    pub wholeness: f32,
    /// A view counts its weight for a Gaussian, the solid angle that it sees of it, to the power of 1 less this: 1
    /// lets all views count alike.
    pub equalisation: f32,
    /// A mask counts its mean cosine with its Gaussians' embeddings from other views to this power; 0: once.
    pub agreement: f32,
    /// Steps (Weiszfeld 1937) from the mean of a Gaussian's views to their geometric median.
    pub median_steps: u32,
    /// What a superpoint's mean counts beside the Gaussian's own, which counts 1.
    pub superpoint: f32,
    /// What the mean of a larger superpoint counts beside what came of that, which counts 1.
    pub coarse: f32,
    /// Whether Gaussians without evidence take their superpoint's mean.
    pub fill: bool,
}

impl Aggregation {
    /// The paper's plain average.
    pub const PAPER: Self = Self {
        min_region_share: 0.0,
        min_view_share: 0.0,
        min_weight_px: 0.0,
        wholeness: 0.0,
        equalisation: 0.0,
        agreement: 0.0,
        median_steps: 0,
        superpoint: 0.0,
        coarse: 0.0,
        fill: false,
    };
    /// What was measured to help on a trained splat and on generated ones alike. Pruning by region helps the
    /// first, whose Gaussians lie across outlines, and costs the others more.
    pub const REFINED: Self = Self {
        min_view_share: 0.1,
        wholeness: 2.0,
        agreement: 0.5,
        superpoint: 3.0,
        coarse: 0.7,
        fill: true,
        ..Self::PAPER
    };

    /// Returns the plain average, each option alone, and those that are used together: what tables compare.
    pub fn methods() -> Vec<(&'static str, Self)> {
        let (paper, refined) = (Self::PAPER, Self::REFINED);
        vec![
            ("paper", paper),
            ("regions", Self { min_region_share: 0.5, ..paper }),
            ("views", Self { min_view_share: refined.min_view_share, ..paper }),
            ("gate", Self { min_weight_px: 1.0, ..paper }),
            ("wholeness", Self { wholeness: refined.wholeness, ..paper }),
            ("equalisation", Self { equalisation: 0.5, ..paper }),
            ("agreement", Self { agreement: refined.agreement, ..paper }),
            ("median", Self { median_steps: 3, ..paper }),
            ("superpoints", Self { superpoint: refined.superpoint, ..paper }),
            ("coarse", Self { coarse: refined.coarse, ..paper }),
            ("fill", Self { fill: true, ..paper }),
            ("refined", refined),
        ]
    }

    fn needs_superpoints(&self) -> bool {
        self.superpoint > 0.0 || self.coarse > 0.0 || self.fill
    }
}

/// A vector's coordinates along the principal axes.
type Point = [f32; AXES];

/// A scene's superpoints as regions.
struct Mixtures {
    of_gaussian: Vec<u32>,
    /// Of each superpoint: its region, and the length of its vector; absent without evidence.
    regions: Vec<Option<(u32, f32)>>,
}

/// What the views of a scene decide together, and how a part's contributions are changed by it.
pub struct Refinement {
    settings: Aggregation,
    /// First region of each view.
    first_regions: Vec<u32>,
    /// `[n_regions]`: how often masks count in each.
    mask_counts: Vec<f32>,
    /// `[n_regions]`: each region's vector; empty where none is needed.
    points: Vec<Point>,
    /// Finer superpoints first, and what each counts.
    mixtures: Vec<(f32, Mixtures)>,
}

/// A Gaussian's entries of one view, and their weight.
struct ViewEntries {
    entries: Range<usize>,
    weight: f32,
}

impl Refinement {
    /// Reads all contributions as often as is needed and decides what masks count and what superpoints say; adds both to
    /// the table. `None` if cancelled, and where the plain average is asked for.
    ///
    /// # Errors
    /// [`ContributionError`].
    pub fn prepare(
        settings: Aggregation,
        (index, table): (&ContributionIndex, &mut RegionTable),
        (scene, split): (&Gaussians, &CellSplit),
        photos: &[Photo],
        group_bytes: u64,
        cancel: &AtomicBool,
    ) -> Result<Option<Self>, ContributionError> {
        if settings == Aggregation::PAPER {
            return Ok(None);
        }
        let first_regions = index.first_regions();
        let mut refinement = Self {
            settings,
            first_regions,
            mask_counts: Vec::new(),
            points: Vec::new(),
            mixtures: Vec::new(),
        };
        let mut mask_weights = photos::mask_weights(photos, settings.wholeness);
        if settings.wholeness > 0.0 {
            table.set_mask_weights(&mask_weights);
        }
        refinement.mask_counts = table.mask_counts(0..table.len());
        let is_plain =
            settings.agreement == 0.0 && settings.median_steps == 0 && !settings.needs_superpoints();
        if is_plain || table.is_empty() {
            return Ok(Some(refinement));
        }
        let mask_points = principal_coordinates(table.mask_vectors(), AXES);
        let mask_points: &[Point] = mask_points.as_chunks().0;
        refinement.points = region_points(table, mask_points, 0..table.len());
        let each_part = |table: &RegionTable,
                         visit: &mut dyn FnMut(PartContributions)|
         -> Result<bool, ContributionError> {
            for group in index.groups(group_bytes) {
                let contributions = index.transpose(&index.read(group)?, table)?;
                if cancel.load(Ordering::Relaxed) {
                    return Ok(false);
                }
                contributions.into_iter().for_each(&mut *visit);
            }
            Ok(true)
        };
        if settings.agreement > 0.0 {
            let mut votes = vec![Vote::default(); table.len()];
            let done = each_part(table, &mut |mut contributions| {
                refinement.prune(&mut contributions);
                refinement.add_votes(&contributions, &mut votes);
            })?;
            if !done {
                return Ok(None);
            }
            let agreements = agreements(table, mask_points, &votes, settings.agreement);
            mask_weights.iter_mut().zip(agreements).for_each(|(weight, agreement)| *weight *= agreement);
            table.set_mask_weights(&mask_weights);
            refinement.mask_counts = table.mask_counts(0..table.len());
            refinement.points = region_points(table, mask_points, 0..table.len());
        }
        if settings.needs_superpoints() {
            let mut sketches = vec![0; scene.len() * AXES];
            let done = each_part(table, &mut |mut contributions| {
                refinement.change_rows(&mut contributions);
                let gaussians = &split.cells[contributions.part.cell_id as usize].gaussians
                    [contributions.part.locals.clone()];
                refinement.sketch(&contributions, gaussians, &mut sketches);
            })?;
            if !done {
                return Ok(None);
            }
            let sketches = Sketches { width: AXES, values: &sketches };
            let graph = Graph::new(scene, Some(sketches), &SuperpointSettings::default());
            let mut levels = Vec::new();
            if settings.superpoint > 0.0 || settings.fill {
                levels.push((settings.superpoint, graph.superpoints(&SuperpointSettings::default())));
            }
            if settings.coarse > 0.0 {
                levels.push((settings.coarse, graph.superpoints(&SuperpointSettings::coarse())));
            }
            drop(graph);
            let mut regions_of: Vec<Vec<Vec<(u32, f32)>>> =
                levels.iter().map(|(_, superpoints)| vec![Vec::new(); superpoints.n]).collect();
            let done = each_part(table, &mut |mut contributions| {
                refinement.change_rows(&mut contributions);
                let gaussians = &split.cells[contributions.part.cell_id as usize].gaussians
                    [contributions.part.locals.clone()];
                for ((_, superpoints), regions_of) in levels.iter().zip(&mut regions_of) {
                    add_rows(&contributions, gaussians, superpoints, regions_of);
                }
            })?;
            if !done {
                return Ok(None);
            }
            for ((count, superpoints), regions_of) in levels.into_iter().zip(regions_of) {
                let mixtures = Mixtures::new(superpoints, regions_of, table, mask_points);
                refinement.mixtures.push((count, mixtures));
            }
            // Those of the mixtures, which the next one is mixed with.
            let mixtures = region_points(table, mask_points, refinement.points.len()..table.len());
            refinement.points.extend(mixtures);
        }
        Ok(Some(refinement))
    }

    /// Returns the bytes that are taken beside the table and the contributions, at most, of `n_gaussians` and `n_regions`.
    pub fn len_bytes(settings: &Aggregation, n_gaussians: usize, n_regions: usize) -> u64 {
        if *settings == Aggregation::PAPER {
            return 0;
        }
        let of_regions = n_regions * (size_of::<Point>() + size_of::<Vote>());
        let of_superpoints = match settings.needs_superpoints() {
            false => 0,
            true => {
                let working = Superpoints::working_bytes(n_gaussians, &SuperpointSettings::default());
                (n_gaussians * (AXES + size_of::<u32>())) as u64 + working
            }
        };
        of_regions as u64 + of_superpoints
    }

    /// Changes a part's contributions; `gaussians`: the scene's numbers of its Gaussians.
    pub fn apply(&self, contributions: &mut PartContributions, gaussians: &[u32]) {
        self.change_rows(contributions);
        for (count, mixtures) in &self.mixtures {
            self.mix(contributions, gaussians, mixtures, *count);
        }
    }

    /// All but the superpoints.
    fn change_rows(&self, contributions: &mut PartContributions) {
        self.prune(contributions);
        if self.settings.equalisation > 0.0 {
            self.scale_views(contributions, |_, views| self.evened(views));
        }
        if self.settings.median_steps > 0 {
            self.scale_views(contributions, |contributions, views| self.towards_median(contributions, views));
        }
    }

    /// Cuts a row of entries, ascending by region, into its views.
    fn views_of(&self, contributions: &PartContributions, row: Range<usize>) -> Vec<ViewEntries> {
        let mut views: Vec<ViewEntries> = Vec::new();
        let mut end_region = 0;
        for entry in row {
            let region = contributions.regions[entry];
            if views.is_empty() || region >= end_region {
                let next = self.first_regions.partition_point(|first| *first <= region);
                end_region = self.first_regions.get(next).copied().unwrap_or(u32::MAX);
                views.push(ViewEntries { entries: entry..entry, weight: 0.0 });
            }
            if let Some(view) = views.last_mut() {
                view.entries.end = entry + 1;
                view.weight += contributions.weights[entry];
            }
        }
        views
    }

    /// Drops entries that say little of their Gaussian.
    fn prune(&self, contributions: &mut PartContributions) {
        let Aggregation { min_region_share, min_view_share, min_weight_px, .. } = self.settings;
        if min_region_share <= 0.0 && min_view_share <= 0.0 && min_weight_px <= 0.0 {
            return;
        }
        let n = contributions.total_weights.len();
        let kept_of_chunk = |first: usize| -> Vec<Vec<u32>> {
            let weights = &contributions.weights;
            let kept_of = |k: usize| {
                let row = contributions.starts[k] as usize..contributions.starts[k + 1] as usize;
                let views = self.views_of(contributions, row);
                let best = views.iter().map(|view| view.weight).fold(0.0, f32::max);
                if views.iter().map(|view| view.weight).sum::<f32>() < min_weight_px {
                    return Vec::new();
                }
                let seen = views.into_iter().filter(|view| view.weight >= min_view_share * best);
                seen.flat_map(|view| {
                    let largest = weights[view.entries.clone()].iter().copied().fold(0.0, f32::max);
                    let large = move |entry: &usize| weights[*entry] >= min_region_share * largest;
                    view.entries.filter(large).map(|entry| entry as u32)
                })
                .collect()
            };
            (first..(first + CHUNK).min(n)).map(kept_of).collect()
        };
        let firsts: Vec<usize> = (0..n).step_by(CHUNK).collect();
        let kept: Vec<Vec<u32>> = firsts.into_par_iter().flat_map_iter(kept_of_chunk).collect();
        let mut at = 0;
        for (k, kept) in kept.into_iter().enumerate() {
            let mut total = 0.0;
            for entry in kept {
                let entry = entry as usize;
                (contributions.regions[at], contributions.weights[at]) =
                    (contributions.regions[entry], contributions.weights[entry]);
                total += f64::from(contributions.weights[at])
                    * f64::from(self.mask_counts[contributions.regions[at] as usize]);
                at += 1;
            }
            contributions.starts[k + 1] = at as u64;
            contributions.total_weights[k] = total as f32;
        }
        contributions.regions.truncate(at);
        contributions.weights.truncate(at);
    }

    fn sum_of(&self, contributions: &PartContributions, entries: Range<usize>) -> Point {
        let mut sum = [0.0; AXES];
        for (region, weight) in
            contributions.regions[entries.clone()].iter().zip(&contributions.weights[entries])
        {
            add(&mut sum, *weight, &self.points[*region as usize]);
        }
        sum
    }

    /// Adds, to each region, the directions in which other views see its Gaussians.
    fn add_votes(&self, contributions: &PartContributions, votes: &mut [Vote]) {
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
                let row = contributions.starts[k] as usize..contributions.starts[k + 1] as usize;
                let whole = self.sum_of(contributions, row.clone());
                let least = LEAST_REST * length(&whole);
                for view in self.views_of(contributions, row) {
                    let mut rest = whole;
                    add(&mut rest, -1.0, &self.sum_of(contributions, view.entries.clone()));
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
        let of_chunks: Vec<Vec<(u32, Vote)>> = firsts.into_par_iter().map(of_chunk).collect();
        for (region, vote) in of_chunks.into_iter().flatten() {
            let sum = &mut votes[region as usize];
            add(&mut sum.direction, 1.0, &vote.direction);
            sum.weight += vote.weight;
        }
    }

    /// Scales the entries of each Gaussian's views by factors; the evidence stays what it was.
    fn scale_views(
        &self,
        contributions: &mut PartContributions,
        factors: impl Fn(&PartContributions, &[ViewEntries]) -> Vec<f32> + Sync,
    ) {
        let n = contributions.total_weights.len();
        let factors_of = |k: usize| -> Vec<(Range<usize>, f32)> {
            let views = self.views_of(
                contributions,
                contributions.starts[k] as usize..contributions.starts[k + 1] as usize,
            );
            let factors = factors(contributions, &views);
            views.into_iter().map(|view| view.entries).zip(factors).collect()
        };
        let factors: Vec<Vec<(Range<usize>, f32)>> = (0..n).into_par_iter().map(factors_of).collect();
        for (entries, factor) in factors.into_iter().flatten() {
            contributions.weights[entries].iter_mut().for_each(|weight| *weight *= factor);
        }
    }

    /// Returns the factors by which a Gaussian's views count more alike, at the same weight together.
    fn evened(&self, views: &[ViewEntries]) -> Vec<f32> {
        let factors: Vec<f32> = views
            .iter()
            .map(|view| view.weight.max(f32::MIN_POSITIVE).powf(-self.settings.equalisation))
            .collect();
        let total: f32 = views.iter().map(|view| view.weight).sum();
        let evened: f32 = views.iter().zip(&factors).map(|(view, factor)| view.weight * factor).sum();
        factors.into_iter().map(|factor| factor * total / evened).collect()
    }

    /// Returns the factors that Weiszfeld's steps give a Gaussian's views.
    fn towards_median(&self, contributions: &PartContributions, views: &[ViewEntries]) -> Vec<f32> {
        let mut of_views: Vec<Point> =
            views.iter().map(|view| self.sum_of(contributions, view.entries.clone())).collect();
        let weights: Vec<f32> = of_views.iter().map(length).collect();
        of_views.iter_mut().for_each(make_unit);
        let mut factors = vec![1.0; views.len()];
        for _ in 0..self.settings.median_steps {
            let mut median = [0.0; AXES];
            for ((point, weight), factor) in of_views.iter().zip(&weights).zip(&factors) {
                add(&mut median, weight * factor, point);
            }
            make_unit(&mut median);
            for (factor, point) in factors.iter_mut().zip(&of_views) {
                let distance = (2.0 - 2.0 * dot(point, &median)).max(0.0).sqrt();
                *factor = MEDIAN_RESOLUTION / distance.max(MEDIAN_RESOLUTION);
            }
        }
        factors
    }

    /// Writes each Gaussian's direction, rounded; zeros where there is no evidence.
    fn sketch(&self, contributions: &PartContributions, gaussians: &[u32], sketches: &mut [i8]) {
        let sketch_of = |k: usize| -> [i8; AXES] {
            let mut sum = self.sum_of(
                contributions,
                contributions.starts[k] as usize..contributions.starts[k + 1] as usize,
            );
            make_unit(&mut sum);
            sum.map(|c| (127.0 * c).round() as i8)
        };
        let of_part: Vec<[i8; AXES]> = (0..gaussians.len()).into_par_iter().map(sketch_of).collect();
        for (gaussian, sketch) in gaussians.iter().zip(of_part) {
            sketches[*gaussian as usize * AXES..][..AXES].copy_from_slice(&sketch);
        }
    }

    /// Adds each Gaussian's superpoint to its row, `count` times as much as the row itself.
    fn mix(&self, contributions: &mut PartContributions, gaussians: &[u32], mixtures: &Mixtures, count: f32) {
        let share = count / (1.0 + count);
        // Region and weight of the entry that is added, and what the row keeps.
        let entry_of = |k: usize| -> Option<(u32, f32, f32)> {
            let superpoint = mixtures.of_gaussian[gaussians[k] as usize];
            let (region, of_mixture) = (*mixtures.regions.get(superpoint as usize)?)?;
            let own = length(&self.sum_of(
                contributions,
                contributions.starts[k] as usize..contributions.starts[k + 1] as usize,
            ));
            if contributions.total_weights[k] > 0.0 && own > MIN_MEAN_LENGTH * contributions.total_weights[k]
            {
                (share > 0.0).then_some((region, share * own / of_mixture, 1.0 - share))
            } else {
                self.settings.fill.then_some((region, FILLED_WEIGHT_PX, 0.0))
            }
        };
        let added: Vec<Option<(u32, f32, f32)>> =
            (0..gaussians.len()).into_par_iter().map(entry_of).collect();
        let n_entries = contributions.regions.len() + added.iter().flatten().count();
        let (mut regions, mut weights) = (Vec::with_capacity(n_entries), Vec::with_capacity(n_entries));
        let mut start = 0;
        for (k, added) in added.into_iter().enumerate() {
            let row = start..contributions.starts[k + 1] as usize;
            start = row.end;
            let kept = added.map_or(1.0, |(_, _, kept)| kept);
            if kept > 0.0 {
                regions.extend(&contributions.regions[row.clone()]);
                weights.extend(contributions.weights[row].iter().map(|weight| weight * kept));
            } else {
                contributions.total_weights[k] = FILLED_WEIGHT_PX;
            }
            if let Some((region, weight, _)) = added {
                regions.push(region);
                weights.push(weight);
            }
            contributions.starts[k + 1] = regions.len() as u64;
        }
        (contributions.regions, contributions.weights) = (regions, weights);
    }
}

/// What other views say of a region's Gaussians.
#[derive(Clone, Copy)]
struct Vote {
    /// Sum of directions, by weight.
    direction: Point,
    weight: f32,
}

impl Default for Vote {
    fn default() -> Self {
        Self { direction: [0.0; AXES], weight: 0.0 }
    }
}

/// Returns the mean cosine of each mask with what other views say of its Gaussians, to a power; the median where
/// no other view says anything.
fn agreements(table: &RegionTable, mask_points: &[Point], votes: &[Vote], power: f32) -> Vec<f32> {
    let mut of_masks = vec![Vote::default(); mask_points.len()];
    for (region, vote) in votes.iter().enumerate() {
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
    known.sort_by(f32::total_cmp);
    let median = known.get(known.len() / 2).copied().unwrap_or(1.0);
    let weight = |cosine: &Option<f32>| cosine.unwrap_or(median).max(LEAST_MASK_WEIGHT).powf(power);
    cosines.iter().map(weight).collect()
}

fn region_points(table: &RegionTable, mask_points: &[Point], regions: Range<usize>) -> Vec<Point> {
    let point = |region: usize| {
        let mut sum = [0.0; AXES];
        table.masks_of(region).for_each(|(mask, share)| add(&mut sum, share, &mask_points[mask as usize]));
        sum
    };
    regions.into_par_iter().map(point).collect()
}

/// Adds the rows of a part's Gaussians to their superpoints' `(region, weight)`.
fn add_rows(
    contributions: &PartContributions,
    gaussians: &[u32],
    superpoints: &Superpoints,
    regions_of: &mut [Vec<(u32, f32)>],
) {
    let superpoint_of = |k: u32| superpoints.of_gaussian[gaussians[k as usize] as usize];
    let mut members: Vec<u32> =
        (0..gaussians.len() as u32).filter(|k| superpoint_of(*k) != NO_SUPERPOINT).collect();
    members.sort_by_key(|k| superpoint_of(*k));
    let of_superpoint = |members: &[u32]| -> (usize, Vec<(u32, f32)>) {
        let mut entries = Vec::new();
        for k in members {
            let row =
                contributions.starts[*k as usize] as usize..contributions.starts[*k as usize + 1] as usize;
            entries.extend(
                contributions.regions[row.clone()]
                    .iter()
                    .copied()
                    .zip(contributions.weights[row].iter().copied()),
            );
        }
        (superpoint_of(members[0]) as usize, added_up(entries))
    };
    let runs: Vec<&[u32]> = members.chunk_by(|a, b| superpoint_of(*a) == superpoint_of(*b)).collect();
    let of_part: Vec<(usize, Vec<(u32, f32)>)> = runs.into_par_iter().map(of_superpoint).collect();
    of_part.into_iter().for_each(|(superpoint, entries)| regions_of[superpoint].extend(entries));
}

/// Returns the sum of the values of each key, ascending by key.
fn added_up(mut entries: Vec<(u32, f32)>) -> Vec<(u32, f32)> {
    // Stable: values are added in the order in which they came.
    entries.sort_by_key(|(key, _)| *key);
    let sum = |run: &[(u32, f32)]| (run[0].0, run.iter().map(|(_, v)| f64::from(*v)).sum::<f64>() as f32);
    entries.chunk_by(|a, b| a.0 == b.0).map(sum).collect()
}

impl Mixtures {
    /// Makes a region of each superpoint with evidence.
    fn new(
        superpoints: Superpoints,
        regions_of: Vec<Vec<(u32, f32)>>,
        table: &mut RegionTable,
        mask_points: &[Point],
    ) -> Self {
        let of_table = &*table;
        let mixture = |entries: Vec<(u32, f32)>| -> Vec<(u32, f32)> {
            let spread = |(region, weight): (u32, f32)| {
                of_table.masks_of(region as usize).map(move |(mask, share)| (mask, weight * share))
            };
            let mut masks = added_up(added_up(entries).into_iter().flat_map(spread).collect());
            masks.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
            masks.truncate(MIXTURE_MASKS);
            masks.sort_by_key(|(mask, _)| *mask);
            let total: f32 = masks.iter().map(|(_, share)| share).sum();
            masks.iter_mut().for_each(|(_, share)| *share /= total);
            masks
        };
        let mixtures: Vec<Vec<(u32, f32)>> = regions_of.into_par_iter().map(mixture).collect();
        let mut region = |mixture: &Vec<(u32, f32)>| {
            let mut sum = [0.0; AXES];
            mixture.iter().for_each(|(mask, share)| add(&mut sum, *share, &mask_points[*mask as usize]));
            let of_mixture = length(&sum);
            (of_mixture > MIN_MEAN_LENGTH).then(|| (table.append_mixture(mixture), of_mixture))
        };
        let regions = mixtures.iter().map(&mut region).collect();
        Self { of_gaussian: superpoints.of_gaussian, regions }
    }
}

#[inline(always)]
fn add(sum: &mut Point, weight: f32, point: &Point) {
    sum.iter_mut().zip(point).for_each(|(s, p)| *s += weight * p);
}

fn length(point: &Point) -> f32 {
    dot(point, point).sqrt()
}

fn make_unit(point: &mut Point) {
    let length = length(point);
    if length > 0.0 {
        point.iter_mut().for_each(|c| *c /= length);
    }
}

#[cfg(test)]
mod tests;
