//! `GET /v1/view`: what there is to draw.

use glam::{DVec3, Vec3};
use serde::Serialize;
use slag_common::frames::Aabb;

/// The scene as the page first sees it. Lengths are in world units, metres in a metric scene.
#[derive(Clone, Debug, Serialize)]
pub struct Description {
    /// The program that answers.
    pub program: &'static str,
    /// Name of the scene.
    pub scene: String,
    /// Its generation; cells and scores are of one.
    pub generation: u64,
    /// Gaussians of all cells that can be drawn.
    pub n_gaussians: u64,
    /// Unit vector upward.
    pub up: Vec3,
    /// Whether a world unit is a metre.
    pub metric: bool,
    /// Whether the world is east, north and up of a place on the earth.
    pub geographic: bool,
    /// Whether the scene can be asked.
    pub can_ask: bool,
    /// The cells, by id.
    pub cells: Vec<Cell>,
    /// The photos whose poses are known.
    pub views: Vec<Photo>,
    /// What the robot fetched.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fetched: Option<Fetched>,
    /// Where the robot is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub position_m: Option<DVec3>,
}

/// A cell.
#[derive(Clone, Debug, Serialize)]
pub struct Cell {
    /// Its id.
    pub cell: u32,
    /// Its Gaussians; 0 if it is missing.
    pub n_gaussians: u32,
    /// Whether it can be drawn.
    pub state: CellState,
    /// The generation that it is of.
    pub generation: u64,
    /// The box around its Gaussians.
    pub box_m: Corners,
}

/// Whether a cell can be drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum CellState {
    /// Yes.
    OnBoard,
    /// Yes, from an earlier generation.
    Stale,
    /// No.
    Missing,
}

/// The corners of a box.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Corners {
    /// Smallest.
    pub min: DVec3,
    /// Largest.
    pub max: DVec3,
}

impl From<Aabb> for Corners {
    fn from(Aabb { min, max }: Aabb) -> Self {
        Self { min, max }
    }
}

/// A photo's name and pose.
#[derive(Clone, Debug, Serialize)]
pub struct Photo {
    /// Its name.
    pub name: String,
    /// Where it was taken.
    pub position_m: DVec3,
    /// World from camera (x right, y down, z forward).
    pub rotation_xyzw: [f32; 4],
    /// Its size and focal length, pixels.
    pub width_px: u32,
    /// See `width_px`.
    pub height_px: u32,
    /// See `width_px`.
    pub focal_px: f32,
    /// Whether the program has the picture itself.
    pub has_picture: bool,
}

/// The area that a robot fetched.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Fetched {
    /// Its middle.
    pub centre_m: DVec3,
    /// Its radius.
    pub radius_m: f64,
}
