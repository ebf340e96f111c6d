//! Optional refinements of the paper's weighted average. Each can be enabled separately; all are off by default.
//!
//! | file | field of [`Aggregation`] | effect |
//! |---|---|---|
//! | `truncation` | `truncation_power` | masks that the photo's edge cuts off count less |
//! | `prune` | `min_region_share`, `min_view_share` | contributions of a region that a Gaussian only touches, and of a view that hardly shows it, are dropped |
//! | `prune` | `min_weight_px` | a Gaussian that hardly shows anywhere has no evidence |
//! | `agreement` | `agreement` | masks that other views contradict count less |
//! | `equalise` | `equalisation` | views count more evenly, whatever their distance and slant |
//! | `median` | `median_steps` | views that disagree count less: steps towards the geometric median |
//! | `mixture` | `superpoint`, `coarse`, `object` | a Gaussian takes a share of its superpoint, then of a larger one, then of its object |
//! | `mixture` | `fill` | a Gaussian without evidence takes its superpoint's mean |
//!
//! The result is again sparse contributions over regions. Weights of masks go into the [`RegionTable`], and a superpoint or
//! object is one more region of it: a mixture of masks. So scores, shards and the published field need no special case, and a
//! Gaussian gets at most three more entries.
//!
//! All decisions are made in principal coordinates of the mask vectors (`points`) and in one order: the result depends
//! neither on threads nor on the memory budget.

mod agreement;
mod equalise;
mod median;
mod mixture;
mod points;
mod prune;
mod settings;
mod truncation;
mod views;

use std::sync::atomic::{AtomicBool, Ordering};

use rayon::prelude::*;
use slag_common::Gaussians;
use slag_math::axes::principal_coordinates;

use super::contributions::ContributionError;
use super::index::ContributionIndex;
use super::part::PartContributions;
use super::photos::Photo;
use super::superpoint::{Graph, NO_SUPERPOINT, Sketches, SuperpointSettings, Superpoints};
use super::table::RegionTable;
use crate::cells::CellSplit;
use crate::memory::{self, MemoryPlan, Phase};
use agreement::Votes;
use mixture::{Mixtures, PartSums, SuperpointSums};
use points::{AXES, Point};
pub use settings::Aggregation;
use views::FirstRegions;

/// The refinements of a scene, ready to be applied part by part.
#[derive(Debug, PartialEq)]
pub struct Refinement {
    settings: Aggregation,
    first_regions: FirstRegions,
    /// `[n_regions]`: summed weight of each region's masks.
    mask_counts: Vec<f32>,
    /// `[n_regions]`: each region's vector; empty where none is needed.
    region_points: Vec<Point>,
    /// Of the finer superpoints, then of the larger ones, then of the objects.
    mixtures: Vec<Mixtures>,
}

/// The Gaussians that contributions are refined for.
#[derive(Clone, Copy)]
pub struct Subject<'a> {
    /// The scene.
    pub scene: &'a Gaussians,
    /// Its cells.
    pub split: &'a CellSplit,
}

impl Subject<'_> {
    /// Returns objects, as [`Begun::finish`] takes them, as a partition of the scene.
    fn objects(&self, object_of: &[Vec<u32>]) -> Superpoints {
        let mut of_gaussian = vec![NO_SUPERPOINT; self.scene.len()];
        for (cell, of_cell) in self.split.cells.iter().zip(object_of) {
            for (gaussian, object) in cell.gaussians.iter().zip(of_cell) {
                of_gaussian[*gaussian as usize] = *object;
            }
        }
        let last = object_of.iter().flatten().filter(|object| **object != NO_SUPERPOINT).max();
        Superpoints { of_gaussian, n: last.map_or(0, |last| *last as usize + 1) }
    }
}

/// The passes over a scene's contributions that the refinements need.
#[derive(Clone, Copy)]
pub struct Passes<'a> {
    /// The contributions of all views.
    pub index: &'a ContributionIndex,
    /// Bytes for the contributions of a group of parts.
    pub group_bytes: u64,
    /// Set when the user asks to stop.
    pub cancel: &'a AtomicBool,
}

/// A refinement half done: masks are weighed and superpoints found. Objects come next, made of superpoints; then Gaussians
/// share evidence within both.
pub struct Begun {
    refinement: Refinement,
    /// `[n_masks]`: each mask's vector in principal coordinates; empty where none is needed.
    mask_points: Vec<Point>,
    /// The superpoints of each scale with their weights, the finer ones first.
    scales: Vec<(f32, Superpoints)>,
}

impl Passes<'_> {
    /// Calls `work` with each part, on all threads, and `merge` with the results, in the order of the parts; returns false
    /// if cancelled.
    fn visit<T: Send>(
        &self,
        table: &RegionTable,
        work: impl Fn(PartContributions) -> T + Sync,
        mut merge: impl FnMut(T),
    ) -> Result<bool, ContributionError> {
        for group in self.index.transposed_groups(table, self.group_bytes) {
            if self.cancel.load(Ordering::Relaxed) {
                return Ok(false);
            }
            let results: Vec<T> = group?.into_par_iter().map(&work).collect();
            results.into_iter().for_each(&mut merge);
        }
        Ok(true)
    }
}

impl Refinement {
    /// Decides the weights of masks and finds superpoints, in up to two passes over all contributions. Returns `None` if
    /// cancelled, and for the plain average.
    ///
    /// # Errors
    /// [`ContributionError`].
    pub fn begin(
        settings: Aggregation,
        passes: Passes<'_>,
        table: &mut RegionTable,
        subject: Subject<'_>,
        photos: &[Photo],
    ) -> Result<Option<Begun>, ContributionError> {
        if settings == Aggregation::PLAIN {
            return Ok(None);
        }
        let mask_weights = truncation::mask_weights(photos, settings.truncation_power);
        if settings.truncation_power > 0.0 {
            table.set_mask_weights(&mask_weights);
        }
        let refinement = Self {
            settings,
            first_regions: FirstRegions(passes.index.first_regions()),
            mask_counts: table.mask_counts(0..table.len()),
            region_points: Vec::new(),
            mixtures: Vec::new(),
        };
        let mut begun = Begun { refinement, mask_points: Vec::new(), scales: Vec::new() };
        if !settings.needs_points() || table.is_empty() {
            return Ok(Some(begun));
        }
        begun.mask_points = principal_coordinates(table.mask_vectors(), AXES).as_chunks().0.to_vec();
        let Begun { refinement, mask_points, scales } = &mut begun;
        refinement.region_points = points::of_regions(table, mask_points, 0..table.len());
        if settings.agreement > 0.0
            && !refinement.weigh_by_agreement(&passes, table, mask_points, mask_weights)?
        {
            return Ok(None);
        }
        if settings.needs_superpoints() {
            let Some(found) = refinement.superpoints(&passes, table, subject)? else { return Ok(None) };
            *scales = found;
        }
        Ok(Some(begun))
    }

    /// Multiplies the weights of masks by their agreement; returns false if cancelled.
    fn weigh_by_agreement(
        &mut self,
        passes: &Passes<'_>,
        table: &mut RegionTable,
        mask_points: &[Point],
        mut mask_weights: Vec<f32>,
    ) -> Result<bool, ContributionError> {
        let mut votes = Votes::new(table.len());
        let of_part = |mut contributions: PartContributions| {
            self.prune(&mut contributions);
            Votes::of_part(&contributions, &self.first_regions, &self.region_points)
        };
        let done = passes.visit(table, of_part, |of_part| votes.add(of_part))?;
        if done {
            let agreements = votes.agreements(table, mask_points, self.settings.agreement);
            mask_weights.iter_mut().zip(agreements).for_each(|(weight, agreement)| *weight *= agreement);
            table.set_mask_weights(&mask_weights);
            self.mask_counts = table.mask_counts(0..table.len());
            self.region_points = points::of_regions(table, mask_points, 0..table.len());
        }
        Ok(done)
    }

    /// Returns the superpoints of each scale with their weights; `None` if cancelled.
    fn superpoints(
        &self,
        passes: &Passes<'_>,
        table: &RegionTable,
        Subject { scene, split, .. }: Subject<'_>,
    ) -> Result<Option<Vec<(f32, Superpoints)>>, ContributionError> {
        let mut sketches = vec![0; scene.len() * AXES];
        let of_part = |mut contributions: PartContributions| {
            self.refine_own(&mut contributions);
            let of_part = mixture::sketches(&contributions, &self.region_points);
            (contributions.part, of_part)
        };
        let done = passes.visit(table, of_part, |(part, of_part)| {
            for (gaussian, sketch) in part.gaussians(split).iter().zip(of_part) {
                sketches[*gaussian as usize * AXES..][..AXES].copy_from_slice(&sketch);
            }
        })?;
        if !done {
            return Ok(None);
        }
        // The parts of the pass are gone; without this the graph would come on top of them.
        memory::give_back();
        let sketches = Sketches { width: AXES, values: &sketches };
        let graph = Graph::new(scene, Some(sketches), &SuperpointSettings::default());
        let Aggregation { superpoint, coarse, fill, .. } = self.settings;
        let partition = |weight: f32, is_needed: bool, settings: SuperpointSettings| {
            is_needed.then(|| (weight, graph.superpoints(&settings)))
        };
        let (fine, larger) = rayon::join(
            || partition(superpoint, superpoint > 0.0 || fill, SuperpointSettings::default()),
            || partition(coarse, coarse > 0.0, SuperpointSettings::coarse()),
        );
        Ok(Some(fine.into_iter().chain(larger).collect()))
    }

    /// Appends the mixtures of superpoints and objects to the table; returns false if cancelled.
    fn make_mixtures(
        &mut self,
        passes: &Passes<'_>,
        table: &mut RegionTable,
        mask_points: &[Point],
        (split, scales): (&CellSplit, Vec<(f32, Superpoints)>),
    ) -> Result<bool, ContributionError> {
        let mut sums: Vec<SuperpointSums> = scales.iter().map(|(_, of)| SuperpointSums::new(of.n)).collect();
        let of_part = |mut contributions: PartContributions| -> Vec<PartSums> {
            self.refine_own(&mut contributions);
            let gaussians = contributions.part.gaussians(split);
            scales.iter().map(|(_, of)| PartSums::new(&contributions, gaussians, of)).collect()
        };
        let done = passes.visit(table, of_part, |of_part| {
            sums.iter_mut().zip(of_part).for_each(|(sums, of_part)| sums.add(of_part));
        })?;
        if !done {
            return Ok(false);
        }
        for ((weight, superpoints), sums) in scales.into_iter().zip(sums) {
            self.mixtures.push(Mixtures::new(weight, superpoints, sums, table, mask_points));
        }
        // The next scale is mixed with rows that hold entries of those before it.
        let of_mixtures = points::of_regions(table, mask_points, self.region_points.len()..table.len());
        self.region_points.extend(of_mixtures);
        Ok(true)
    }

    /// Reserves the lists over all Gaussians: the superpoints' graph while masks are weighed, and each Gaussian's
    /// superpoints until the last cell.
    pub fn reserve(memory: &mut MemoryPlan, settings: &Aggregation, n_gaussians: usize) {
        let n_scales = usize::from(settings.has_fine_superpoints()) + usize::from(settings.coarse > 0.0);
        if settings.needs_superpoints() {
            let sketches_bytes = (n_gaussians * (AXES + size_of::<u32>())) as u64;
            let settings = SuperpointSettings::default();
            let graph_bytes = Superpoints::working_bytes(n_gaussians, n_scales, &settings);
            memory.reserve(Phase::Refine, "superpoints of all Gaussians", sketches_bytes + graph_bytes);
        }
        let scales_bytes = (n_gaussians * n_scales * size_of::<u32>()) as u64;
        memory.reserve(Phase::Objects, "the superpoints of each Gaussian", scales_bytes);
        let n_partitions = n_scales + usize::from(settings.object > 0.0);
        let labels_bytes = (n_gaussians * n_partitions * size_of::<u32>()) as u64;
        memory.reserve(Phase::Cells, "the superpoints of each Gaussian", labels_bytes);
    }

    /// Reserves the lists over all regions, whose number is known once the views are done.
    pub fn reserve_regions(memory: &mut MemoryPlan, settings: &Aggregation, n_regions: usize) {
        if *settings != Aggregation::PLAIN {
            let len_bytes = n_regions * (size_of::<Point>() + Votes::BYTES_PER_REGION);
            memory.reserve(Phase::Always, "agreement of masks", len_bytes as u64);
        }
    }

    /// Refines the contributions of a part. `gaussians`: scene indices of its Gaussians.
    pub fn apply(&self, contributions: &mut PartContributions, gaussians: &[u32]) {
        self.refine_own(contributions);
        for mixtures in &self.mixtures {
            mixtures.apply(contributions, gaussians, &self.region_points, self.settings.fill);
        }
    }

    /// Applies the refinements that need no other Gaussian.
    fn refine_own(&self, contributions: &mut PartContributions) {
        let Aggregation { equalisation, median_steps, .. } = self.settings;
        self.prune(contributions);
        if equalisation > 0.0 {
            self.first_regions.scale(contributions, |_, views| equalise::factors(views, equalisation));
        }
        if median_steps > 0 {
            self.first_regions.scale(contributions, |contributions, views| {
                median::factors(contributions, views, &self.region_points, median_steps)
            });
        }
    }

    fn prune(&self, contributions: &mut PartContributions) {
        prune::prune(contributions, &self.settings, &self.first_regions, &self.mask_counts);
    }
}

impl Begun {
    /// Returns the finer superpoints, if the settings ask for them.
    pub fn superpoints(&self) -> Option<&Superpoints> {
        let has_fine = self.refinement.settings.has_fine_superpoints();
        self.scales.first().filter(|_| has_fine).map(|(_, superpoints)| superpoints)
    }

    /// Adds mixtures of the masks of superpoints and objects to the table, in one pass over all contributions. Returns `None`
    /// if cancelled.
    ///
    /// `object_of`: `[cell][N of the cell]`: the object of each Gaussian, [`NO_SUPERPOINT`] where it has none; empty without
    /// objects.
    ///
    /// # Errors
    /// [`ContributionError`].
    pub fn finish(
        self,
        passes: Passes<'_>,
        table: &mut RegionTable,
        subject: Subject<'_>,
        object_of: &[Vec<u32>],
    ) -> Result<Option<Refinement>, ContributionError> {
        let Self { mut refinement, mask_points, mut scales } = self;
        if refinement.settings.object > 0.0 && !object_of.is_empty() {
            scales.push((refinement.settings.object, subject.objects(object_of)));
        }
        if scales.is_empty() || table.is_empty() {
            return Ok(Some(refinement));
        }
        let done = refinement.make_mixtures(&passes, table, &mask_points, (subject.split, scales))?;
        Ok(done.then_some(refinement))
    }
}

#[cfg(test)]
mod tests;
