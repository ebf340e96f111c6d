//! Finds the objects of a scene, step by step.

use std::borrow::Cow;

use glam::DVec3;
use rayon::prelude::*;
use slag_common::frames::Aabb;
use slag_math::stats::trimmed_range;

use super::choice::{self, Sizes};
use super::sightings::Sightings;
use super::tree::Tree;
use super::{NONE, Object, ObjectsReport, SceneObjects, tree};
use crate::codebook::ScoreMetricContext;
use crate::lift::photos::MaskOutline;
use crate::lift::superpoint::{SuperpointSettings, Superpoints};
use crate::lift::{ContributionError, RegionTable, SceneContributions};
use crate::masks::Mask;

/// Smaller objects are dropped, as robots drop smaller clusters.
const MIN_GAUSSIANS: u32 = 10;
/// Share of the means outside an object's box on either side of each axis, as for clusters: floaters would make the box
/// as large as the room.
const TRIMMED: f64 = 0.02;

/// Finds a scene's objects while its refinement is pending, before anything is mixed. `superpoints`: if absent, they
/// are found from colour and shape.
pub(crate) fn find(
    scene: &SceneContributions<'_>,
    table: &RegionTable,
    superpoints: Option<&Superpoints>,
    score_context: &ScoreMetricContext,
) -> Result<SceneObjects, ContributionError> {
    let superpoints = match superpoints {
        Some(superpoints) => Cow::Borrowed(superpoints),
        None => Cow::Owned(Superpoints::new(scene.gaussians, scene.standing, &SuperpointSettings::default())),
    };
    let sightings = Sightings::gather(scene, table, &superpoints)?;
    let pairs = tree::evidence_of_pairs(&sightings, &tree::pairs(scene.gaussians, &superpoints));
    scene.check_cancelled()?;
    let tree = Tree::new(superpoints.n, &pairs);
    drop(pairs);
    scene.check_cancelled()?;
    let mut n_of_mask = vec![0; table.n_masks()];
    sightings.masks().for_each(|(_, of_mask)| n_of_mask[of_mask.mask as usize] += of_mask.n);
    let n_of_superpoint = superpoints.sizes();
    let outlines = || scene.photos.iter().flat_map(|photo| &photo.outlines);
    let uncut_shares: Vec<f32> = outlines().map(MaskOutline::uncut_share).collect();
    let is_standing: Vec<bool> = outlines().map(|of| of.level == u32::from(Mask::STANDING)).collect();
    let sizes = Sizes {
        of_masks: &n_of_mask,
        uncut_shares: &uncut_shares,
        is_standing: &is_standing,
        of_superpoints: &n_of_superpoint,
        footprints: &scene.standing.footprints(scene.gaussians, &superpoints.of_gaussian, superpoints.n),
        standing: scene.standing,
        min_gaussians: MIN_GAUSSIANS,
    };
    let object_of_superpoint = choice::objects(&tree, &sightings, sizes);
    let object_of_mask = choice::objects_of_masks(&object_of_superpoint, &sightings, &n_of_mask);
    let masks = Masks::new(scene, &sightings, &object_of_superpoint, &object_of_mask, uncut_shares);
    let of_gaussian = |gaussian: &u32| {
        let superpoint = superpoints.of_gaussian[*gaussian as usize];
        object_of_superpoint.get(superpoint as usize).copied().flatten().unwrap_or(NONE)
    };
    let cells = scene.split.cells.iter();
    let object_of: Vec<Vec<u32>> =
        cells.map(|cell| cell.gaussians.iter().map(of_gaussian).collect()).collect();
    let objects = describe(scene, table, &object_of, &masks);
    let calibration = super::calibrate(&objects, score_context, table.dim());
    let report = ObjectsReport {
        n_objects: objects.len(),
        n_gaussians: objects.iter().map(|object| object.n_gaussians as usize).sum(),
        n_masks: table.n_masks(),
        n_masks_of_objects: objects.iter().map(|object| object.n_masks as usize).sum(),
        largest_m: objects.iter().map(|object| object.box_in_world.size().max_element()).fold(0.0, f64::max),
    };
    Ok(SceneObjects { objects, object_of, thumbnails: Vec::new(), calibration, report })
}

struct Masks {
    of_object: Vec<Vec<u32>>,
    /// `[n_masks]`: blending weight under the mask, pixels.
    weights: Vec<f64>,
    /// `[n_masks]`: of that, the weight of its object's Gaussians.
    own_weights: Vec<f64>,
    /// `[n_masks]`: 1 - truncation.
    uncut_shares: Vec<f32>,
    /// `[n_masks]`: view, and index within it.
    places: Vec<(u32, u32)>,
}

impl Masks {
    fn new(
        scene: &SceneContributions<'_>,
        sightings: &Sightings,
        object_of_superpoint: &[Option<u32>],
        object_of_mask: &[Option<u32>],
        uncut_shares: Vec<f32>,
    ) -> Self {
        let n_objects = object_of_superpoint.iter().flatten().max().map_or(0, |last| *last as usize + 1);
        let places = (0u32..).zip(scene.index.views.iter().map(|view| view.n_masks));
        let mut masks = Self {
            of_object: vec![Vec::new(); n_objects],
            weights: vec![0.0; object_of_mask.len()],
            own_weights: vec![0.0; object_of_mask.len()],
            uncut_shares,
            places: places.flat_map(|(view, n)| (0..n as u32).map(move |mask| (view, mask))).collect(),
        };
        for (mask, object) in (0u32..).zip(object_of_mask) {
            object.iter().for_each(|object| masks.of_object[*object as usize].push(mask));
        }
        for (superpoint, of_mask) in sightings.masks() {
            let mask = of_mask.mask as usize;
            masks.weights[mask] += of_mask.weight;
            if object_of_mask[mask].is_some() && object_of_mask[mask] == object_of_superpoint[superpoint] {
                masks.own_weights[mask] += of_mask.weight;
            }
        }
        masks
    }

    /// Returns the mask with the largest product of the weight of the object's Gaussians, their share of the mask's
    /// weight, and 1 - truncation.
    fn best_of(&self, object: usize) -> usize {
        let merit = |mask: u32| {
            let (own, all) = (self.own_weights[mask as usize], self.weights[mask as usize]);
            if all > 0.0 { own * own / all * f64::from(self.uncut_shares[mask as usize]) } else { 0.0 }
        };
        let better = |a: u32, b: u32| if merit(b) > merit(a) { b } else { a };
        let best = self.of_object[object].iter().copied().reduce(better);
        best.expect("an object is chosen by its masks, and no other has them") as usize
    }
}

fn describe(
    scene: &SceneContributions<'_>,
    table: &RegionTable,
    object_of: &[Vec<u32>],
    masks: &Masks,
) -> Vec<Object> {
    let mut gaussians: Vec<Vec<u32>> = vec![Vec::new(); masks.of_object.len()];
    for (cell, of_cell) in scene.split.cells.iter().zip(object_of) {
        for (gaussian, object) in cell.gaussians.iter().zip(of_cell).filter(|(_, object)| **object != NONE) {
            gaussians[*object as usize].push(*gaussian);
        }
    }
    let object = |(number, mut gaussians): (usize, Vec<u32>)| {
        gaussians.sort_unstable();
        let hash = blake3::hash(bytemuck::cast_slice(&gaussians));
        let id = hash.as_bytes()[..8].iter().rev().fold(0, |id, byte| id << 8 | u64::from(*byte));
        let means: Vec<DVec3> =
            gaussians.iter().map(|i| scene.gaussians.means_in_world[*i as usize]).collect();
        let (position_in_world, box_in_world) = trimmed_box(&means);
        let (view, mask) = masks.places[masks.best_of(number)];
        let photo = &scene.photos[view as usize];
        let of_object = &masks.of_object[number];
        Object {
            id,
            n_gaussians: gaussians.len() as u32,
            n_masks: of_object.len() as u32,
            position_in_world,
            box_in_world,
            vectors: super::choose_vectors(of_object, &masks.weights, table),
            photo: photo.name.clone(),
            photo_box_px: photo.outlines[mask as usize].box_px,
        }
    };
    gaussians.into_par_iter().enumerate().map(object).collect()
}

/// Box without the outermost means, and the mean of those inside.
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
