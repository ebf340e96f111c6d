//! `GET /v1/objects`, and what other replies say of things.

use std::borrow::Cow;

use glam::{DQuat, DVec3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::coverage::Coverage;
use crate::{FRAME, Geographic, UNITS};

pub const MAX_NAMES: usize = 3;

/// An object on board.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[schemars(rename = "Object")]
pub struct ObjectOnBoard {
    /// Its id: `o` and 16 hex digits.
    pub id: String,
    /// What it is called, best first; see the page's `named`.
    #[schemars(length(max = MAX_NAMES))]
    pub names: Vec<Name>,
    /// Frame of every position.
    #[schemars(extend("enum" = [FRAME]))]
    pub frame: Cow<'static, str>,
    /// Generation that they belong to.
    pub generation: u64,
    /// Mean of its Gaussians inside the box.
    #[schemars(with = "[f64; 3]")]
    pub position_in_world: DVec3,
    /// The same on the earth, if the scene is geo-referenced.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub geographic: Option<Geographic>,
    /// Smallest corner of its box.
    #[schemars(with = "[f64; 3]")]
    pub box_min_in_world: DVec3,
    /// Largest corner.
    #[schemars(with = "[f64; 3]")]
    pub box_max_in_world: DVec3,
    /// Its box along axes of its own; of the part on board.
    pub oriented_box: OrientedBox,
    /// Its Gaussians on board.
    pub n_gaussians: u64,
    /// Its Gaussians in the whole scene.
    pub n_gaussians_in_scene: u64,
    /// The photo that shows it best.
    pub evidence: Evidence,
}

/// A page of the objects on board.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ObjectPage {
    /// Name of the scene.
    pub scene: String,
    /// Its generation.
    pub generation: u64,
    /// Frame of every position: the scene's world frame.
    #[schemars(extend("enum" = [FRAME]))]
    pub frame: Cow<'static, str>,
    /// Unit of every position and length: `m`, or `world` if the scene is not metric.
    #[schemars(extend("enum" = UNITS))]
    pub unit: Cow<'static, str>,
    /// Whether the objects have names: not while the text model encodes the words (ask again in a second), nor if it
    /// is another than the scene's.
    pub named: bool,
    /// Objects that pass the filter, over all pages.
    pub n_objects: usize,
    /// `after` of the next page; null if there is none.
    pub next_after: Option<String>,
    #[serde(flatten)]
    pub coverage: Coverage,
    /// The objects, in the order asked for.
    pub objects: Vec<ObjectOnBoard>,
}

/// A name of a thing.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Name {
    /// The word.
    pub name: String,
    /// Its share among all names by their scores, 0 to 1: it orders names, and is no chance to be right. A thing may
    /// have several right names.
    pub confidence: f64,
}

/// The photo that shows an object best.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Evidence {
    /// Name of the view.
    pub photo: String,
    /// The object's box in the undistorted photo: x0, y0, x1, y1, the latter exclusive.
    pub box_px: [u32; 4],
    /// Whether `GET /v1/objects/{id}/thumbnail` has a small picture cut from it.
    #[serde(default)]
    pub has_thumbnail: bool,
}

/// Permitted orientations of a box.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Alignment {
    /// Upright: rotated about the world's z axis only, which points up.
    Gravity,
    /// Aligned with the points' principal axes.
    Principal,
}

/// A box along axes of its own.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct OrientedBox {
    /// Its centre.
    #[schemars(with = "[f64; 3]")]
    pub centre_in_world: DVec3,
    /// Its edges along its own axes; x is the longest (of the horizontal ones, if upright).
    #[schemars(with = "[f64; 3]")]
    pub size: DVec3,
    /// Unit quaternion x, y, z, w that rotates the box's axes into the world's.
    #[schemars(with = "[f64; 4]")]
    pub rotation_world_from_box: DQuat,
    /// The orientations permitted.
    pub alignment: Alignment,
}
