//! Stage 5: superpoints that the masks of most views show together become objects.
//!
//! No model and no training are needed: the contributions tell which Gaussians each mask shows.
//!
//! The contributions are needed once, part by part; the result takes four bytes a Gaussian.

mod choice;
mod find;
pub(crate) mod shards;
mod sightings;
mod tree;

use glam::DVec3;
use serde::{Deserialize, Serialize};
use slag_common::frames::Aabb;
use slag_common::manifest::Calibration;
use slag_common::objects::{object_score, public_id};
use slag_math::dot;

use crate::codebook::ScoreMetricContext;
use crate::lift::RegionTable;
use crate::lift::superpoint::{NO_SUPERPOINT, Superpoints};
use crate::memory::{MemoryPlan, Phase};
use crate::progress::FoundObject;

pub(crate) use find::find;
pub(crate) use shards::cut as cut_thumbnails;
pub(crate) use sightings::reserve as reserve_contributions;

/// Reserves the search for objects, and each Gaussian's object. `has_superpoints`: they are given.
pub(crate) fn reserve(memory: &mut MemoryPlan, n_gaussians: usize, has_superpoints: bool) {
    let labels_bytes = (n_gaussians * size_of::<u32>()) as u64;
    memory.reserve(Phase::Always, "the object of each Gaussian", labels_bytes);
    tree::reserve(memory, n_gaussians);
    if !has_superpoints {
        let len_bytes = Superpoints::working_bytes(n_gaussians, 1);
        memory.reserve(Phase::Objects, "superpoints of all Gaussians", len_bytes + labels_bytes);
    }
}

/// Marks a Gaussian without an object.
pub const NONE: u32 = NO_SUPERPOINT;

/// A thing that several views agree on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Object {
    /// First 8 bytes of the BLAKE3 hash of its Gaussians' indices in the input, ascending, u32 little-endian.
    pub id: u64,
    pub n_gaussians: u32,
    pub n_masks: u32,
    /// Mean of its Gaussians inside the box.
    pub position_in_world: DVec3,
    /// From the 2nd to the 98th percentile of its means along each axis.
    pub box_in_world: Aabb,
    /// `[n][dim]`, unit: the mean of its masks' vectors, then the medoids of these.
    #[serde(skip)]
    pub vectors: Vec<f32>,
    /// Name of the view that shows it best.
    pub photo: String,
    /// Box of its mask there, pixels of the undistorted photo: x0, y0, x1, y1, the last two exclusive.
    pub photo_box_px: [u32; 4],
}

impl Object {
    /// Row of an encode's report.
    pub fn found(&self) -> FoundObject {
        FoundObject {
            id: public_id(self.id),
            position_m: self.position_in_world,
            bounds: self.box_in_world,
            n_gaussians: self.n_gaussians,
            n_masks: self.n_masks,
            photo: self.photo.clone(),
        }
    }
}

#[derive(Clone, Debug, PartialEq)]
pub struct SceneObjects {
    /// Ordered by their first superpoints.
    pub objects: Vec<Object>,
    /// `[cell][N of the cell]`: index of the object, or [`NONE`].
    pub object_of: Vec<Vec<u32>>,
    /// `[n]`: JPEG files, empty for none; an empty list if not asked for.
    pub thumbnails: Vec<Vec<u8>>,
    /// Of the text bank's scores over the objects.
    pub calibration: Calibration,
    pub report: ObjectsReport,
}

#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ObjectsReport {
    pub n_objects: usize,
    pub n_gaussians: usize,
    pub n_masks: usize,
    /// Masks that show an object; others cover several things, or parts.
    pub n_masks_of_objects: usize,
    pub largest_m: f64,
}

/// Most medoids beside the mean: one for each side of an object.
pub(super) const MAX_MEDOIDS: usize = 4;
/// Most masks considered, heaviest first: more hardly change the medoids, and time grows with the square.
const MAX_MASKS: usize = 256;

/// Returns `[n][dim]`: the direction of the masks' weighted mean, then medoids. Each medoid in turn is the mask that
/// most raises the weighted mean of all masks' cosines with their nearest medoid.
pub(super) fn choose_vectors(masks: &[u32], weights: &[f64], table: &RegionTable) -> Vec<f32> {
    let dim = table.dim();
    let vector = |mask: u32| table.mask_vectors().get(mask as usize);
    let mut masks = masks.to_vec();
    let weight = |mask: u32| weights[mask as usize];
    masks.sort_by(|a, b| weight(*b).total_cmp(&weight(*a)).then(a.cmp(b)));
    masks.truncate(MAX_MASKS);
    let mut mean = vec![0.0f64; dim];
    for mask in &masks {
        let scale = weight(*mask);
        mean.iter_mut().zip(vector(*mask)).for_each(|(m, v)| *m += scale * f64::from(*v));
    }
    let length = mean.iter().map(|m| m * m).sum::<f64>().sqrt();
    let mut chosen: Vec<f32> = match length > 0.0 {
        true => mean.iter().map(|m| (m / length) as f32).collect(),
        // Vectors that cancel have no mean direction: the heaviest replaces it.
        false => vector(masks[0]).to_vec(),
    };
    let n = masks.len();
    let cosines: Vec<f32> =
        masks.iter().flat_map(|a| masks.iter().map(|b| dot(vector(*a), vector(*b)))).collect();
    let mut nearest = vec![-1.0f32; n];
    let mut taken = vec![false; n];
    for _ in 0..MAX_MEDOIDS.min(n) {
        let gain = |candidate: usize| -> f64 {
            let of_candidate = cosines[candidate * n..][..n].iter().zip(&nearest).zip(&masks);
            of_candidate
                .map(|((cosine, nearest), mask)| weight(*mask) * f64::from(cosine.max(*nearest)))
                .sum()
        };
        let gains = (0..n).filter(|i| !taken[*i]).map(|i| (i, gain(i)));
        let Some((best, _)) = gains.reduce(|a, b| if b.1 > a.1 { b } else { a }) else { break };
        taken[best] = true;
        nearest.iter_mut().zip(&cosines[best * n..]).for_each(|(nearest, c)| *nearest = nearest.max(*c));
        chosen.extend(vector(masks[best]));
    }
    chosen
}

/// Mean and spread of the text bank's scores over objects, as cells have them over Gaussians.
pub(super) fn calibrate(objects: &[Object], score_context: &ScoreMetricContext, dim: usize) -> Calibration {
    let (mut sum, mut squares, mut n) = (0.0, 0.0, 0.0f64);
    for object in objects {
        for text in score_context.bank.vectors.chunks_exact(dim) {
            let cosines: Vec<f32> = object.vectors.chunks_exact(dim).map(|v| dot(v, text)).collect();
            let score = f64::from(object_score(&cosines));
            (sum, squares, n) = (sum + score, squares + score * score, n + 1.0);
        }
    }
    let mean = sum / n.max(1.0);
    let variance = (squares / n.max(1.0) - mean * mean).max(0.0);
    Calibration { score_mean: mean as f32, score_spread: variance.sqrt() as f32 }
}

#[cfg(test)]
mod tests;
