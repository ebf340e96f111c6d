//! The objects of a scene.

use glam::DVec3;
use serde::{Deserialize, Serialize};
use slag_common::frames::Aabb;
use slag_common::manifest::Calibration;
use slag_common::objects::public_id;

use crate::lift::superpoint::NO_SUPERPOINT;
use crate::progress::FoundObject;

/// Marks a Gaussian without an object.
pub const NONE: u32 = NO_SUPERPOINT;

/// A thing that several views agree on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Object {
    /// First 8 bytes of the BLAKE3 hash of its Gaussians' indices in the input, ascending, u32 little-endian.
    pub id: u64,
    /// Its Gaussians, in all cells.
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
    /// Returns its row of an encode's report.
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
    /// In the order of their first superpoints.
    pub objects: Vec<Object>,
    /// `[cell][N of the cell]`: index of each Gaussian's object, or [`NONE`].
    pub object_of: Vec<Vec<u32>>,
    /// Mean and spread of the text bank's scores over the objects.
    pub calibration: Calibration,
    /// Counts for the summary.
    pub report: ObjectsReport,
}

/// Counts of objects and masks, for the summary.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ObjectsReport {
    pub n_objects: usize,
    pub n_gaussians: usize,
    pub n_masks: usize,
    /// Masks that show an object; others cover several things, or parts.
    pub n_masks_of_objects: usize,
    /// Longest side of the largest object's box, metres.
    pub largest_m: f64,
}
