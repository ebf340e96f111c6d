//! `GET /v1/map`.

use std::borrow::Cow;

use glam::DVec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use slag_common::frames::{Aabb, GeoReference};

use crate::{FRAME, UNITS};

/// The area on board, its age, and what is missing.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[schemars(rename = "Map")]
pub struct MapStatus {
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
    /// Whether z points up.
    pub z_is_up: bool,
    /// Where the world frame lies on the earth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub geo_reference: Option<GeoReference>,
    /// When the generation was made, Unix seconds.
    pub created_unix_secs: u64,
    /// Seconds since then; 0 if the clock is behind.
    pub age_secs: u64,
    /// Until when it is known to be the newest, Unix seconds: when the store's timestamp expires.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub expires_unix_secs: Option<u64>,
    /// Whether it is past that.
    pub is_expired: bool,
    /// Centre of the area that was fetched.
    #[schemars(with = "[f64; 3]")]
    pub centre_in_world: DVec3,
    /// Its radius.
    pub radius: f64,
    /// Things on board.
    pub n_objects: usize,
    /// Gaussians on board.
    pub n_gaussians: u64,
    /// Cells on board.
    pub cells: Vec<MapCell>,
    /// Cells of the scene that are not on board: outside the area, or not fetched.
    pub missing: Vec<MissingCell>,
}

/// A cell on board.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MapCell {
    /// Its id.
    pub cell_id: u32,
    /// Smallest corner.
    #[schemars(with = "[f64; 3]")]
    pub box_min_in_world: DVec3,
    /// Largest corner.
    #[schemars(with = "[f64; 3]")]
    pub box_max_in_world: DVec3,
    /// Its Gaussians.
    pub n_gaussians: u32,
    /// The generation that it is of, which is older where the newest could not be fetched.
    pub generation: u64,
}

/// A cell that is not on board.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MissingCell {
    /// Its id.
    pub cell_id: u32,
    /// Smallest corner.
    #[schemars(with = "[f64; 3]")]
    pub box_min_in_world: DVec3,
    /// Largest corner.
    #[schemars(with = "[f64; 3]")]
    pub box_max_in_world: DVec3,
    /// Whether it lies within the area that was asked for, so that a fetch failed to bring it.
    pub is_wanted: bool,
}

impl MapCell {
    pub fn bounds(&self) -> Aabb {
        Aabb { min: self.box_min_in_world, max: self.box_max_in_world }
    }
}

impl MissingCell {
    pub fn bounds(&self) -> Aabb {
        Aabb { min: self.box_min_in_world, max: self.box_max_in_world }
    }
}
