//! Stage 5: masks of different views that cover the same Gaussians become objects.
//!
//! No model and no training: the sparse contributions that the lift keeps say which Gaussians each mask shows.
//!
//! | step | job |
//! |---|---|
//! | [`sightings`] | what a sample of the Gaussians shows in each view |
//! | [`consensus`] | masks that views agree to be one thing |
//! | [`members`] | each Gaussian's object, by the weight under its masks |
//! | [`vectors`] | the few vectors that stand for an object's masks |
//! | [`shards`] | what a cell's shards say of them |
//!
//! The contributions are read twice, a group of parts at a time as the lift does; what is kept is four bytes a Gaussian.

pub mod consensus;
pub mod members;
pub mod shards;
pub mod sightings;
pub mod vectors;

use std::sync::atomic::{AtomicBool, Ordering};

use glam::DVec3;
use rayon::prelude::*;
use serde::Serialize;
use slag_common::Gaussians;
use slag_common::frames::Aabb;
use slag_common::manifest::Calibration;

use crate::cells::CellSplit;
use crate::codebook::ScoreMetricContext;
use crate::lift::photos::{MaskOutline, Photo};
use crate::lift::{ContributionError, ContributionIndex, RegionTable};
use consensus::Masks;
use members::Members;

/// No cluster, no object.
pub const NONE: u32 = u32::MAX;

/// Smaller objects are dropped, as the robot drops smaller clusters.
pub const MIN_GAUSSIANS: usize = 10;
/// Share of the means that lie outside an object's box on either side of each axis, as of clusters' boxes: floaters
/// would make it as large as the room.
const TRIMMED: f64 = 0.02;

/// A thing that several views agree on.
#[derive(Clone, Debug, PartialEq)]
pub struct Object {
    /// First 8 bytes of the BLAKE3 hash of its Gaussians' indices in the input, ascending, u32 little-endian.
    pub id: u64,
    /// Its Gaussians, in all cells.
    pub n_gaussians: u32,
    /// Masks that show it.
    pub n_masks: u32,
    /// Mean of its Gaussians inside the box.
    pub position_in_world: DVec3,
    /// From the 2nd to the 98th percentile of its means along each axis.
    pub box_in_world: Aabb,
    /// `[n][dim]`, unit: the mean of its masks' vectors, then some of these that stand for the others.
    pub vectors: Vec<f32>,
    /// The photo that shows it best: name of the view.
    pub photo: String,
    /// Box of its mask there, pixels of the photo free of distortion: x0, y0, x1, y1, the latter exclusive.
    pub photo_box_px: [u32; 4],
}

/// The objects of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneObjects {
    /// In the order of their first masks.
    pub objects: Vec<Object>,
    /// `[cell][N of the cell]`: index of each Gaussian's object, or [`NONE`].
    pub object_of: Vec<Vec<u32>>,
    /// How a bank of texts scores over the objects.
    pub calibration: Calibration,
    /// What was found.
    pub report: ObjectsReport,
}

/// What was found, in numbers.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ObjectsReport {
    /// Objects.
    pub n_objects: usize,
    /// Gaussians that belong to one.
    pub n_gaussians: usize,
    /// Every n-th Gaussian of a cell was looked at to find them.
    pub sample_step: usize,
    /// Masks.
    pub n_masks: usize,
    /// Masks that belong to an object.
    pub n_masks_of_objects: usize,
    /// Masks that cover several things.
    pub n_masks_set_aside: usize,
}

/// What objects are found in.
pub struct Scene<'a> {
    /// The contributions of all views.
    pub index: &'a ContributionIndex,
    /// Their regions.
    pub table: &'a RegionTable,
    /// The Gaussians.
    pub gaussians: &'a Gaussians,
    /// Their cells.
    pub split: &'a CellSplit,
    /// Each view's masks, in the order of the contributions.
    pub photos: &'a [Photo],
    /// Texts that scores are calibrated by.
    pub score_context: &'a ScoreMetricContext,
    /// Bytes there are for the contributions of a group of parts.
    pub group_bytes: u64,
    /// Set when the user asks to stop.
    pub cancel: &'a AtomicBool,
}

impl Scene<'_> {
    fn is_cancelled(&self) -> bool {
        self.cancel.load(Ordering::Relaxed)
    }
}

/// Finds the objects of a scene. Returns `None` if it is cancelled.
///
/// # Errors
/// [`ContributionError`].
pub fn find(scene: &Scene<'_>) -> Result<Option<SceneObjects>, ContributionError> {
    let Scene { index, table, split, .. } = scene;
    let n_gaussians: usize = split.cells.iter().map(|cell| cell.gaussians.len()).sum();
    let sample_step = sightings::sample_step(n_gaussians);
    let view_of_mask = repeat_each(index.n_masks_of_view());
    let Some(sightings) = sightings::gather(scene, sample_step)? else { return Ok(None) };
    let clusters = consensus::cluster_masks(
        &sightings,
        &Masks {
            of_region: &|region| table.all_masks_of(region as usize),
            view_of_mask: &view_of_mask,
            n_views: scene.photos.len(),
        },
        scene.cancel,
    );
    drop(sightings);
    let Some(clusters) = clusters else { return Ok(None) };
    let Some(mut members) = Members::assign(scene, &clusters)? else { return Ok(None) };
    members.drop_small(MIN_GAUSSIANS);
    let objects = describe(scene, &members, &view_of_mask);
    let calibration = vectors::calibrate(&objects, scene.score_context, table.dim());
    let report = ObjectsReport {
        n_objects: objects.len(),
        n_gaussians: objects.iter().map(|object| object.n_gaussians as usize).sum(),
        sample_step,
        n_masks: table.n_masks(),
        n_masks_of_objects: objects.iter().map(|object| object.n_masks as usize).sum(),
        n_masks_set_aside: clusters.n_set_aside,
    };
    Ok(Some(SceneObjects { objects, object_of: members.object_of, calibration, report }))
}

/// Returns each index as often as its count says.
fn repeat_each(counts: impl Iterator<Item = usize>) -> Vec<u32> {
    counts.zip(0u32..).flat_map(|(n, i)| std::iter::repeat_n(i, n)).collect()
}

fn describe(scene: &Scene<'_>, members: &Members, view_of_mask: &[u32]) -> Vec<Object> {
    let mut gaussians: Vec<Vec<u32>> = vec![Vec::new(); members.masks.len()];
    for (cell, of_cell) in scene.split.cells.iter().zip(&members.object_of) {
        for (gaussian, object) in cell.gaussians.iter().zip(of_cell).filter(|(_, object)| **object != NONE) {
            gaussians[*object as usize].push(*gaussian);
        }
    }
    let wholeness: Vec<f32> =
        scene.photos.iter().flat_map(|photo| &photo.outlines).map(MaskOutline::wholeness).collect();
    let mut first_mask_of_view = Vec::with_capacity(scene.photos.len());
    let mut n_masks = 0;
    for n in scene.index.n_masks_of_view() {
        first_mask_of_view.push(n_masks);
        n_masks += n as u32;
    }
    let of_masks = gaussians.into_par_iter().zip(&members.masks);
    of_masks
        .map(|(mut gaussians, masks)| {
            gaussians.sort_unstable();
            let hash = blake3::hash(bytemuck::cast_slice(&gaussians));
            let id = hash.as_bytes()[..8].iter().rev().fold(0, |id, byte| id << 8 | u64::from(*byte));
            let means: Vec<DVec3> =
                gaussians.iter().map(|i| scene.gaussians.means_in_world[*i as usize]).collect();
            let (position_in_world, box_in_world) = trimmed_box(&means);
            let best = members.best_mask(masks, &wholeness);
            let view = view_of_mask[best as usize] as usize;
            let photo = &scene.photos[view];
            Object {
                id,
                n_gaussians: gaussians.len() as u32,
                n_masks: masks.len() as u32,
                position_in_world,
                box_in_world,
                vectors: vectors::choose(masks, &members.mask_weights, scene.table),
                photo: photo.name.clone(),
                photo_box_px: photo.outlines[(best - first_mask_of_view[view]) as usize].box_px,
            }
        })
        .collect()
}

/// Returns the box without the outermost means, and the mean of those inside.
fn trimmed_box(means: &[DVec3]) -> (DVec3, Aabb) {
    let last = means.len() - 1;
    let cut = (TRIMMED * last as f64) as usize;
    let mut bounds = Aabb { min: DVec3::ZERO, max: DVec3::ZERO };
    for axis in 0..3 {
        let mut values: Vec<f64> = means.iter().map(|mean| mean[axis]).collect();
        values.sort_unstable_by(f64::total_cmp);
        (bounds.min[axis], bounds.max[axis]) = (values[cut], values[last - cut]);
    }
    let is_inside = |mean: &&DVec3| mean.cmpge(bounds.min).all() && mean.cmple(bounds.max).all();
    let inside: Vec<&DVec3> = means.iter().filter(is_inside).collect();
    let sum: DVec3 = inside.iter().copied().sum();
    let centre = if inside.is_empty() { bounds.centre() } else { sum / inside.len() as f64 };
    (centre, bounds)
}

#[cfg(test)]
mod tests;
