//! Finds the objects of a scene, step by step.

use std::borrow::Cow;

use glam::DVec3;
use rayon::prelude::*;
use slag_common::frames::Aabb;
use slag_math::stats::trimmed_range;

use super::choice::{self, Sizes};
use super::members::Members;
use super::object::{NONE, Object, ObjectsReport, SceneObjects};
use super::scene::Scene;
use super::shown::Shown;
use super::tree::Tree;
use super::{affinity, near, vectors};
use crate::lift::ContributionError;
use crate::lift::photos::MaskOutline;
use crate::lift::superpoint::{SuperpointSettings, Superpoints};

/// Smaller objects are dropped, as the robot drops smaller clusters.
pub const MIN_GAUSSIANS: usize = 10;
/// Share of the means that an object's box leaves out on either side of each axis, as boxes of clusters do: floaters
/// would make the box as large as the room.
const TRIMMED: f64 = 0.02;

/// Finds the objects of a scene. Returns `None` if cancelled.
///
/// # Errors
/// [`ContributionError`].
pub fn find(scene: &Scene<'_>) -> Result<Option<SceneObjects>, ContributionError> {
    let Scene { table, gaussians, .. } = scene;
    let superpoints = match scene.superpoints {
        Some(superpoints) => Cow::Borrowed(superpoints),
        None => Cow::Owned(Superpoints::new(gaussians, None, &SuperpointSettings::default())),
    };
    let Some(shown) = Shown::gather(scene, &superpoints)? else { return Ok(None) };
    let pairs = affinity::of_pairs(&shown, &near::pairs(gaussians, &superpoints));
    if scene.is_cancelled() {
        return Ok(None);
    }
    let tree = Tree::new(superpoints.n, &pairs);
    drop(pairs);
    if scene.is_cancelled() {
        return Ok(None);
    }
    let mut n_of_mask = vec![0; table.n_masks()];
    shown.masks().for_each(|(_, of_mask)| n_of_mask[of_mask.mask as usize] += of_mask.n);
    let n_of_superpoint = superpoints.sizes();
    let sizes =
        Sizes { of_masks: &n_of_mask, of_superpoints: &n_of_superpoint, min_gaussians: MIN_GAUSSIANS as u32 };
    let object_of = choice::things(&tree, &shown, sizes);
    let object_of_mask = choice::things_of_masks(&object_of, &shown, &n_of_mask);
    let members = Members::new(scene, &superpoints, &shown, &object_of, &object_of_mask);
    let objects = describe(scene, &members, &scene.view_of_mask());
    let calibration = vectors::calibrate(&objects, scene.score_context, table.dim());
    let report = ObjectsReport {
        n_objects: objects.len(),
        n_gaussians: objects.iter().map(|object| object.n_gaussians as usize).sum(),
        n_masks: table.n_masks(),
        n_masks_of_objects: objects.iter().map(|object| object.n_masks as usize).sum(),
    };
    Ok(Some(SceneObjects { objects, object_of: members.object_of, calibration, report }))
}

fn describe(scene: &Scene<'_>, members: &Members, view_of_mask: &[u32]) -> Vec<Object> {
    let mut gaussians: Vec<Vec<u32>> = vec![Vec::new(); members.masks.len()];
    for (cell, of_cell) in scene.split.cells.iter().zip(&members.object_of) {
        for (gaussian, object) in cell.gaussians.iter().zip(of_cell).filter(|(_, object)| **object != NONE) {
            gaussians[*object as usize].push(*gaussian);
        }
    }
    let uncut_shares: Vec<f32> =
        scene.photos.iter().flat_map(|photo| &photo.outlines).map(MaskOutline::uncut_share).collect();
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
            let best = members.best_mask(masks, &uncut_shares);
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
    let mut bounds = Aabb { min: DVec3::ZERO, max: DVec3::ZERO };
    for axis in 0..3 {
        let mut values: Vec<f64> = means.iter().map(|mean| mean[axis]).collect();
        (bounds.min[axis], bounds.max[axis]) =
            trimmed_range(&mut values, TRIMMED).expect("an object has Gaussians");
    }
    let is_inside = |mean: &&DVec3| mean.cmpge(bounds.min).all() && mean.cmple(bounds.max).all();
    let inside: Vec<&DVec3> = means.iter().filter(is_inside).collect();
    let sum: DVec3 = inside.iter().copied().sum();
    let centre = if inside.is_empty() { bounds.centre() } else { sum / inside.len() as f64 };
    (centre, bounds)
}
