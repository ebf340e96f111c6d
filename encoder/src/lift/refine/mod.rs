//! Optional refinements of the paper's weighted average. Each can be enabled separately.
//!
//! | file | field of [`Aggregation`] | effect |
//! |---|---|---|
//! | `mod` | `truncation_power` | masks that the photo's edge cuts off count less |
//! | `prune` | `min_view_share` | contributions of a view that hardly shows the Gaussian are dropped |
//! | `mixture` | `superpoint`, `coarse`, `object` | a Gaussian takes a share of its superpoint, then of a larger one, then of its object |
//! | `mixture` | `fill` | a Gaussian without evidence takes its superpoint's mean |
//!
//! The result is again sparse contributions over regions. Weights of masks go into the [`RegionTable`], and a
//! superpoint or object is one more region of it: a mixture of masks. So scores, shards and the published field
//! need no special case, and a Gaussian gets at most three more entries.
//!
//! The table belongs to the step at work: [`PendingRefinement::begin`] takes the views' table and weighs its
//! masks; objects are found from the pending refinement; [`PendingRefinement::finish`] returns the table with the
//! mixtures.
//!
//! All decisions are made in principal coordinates of the mask vectors (`points`) and in one order: the result
//! depends neither on threads nor on the memory budget.

mod mixture;
mod prune;
mod settings;

use slag_math::axes::principal_coordinates;

use super::contributions::ContributionError;
use super::index::PartContributions;
use super::passes::SceneContributions;
use super::photos::{MaskOutline, Photo};
use super::superpoint::{Graph, NO_SUPERPOINT, Sketches, SuperpointSettings, Superpoints};
use super::table::RegionTable;
use crate::masks::Mask;
use crate::memory::{self, MemoryPlan, Phase};
use mixture::{AXES, Mixtures, PartSums, Point, SuperpointSums};
pub use settings::Aggregation;

/// Least base of a mask's weight: a mask that is wholly cut off still gives its Gaussians evidence.
const LEAST_MASK_WEIGHT: f32 = 0.01;

/// The refinements of a scene, ready to be applied part by part.
#[derive(Debug, PartialEq)]
pub(crate) struct Refinement {
    settings: Aggregation,
    /// Of each view, ascending.
    first_regions: Vec<u32>,
    /// `[n_regions]`: summed weight of each region's masks.
    mask_counts: Vec<f32>,
    /// `[n_regions]`: each region's vector; empty where none is needed.
    region_points: Vec<Point>,
    /// Of the finer superpoints, then of the larger ones, then of the objects.
    mixtures: Vec<Mixtures>,
}

/// A refinement of which masks are weighed and superpoints found. Objects, made of superpoints, come next; then
/// Gaussians share evidence within both.
pub(crate) struct PendingRefinement {
    refinement: Refinement,
    table: RegionTable,
    /// `[n_masks]`: each mask's vector in principal coordinates; empty where none is needed.
    mask_points: Vec<Point>,
    /// The superpoints of each scale with their weights, the finer ones first.
    scales: Vec<(f32, Superpoints)>,
}

/// Weight of a filler beside other masks: where a view outlines a thing, another that does not says little.
const FILLER_WEIGHT: f32 = 0.1;
/// Weight of a mask of what stands on the ground: it shows a thing alone, where others show its parts or more.
const STANDING_WEIGHT: f32 = 2.0;

/// Returns the weight of each mask of some photos: (1 - truncation)^power, by its kind.
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

/// Returns objects, `[cell][N of the cell]`, as a partition of the scene.
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
    /// Decides the weights of masks and finds superpoints, in one pass over all contributions.
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
            first_regions: scene.index.first_regions(),
            mask_counts: table.mask_counts(0..table.len()),
            region_points: Vec::new(),
            mixtures: Vec::new(),
        };
        let mut pending = Self { refinement, table, mask_points: Vec::new(), scales: Vec::new() };
        if settings.needs_mixtures() && !pending.table.is_empty() {
            let Self { refinement, table, mask_points, scales } = &mut pending;
            *mask_points = principal_coordinates(table.mask_vectors(), AXES).as_chunks().0.to_vec();
            refinement.region_points = mixture::points_of_regions(table, mask_points, 0..table.len());
            if settings.needs_superpoints() {
                *scales = refinement.superpoints(scene, table)?;
            }
        }
        Ok(pending)
    }

    /// Returns the regions of all views, their masks weighed.
    pub fn table(&self) -> &RegionTable {
        &self.table
    }

    /// Returns the finer superpoints, if the settings ask for them.
    pub(crate) fn superpoints(&self) -> Option<&Superpoints> {
        let has_fine = self.refinement.settings.has_fine_superpoints();
        self.scales.first().filter(|_| has_fine).map(|(_, superpoints)| superpoints)
    }

    /// Adds mixtures of the masks of superpoints and objects to the table, in one pass over all contributions.
    ///
    /// `object_of`: `[cell][N of the cell]`: the object of each Gaussian, [`NO_SUPERPOINT`] where it has none;
    /// empty without objects.
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
    /// Returns the superpoints of each scale with their weights.
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
        // The parts of the pass are gone; without this the graph would come on top of them.
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

    /// Appends the mixtures of superpoints and objects to the table.
    fn make_mixtures(
        &mut self,
        scene: &SceneContributions<'_>,
        table: &mut RegionTable,
        mask_points: &[Point],
        scales: Vec<(f32, Superpoints)>,
    ) -> Result<(), ContributionError> {
        let mut sums: Vec<SuperpointSums> = scales.iter().map(|(_, of)| SuperpointSums::new(of.n)).collect();
        let of_part = |mut contributions: PartContributions| -> Vec<PartSums> {
            self.prune(&mut contributions);
            let gaussians = contributions.part.gaussians(scene.split);
            scales.iter().map(|(_, of)| PartSums::new(&contributions, gaussians, of)).collect()
        };
        scene.visit(table, of_part, |of_part| {
            sums.iter_mut().zip(of_part).for_each(|(sums, of_part)| sums.add(of_part));
        })?;
        for ((weight, superpoints), sums) in scales.into_iter().zip(sums) {
            self.mixtures.push(Mixtures::new(weight, superpoints, sums, table, mask_points)?);
        }
        // The next scale is mixed with rows that hold entries of those before it.
        let of_mixtures =
            mixture::points_of_regions(table, mask_points, self.region_points.len()..table.len());
        self.region_points.extend(of_mixtures);
        Ok(())
    }

    /// Reserves the lists over all Gaussians: the superpoints' graph, and each Gaussian's superpoints until the
    /// last cell.
    pub(crate) fn reserve(memory: &mut MemoryPlan, settings: &Aggregation, n_gaussians: usize) {
        let n_scales = settings.n_scales();
        if settings.needs_superpoints() {
            let sketches_bytes = (n_gaussians * (AXES + size_of::<u32>())) as u64;
            let graph_bytes =
                Superpoints::working_bytes(n_gaussians, n_scales, &SuperpointSettings::default());
            memory.reserve(Phase::Superpoints, "superpoints of all Gaussians", sketches_bytes + graph_bytes);
        }
        let labels_bytes = |n_partitions: usize| (n_gaussians * n_partitions * size_of::<u32>()) as u64;
        memory.reserve(Phase::Objects, "the superpoints of each Gaussian", labels_bytes(n_scales));
        for phase in [Phase::Refine, Phase::Cells] {
            memory.reserve(phase, "the superpoints of each Gaussian", labels_bytes(settings.n_partitions()));
        }
    }

    /// Reserves what depends on the views: the lists over all regions, and the summed contributions of
    /// superpoints.
    pub(crate) fn reserve_contributions(
        memory: &mut MemoryPlan,
        settings: &Aggregation,
        n_regions: usize,
        n_entries: u64,
    ) {
        if *settings != Aggregation::PLAIN {
            let len_bytes = n_regions * (size_of::<Point>() + size_of::<f32>());
            memory.reserve(Phase::Always, "vectors of regions", len_bytes as u64);
        }
        let sums_bytes = SuperpointSums::len_bytes(n_entries) * settings.n_partitions() as u64;
        memory.reserve(Phase::Refine, "sums of superpoints", sums_bytes);
    }

    /// Refines the contributions of a part. `gaussians`: scene indices of its Gaussians.
    pub(crate) fn apply(&self, contributions: &mut PartContributions, gaussians: &[u32]) {
        self.prune(contributions);
        for mixtures in &self.mixtures {
            mixtures.apply(contributions, gaussians, &self.region_points, self.settings.fill);
        }
    }

    fn prune(&self, contributions: &mut PartContributions) {
        prune::prune(contributions, self.settings.min_view_share, &self.first_regions, &self.mask_counts);
    }
}

#[cfg(test)]
mod tests;
