//! What a plan consists of, and when a view can be trusted.

use std::fmt;

use glam::{DAffine3, DVec3};
use serde::Serialize;

use crate::memory::MemoryError;
use crate::raster::RasterError;

/// Largest shares in a view, 0 to 1.
const MAX_HOLES: f32 = 0.1;
const MAX_NEAR: f32 = 0.2;
const MAX_HAZE: f32 = 0.15;
const MAX_LARGE: f32 = 0.7;
/// An object need not fill the image.
const MAX_HOLES_OF_OBJECT: f32 = 0.97;

#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ViewpointSettings {
    pub n_views: usize,
    /// The upward direction, world; found from the Gaussians where absent.
    pub up: Option<DVec3>,
}

/// What the Gaussians show.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum SceneKind {
    /// Rooms: something is overhead.
    Indoor,
    /// Ground under an open sky.
    Outdoor,
    /// A thing with nothing around it.
    Object,
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Viewpoint {
    pub camera_from_world: DAffine3,
    pub verdict: Verdict,
}

/// The cameras from which to draw a scene, each the one that shows most after those before it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ViewpointPlan {
    pub kind: SceneKind,
    /// Unit, world.
    pub up_in_world: DVec3,
    pub views: Vec<Viewpoint>,
    pub(crate) n_candidates: usize,
    pub(crate) n_good: usize,
    /// Share of the Gaussians that any candidate shows which the views show, 0 to 1.
    pub seen: f64,
}

#[derive(Debug, thiserror::Error)]
pub enum ViewpointError {
    #[error(transparent)]
    Raster(#[from] RasterError),
    #[error(transparent)]
    Memory(#[from] MemoryError),
    #[error(transparent)]
    Io(#[from] std::io::Error),
    #[error("a drawing as PNG: {0}")]
    Image(#[from] image::ImageError),
    /// Why, and what to do.
    #[error("{0}")]
    Refused(String),
    #[error("interrupted while views were planned; run the same command again")]
    Interrupted,
}

impl fmt::Display for SceneKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Indoor => "indoor",
            Self::Outdoor => "outdoor",
            Self::Object => "object",
        })
    }
}

impl fmt::Display for ViewpointPlan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let DVec3 { x, y, z } = self.up_in_world;
        write!(
            f,
            "{} views of an {} scene with up ({x:.2}, {y:.2}, {z:.2}), of {} candidates {} good; they show {:.0} % of the \
             Gaussians that can be seen",
            self.views.len(),
            self.kind,
            self.n_candidates,
            self.n_good,
            100.0 * self.seen
        )
    }
}

/// How far a drawing can be trusted; shares of 0 to 1.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Verdict {
    /// Pixels through which nothing is seen.
    pub holes: f32,
    /// Pixels whose surface is too near to be sharp.
    pub near: f32,
    /// Pixels whose expected and median depths differ: no clear surface.
    pub haze: f32,
    /// Weight of Gaussians that are large on the screen: no detail.
    pub large: f32,
}

/// What is wrong with views, for people.
pub(super) const FAULTS: [&str; 4] =
    [HOLES, "are too near to something", "look through haze", "show no detail"];
pub(super) const HOLES: &str = "look into holes";

impl Verdict {
    /// Why the view is no good; `None` if it is.
    pub fn fault(&self, kind: SceneKind) -> Option<&'static str> {
        let holes = if kind == SceneKind::Object { MAX_HOLES_OF_OBJECT } else { MAX_HOLES };
        let found = [self.holes, self.near, self.haze, self.large];
        let limits = [holes, MAX_NEAR, MAX_HAZE, MAX_LARGE];
        (0..4).find(|at| found[*at] > limits[*at]).map(|at| FAULTS[at])
    }
}
