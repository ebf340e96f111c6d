//! Optional refinements of the paper's weighted average. Each can be enabled separately.
//!
//! | file | field of [`Aggregation`] | effect |
//! |---|---|---|
//! | this | `truncation_power` | masks that the photo's edge cuts off count less |
//! | this | `min_view_share` | contributions of a view that hardly shows the Gaussian are dropped |
//! | `mixture` | `superpoint`, `coarse`, `object` | a Gaussian takes a share of its superpoint, then of a larger one, then of its object |
//! | `mixture` | `fill` | a Gaussian without evidence takes its superpoint's mean |
//!
//! The result is again sparse contributions over regions. Masks' weights go into the [`RegionTable`], and a superpoint
//! or object is one more region: a mixture of masks. So scores, shards and the published field need no special case,
//! and a Gaussian gets at most three more entries.
//!
//! [`PendingRefinement::begin`] takes the views' table and weighs its masks; objects are found from the pending
//! refinement; [`PendingRefinement::finish`] returns the table with the mixtures. Decisions are made in principal
//! coordinates of the mask vectors (`points`) and in one order: the result depends neither on threads nor on memory.

use std::ops::Range;

use mixture::{AXES, Mixtures, Point, Sums};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use slag_math::axes::principal_coordinates;

use super::contributions::ContributionError;
use super::index::PartContributions;
use super::passes::SceneContributions;
use super::photos::{MaskOutline, Photo};
use super::superpoint::{Graph, NO_SUPERPOINT, Sketches, SuperpointSettings, Superpoints};
use super::table::RegionTable;
use crate::masks::Mask;
use crate::memory::{self, MemoryPlan, Phase};

mod mixture;

/// Least base of a mask's weight: even a mask that is wholly cut off gives evidence.
const LEAST_MASK_WEIGHT: f32 = 0.01;

/// A scene's refinements, ready to be applied part by part.
#[derive(Debug, PartialEq)]
pub(crate) struct Refinement {
    settings: Aggregation,
    /// By view, ascending.
    first_regions: Vec<u32>,
    /// `[n_regions]`: summed weight of the region's masks.
    mask_counts: Vec<f32>,
    /// `[n_regions]`: the regions' vectors; empty if not needed.
    region_points: Vec<Point>,
    /// Of finer superpoints, larger ones, then objects.
    mixtures: Vec<Mixtures>,
}

/// A refinement with weighed masks and superpoints. Objects, made of superpoints, come next; then Gaussians share
/// evidence within both.
pub(crate) struct PendingRefinement {
    refinement: Refinement,
    table: RegionTable,
    /// `[n_masks]`: vectors in principal coordinates; empty if not needed.
    mask_points: Vec<Point>,
    /// Superpoints by scale with their weights, finer ones first.
    scales: Vec<(f32, Superpoints)>,
}

/// Weight of a filler relative to other masks: where one view outlines a thing, another without outline says little.
const FILLER_WEIGHT: f32 = 0.1;
/// Weight of a mask of a standing thing: it shows the thing alone, where others show parts or more.
const STANDING_WEIGHT: f32 = 2.0;

/// Weight of each mask: (1 - truncation)^power, by its kind.
fn mask_weights(photos: &[Photo], power: f32) -> Vec<f32> {
    let weight = |outline: &MaskOutline| {
        let of_kind = match outline.level as u8 {
            Mask::FILLER => FILLER_WEIGHT,
            Mask::STANDING => STANDING_WEIGHT,
            _ => 1.0,
        };
        of_kind * outline.uncut_share().max(LEAST_MASK_WEIGHT).powf(power)
    };
    photos.iter().flat_map(|photo| &photo.outlines).map(weight).collect()
}

/// Turns objects, `[cell][N of the cell]`, into a partition of the scene.
fn partition_of(scene: &SceneContributions<'_>, object_of: &[Vec<u32>]) -> Superpoints {
    let mut of_gaussian = vec![NO_SUPERPOINT; scene.gaussians.len()];
    for (cell, of_cell) in scene.split.cells.iter().zip(object_of) {
        for (gaussian, object) in cell.gaussians.iter().zip(of_cell) {
            of_gaussian[*gaussian as usize] = *object;
        }
    }
    let last = object_of.iter().flatten().filter(|object| **object != NO_SUPERPOINT).max();
    Superpoints { of_gaussian, n: last.map_or(0, |last| *last as usize + 1) }
}

impl PendingRefinement {
    /// Weighs masks and finds superpoints, in one pass over all contributions.
    pub fn begin(
        settings: Aggregation,
        scene: &SceneContributions<'_>,
        mut table: RegionTable,
    ) -> Result<Self, ContributionError> {
        if settings.truncation_power > 0.0 {
            table.set_mask_weights(&mask_weights(scene.photos, settings.truncation_power));
        }
        let refinement = Refinement {
            settings,
            first_regions: scene.index.views.iter().map(|view| view.first_region).collect(),
            mask_counts: table.mask_counts(0..table.len()),
            region_points: Vec::new(),
            mixtures: Vec::new(),
        };
        let mut pending = Self { refinement, table, mask_points: Vec::new(), scales: Vec::new() };
        // Where Gaussians share evidence, vectors are needed in principal coordinates.
        if settings.n_partitions() > 0 && !pending.table.is_empty() {
            let Self { refinement, table, mask_points, scales } = &mut pending;
            *mask_points = principal_coordinates(table.mask_vectors(), AXES).as_chunks().0.to_vec();
            refinement.region_points = mixture::points_of_regions(table, mask_points, 0..table.len());
            if settings.n_scales() > 0 {
                *scales = refinement.superpoints(scene, table)?;
            }
        }
        Ok(pending)
    }

    pub fn table(&self) -> &RegionTable {
        &self.table
    }

    /// The finer superpoints, if the settings ask for them.
    pub(crate) fn superpoints(&self) -> Option<&Superpoints> {
        let has_fine = self.refinement.settings.has_fine_superpoints();
        self.scales.first().filter(|_| has_fine).map(|(_, superpoints)| superpoints)
    }

    /// Adds mixtures of superpoints' and objects' masks to the table, in one pass over all contributions. `object_of`:
    /// `[cell][N of the cell]`, [`NO_SUPERPOINT`] for none; empty without objects.
    pub fn finish(
        self,
        scene: &SceneContributions<'_>,
        object_of: &[Vec<u32>],
    ) -> Result<(RegionTable, Refinement), ContributionError> {
        let Self { mut refinement, mut table, mask_points, mut scales } = self;
        if refinement.settings.object > 0.0 && !object_of.is_empty() {
            scales.push((refinement.settings.object, partition_of(scene, object_of)));
        }
        if !scales.is_empty() && !table.is_empty() {
            refinement.make_mixtures(scene, &mut table, &mask_points, scales)?;
        }
        Ok((table, refinement))
    }
}

impl Refinement {
    fn superpoints(
        &self,
        scene: &SceneContributions<'_>,
        table: &RegionTable,
    ) -> Result<Vec<(f32, Superpoints)>, ContributionError> {
        let mut sketches = vec![0; scene.gaussians.len() * AXES];
        let of_part = |mut contributions: PartContributions| {
            self.prune(&mut contributions);
            let of_part = mixture::sketches(&contributions, &self.region_points);
            (contributions.part, of_part)
        };
        scene.visit(table, of_part, |(part, of_part)| {
            for (gaussian, sketch) in part.gaussians(scene.split).iter().zip(of_part) {
                sketches[*gaussian as usize * AXES..][..AXES].copy_from_slice(&sketch);
            }
        })?;
        // The pass's parts are gone; unless given back, the graph's memory would come on top.
        memory::give_back();
        let sketches = Sketches { width: AXES, values: &sketches };
        let graph =
            Graph::new(scene.gaussians, scene.standing, Some(sketches), &SuperpointSettings::default());
        let Aggregation { superpoint, coarse, .. } = self.settings;
        let partition = |weight: f32, is_needed: bool, settings: SuperpointSettings| {
            is_needed.then(|| (weight, graph.superpoints(&settings)))
        };
        let (fine, larger) = rayon::join(
            || partition(superpoint, self.settings.has_fine_superpoints(), SuperpointSettings::default()),
            || partition(coarse, coarse > 0.0, SuperpointSettings::coarse()),
        );
        Ok(fine.into_iter().chain(larger).collect())
    }

    fn make_mixtures(
        &mut self,
        scene: &SceneContributions<'_>,
        table: &mut RegionTable,
        mask_points: &[Point],
        scales: Vec<(f32, Superpoints)>,
    ) -> Result<(), ContributionError> {
        let mut sums: Vec<Vec<Sums>> = scales.iter().map(|(_, of)| vec![Vec::new(); of.n]).collect();
        let of_part = |mut contributions: PartContributions| -> Vec<Vec<(usize, Sums)>> {
            self.prune(&mut contributions);
            let gaussians = contributions.part.gaussians(scene.split);
            scales.iter().map(|(_, of)| mixture::part_sums(&contributions, gaussians, of)).collect()
        };
        scene.visit(table, of_part, |of_part| {
            for (sums, of_part) in sums.iter_mut().zip(of_part) {
                of_part.into_iter().for_each(|(superpoint, entries)| sums[superpoint].extend(entries));
            }
        })?;
        for ((weight, superpoints), sums) in scales.into_iter().zip(sums) {
            self.mixtures.push(Mixtures::new(weight, superpoints, sums, table, mask_points)?);
        }
        // The next scale mixes rows that already have the earlier scales' entries.
        let of_mixtures =
            mixture::points_of_regions(table, mask_points, self.region_points.len()..table.len());
        self.region_points.extend(of_mixtures);
        Ok(())
    }

    /// Reserves lists over all Gaussians: the superpoints' graph, and each Gaussian's superpoints until the last cell.
    pub(crate) fn reserve(memory: &mut MemoryPlan, settings: &Aggregation, n_gaussians: usize) {
        let n_scales = settings.n_scales();
        if n_scales > 0 {
            let sketches_bytes = (n_gaussians * (AXES + size_of::<u32>())) as u64;
            let graph_bytes = Superpoints::working_bytes(n_gaussians, n_scales);
            memory.reserve(Phase::Superpoints, "superpoints of all Gaussians", sketches_bytes + graph_bytes);
        }
        let labels_bytes = |n_partitions: usize| (n_gaussians * n_partitions * size_of::<u32>()) as u64;
        memory.reserve(Phase::Objects, "the superpoints of each Gaussian", labels_bytes(n_scales));
        for phase in [Phase::Refine, Phase::Cells] {
            memory.reserve(phase, "the superpoints of each Gaussian", labels_bytes(settings.n_partitions()));
        }
    }

    /// Reserves what depends on the views: lists over all regions, and the superpoints' summed contributions.
    pub(crate) fn reserve_contributions(
        memory: &mut MemoryPlan,
        settings: &Aggregation,
        n_regions: usize,
        n_entries: u64,
    ) {
        if *settings != Aggregation::default() {
            let len_bytes = n_regions * (size_of::<Point>() + size_of::<f32>());
            memory.reserve(Phase::Always, "vectors of regions", len_bytes as u64);
        }
        let sums_bytes = mixture::sums_bytes(n_entries) * settings.n_partitions() as u64;
        memory.reserve(Phase::Refine, "sums of superpoints", sums_bytes);
    }

    /// `gaussians`: scene indices of the part's Gaussians.
    pub(crate) fn apply(&self, contributions: &mut PartContributions, gaussians: &[u32]) {
        self.prune(contributions);
        for mixtures in &self.mixtures {
            mixtures.apply(contributions, gaussians, &self.region_points, self.settings.fill);
        }
    }

    /// Drops entries of views where a Gaussian has less than the least share of its weight in its best view.
    fn prune(&self, contributions: &mut PartContributions) {
        let least = self.settings.min_view_share;
        if least <= 0.0 {
            return;
        }
        let kept_of = |k: usize| -> Vec<Range<usize>> {
            let views = by_view(contributions, contributions.entries_of(k), &self.first_regions);
            let best = views.iter().map(|view| view.weight).fold(0.0, f32::max);
            let seen = views.into_iter().filter(|view| view.weight >= least * best);
            seen.map(|view| view.entries).collect()
        };
        let n = contributions.total_weights.len();
        let kept: Vec<Vec<Range<usize>>> = (0..n).into_par_iter().with_min_len(CHUNK).map(kept_of).collect();
        let mut at = 0;
        for (k, kept) in kept.into_iter().enumerate() {
            let mut total = 0.0;
            for entry in kept.into_iter().flatten() {
                let (region, weight) = (contributions.regions[entry], contributions.weights[entry]);
                (contributions.regions[at], contributions.weights[at]) = (region, weight);
                total += f64::from(weight) * f64::from(self.mask_counts[region as usize]);
                at += 1;
            }
            contributions.starts[k + 1] = at as u64;
            contributions.total_weights[k] = total as f32;
        }
        contributions.regions.truncate(at);
        contributions.weights.truncate(at);
    }
}

/// How the contributions of all views become embeddings. The default is the paper's weighted average.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Aggregation {
    /// Drops views in which a Gaussian has less than this share of its weight in its best view, 0..=1.
    pub(crate) min_view_share: f32,
    /// Each mask counts (1 - truncation)^`truncation_power`. A mask's truncation is the share of its outline that
    /// the photo's edge cuts off.
    pub(crate) truncation_power: f32,
    /// Weight of the superpoint's mean, relative to the Gaussian's own.
    pub(crate) superpoint: f32,
    /// Weight of the larger superpoint's mean, relative to the result so far.
    pub coarse: f32,
    /// Weight of the mean of the Gaussian's object, relative to the result so far.
    pub object: f32,
    /// Whether Gaussians without evidence take their superpoint's mean.
    pub fill: bool,
}

impl Aggregation {
    /// The refinements that help on both trained and generated splats (docs/decisions.md). Larger shares of superpoints
    /// smooth small things away.
    pub(crate) const REFINED: Self = Self {
        min_view_share: 0.05,
        truncation_power: 2.0,
        superpoint: 1.5,
        coarse: 0.5,
        object: 0.25,
        fill: true,
    };

    pub(crate) fn has_fine_superpoints(&self) -> bool {
        self.superpoint > 0.0 || self.fill
    }

    /// Partitions within which Gaussians share evidence.
    pub(super) fn n_partitions(&self) -> usize {
        self.n_scales() + usize::from(self.object > 0.0)
    }

    pub(super) fn n_scales(&self) -> usize {
        usize::from(self.has_fine_superpoints()) + usize::from(self.coarse > 0.0)
    }
}

/// Least number of Gaussians per task.
const CHUNK: usize = 4096;

struct ViewEntries {
    entries: Range<usize>,
    weight: f32,
}

/// Splits a Gaussian's entries, ascending by region, by view. `first_regions`: of each view, ascending.
fn by_view(
    contributions: &PartContributions,
    entries: Range<usize>,
    first_regions: &[u32],
) -> Vec<ViewEntries> {
    let mut views: Vec<ViewEntries> = Vec::new();
    let mut end_region = 0;
    for entry in entries {
        let region = contributions.regions[entry];
        if views.is_empty() || region >= end_region {
            let next = first_regions.partition_point(|first| *first <= region);
            end_region = first_regions.get(next).copied().unwrap_or(u32::MAX);
            views.push(ViewEntries { entries: entry..entry, weight: 0.0 });
        }
        if let Some(view) = views.last_mut() {
            view.entries.end = entry + 1;
            view.weight += contributions.weights[entry];
        }
    }
    views
}

#[cfg(test)]
mod tests;
