//! Viewpoints: where to draw a splat that has no photos, from its Gaussians alone.
//!
//! | step | result | file |
//! |---|---|---|
//! | up | the upward direction, from the normals of flat Gaussians | `up.rs` |
//! | space | the scene turned, centred and scaled to a width of 10; its occupied voxels and its kind | `space.rs` |
//! | candidates | cameras in free places, by kind | `candidates.rs` |
//! | looks | a small drawing of each candidate: can it be trusted, and which Gaussians does it show? | `looks.rs` |
//! | choice | those that together show most, greedily | `choice.rs` |
//! | draw | images, and the poses file that says that they are drawings | `draw.rs` |

mod candidates;
mod choice;
mod draw;
mod looks;
mod space;
mod up;

use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};

use glam::{DAffine3, DVec3};
use rayon::prelude::*;
use serde::Serialize;
use slag_common::Gaussians;

use crate::memory::{MemoryError, MemoryPlan, Phase};
use crate::raster::{RasterError, Rasterizer};
use looks::Look;
use space::Space;

pub use draw::{DrawError, DrawnView, POSES_FILE, draw, views_of};
pub use looks::{Fault, Verdict};

/// Views where nothing else is asked for: more find no more (twice as many gain 1 % of average precision).
pub const DEFAULT_N_VIEWS: usize = 48;
/// Fewer good candidates than this cannot show a scene from several sides.
const MIN_GOOD: usize = 12;
/// Gaussians that suffice for a plan, enlarged: a quarter plans nearly as well as all, a sixteenth does not.
const ENOUGH_GAUSSIANS: usize = 1 << 18;
const MAX_STRIDE: usize = 4;

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

/// A camera of a plan.
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
    pub n_candidates: usize,
    pub n_good: usize,
    /// Share of the Gaussians that any candidate shows which the views show, 0 to 1.
    pub seen: f64,
}

#[derive(Debug, thiserror::Error)]
pub enum ViewpointError {
    #[error(transparent)]
    Raster(#[from] RasterError),
    #[error(transparent)]
    Memory(#[from] MemoryError),
    #[error(
        "no views can be planned: {n} Gaussians are opaque and finite, expected at least {expected}; give photos with --views"
    )]
    Empty { n: usize, expected: usize },
    #[error(
        "the Gaussians do not tell which way is up; give it with --up X,Y,Z, for example --up 0,0,1 where z points up"
    )]
    NoUp,
    #[error("--up {0}: expected three finite numbers, not all 0")]
    BadUp(DVec3),
    #[error(
        "only {n_good} of {n_candidates} planned views of this {kind} scene can be trusted ({faults}); give photos with --views, \
         remove floaters from the splat, or state its upward direction with --up X,Y,Z"
    )]
    FewViews { kind: SceneKind, n_good: usize, n_candidates: usize, faults: String },
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

/// Plans the views of a scene within `memory_bytes`, the scene's included. The plan does not depend on the number of threads, nor on the scene's scale.
///
/// # Errors
/// [`ViewpointError`] where views cannot be trusted; it says what to give.
pub fn plan(
    scene: &Gaussians,
    rasterizer: &dyn Rasterizer,
    settings: &ViewpointSettings,
    memory_bytes: u64,
    cancel: &AtomicBool,
) -> Result<ViewpointPlan, ViewpointError> {
    let stride = (scene.len() / ENOUGH_GAUSSIANS).clamp(1, MAX_STRIDE);
    // A column each of means, rotations, scales, opacities and colours, and what candidates show.
    let mut memory = MemoryPlan::new(memory_bytes);
    memory.reserve(Phase::Always, "the scene with its colours", scene.len_bytes());
    let thin_bytes = Gaussians::decoded_bytes(scene.len() / stride, 0) as u64;
    memory.reserve(Phase::Views, "Gaussians that views are planned by", 2 * thin_bytes);
    memory.reserve(Phase::Views, "what planned views show", candidates::MOST as u64 * looks::LOOK_BYTES);
    memory.rest(0)?;
    let thin = space::thinned(scene, stride);
    let up = match settings.up {
        Some(up) => {
            up::Up { axis: up.try_normalize().ok_or(ViewpointError::BadUp(up))?, sign: up::Sign::Known }
        }
        None => up::find(&thin)?,
    };
    let mut space = Space::new(&thin, up.axis)?;
    drop(thin);
    if up.sign == up::Sign::Unknown && looks::large_from_above(&space, rasterizer)? {
        space = space.upside_down();
    }
    let loaded = rasterizer.load(&space.scene)?;
    let kind = space.kind(loaded.as_ref())?;
    let cameras = candidates::of(kind, &space);
    let n_candidates = cameras.len();
    let looked = cameras.into_par_iter().map(|camera| {
        if cancel.load(Ordering::Relaxed) {
            return Err(ViewpointError::Interrupted);
        }
        Ok(looks::look(loaded.as_ref(), &space.scene, camera, kind)?)
    });
    let looked = looked.collect::<Vec<_>>().into_iter().collect::<Result<Vec<Look>, ViewpointError>>()?;
    let (good, bad): (Vec<Look>, Vec<Look>) =
        looked.into_iter().partition(|look| look.verdict.fault(kind).is_none());
    tracing::debug!("{kind}: {n_candidates} candidates, {} good; {}", good.len(), faults(&bad, kind));
    if good.len() < MIN_GOOD.min(settings.n_views) {
        return Err(ViewpointError::FewViews {
            kind,
            n_good: good.len(),
            n_candidates,
            faults: faults(&bad, kind),
        });
    }
    let (chosen, seen) = choice::greedy(&good, space.scene.len(), settings.n_views);
    let views = chosen.into_iter().map(|at| Viewpoint {
        camera_from_world: space.camera_from_world(good[at].camera),
        verdict: good[at].verdict,
    });
    Ok(ViewpointPlan {
        kind,
        up_in_world: space.up_in_world(),
        views: views.collect(),
        n_candidates,
        n_good: good.len(),
        seen,
    })
}

/// Returns how many views fail for which reason.
fn faults(bad: &[Look], kind: SceneKind) -> String {
    let count = |fault| bad.iter().filter(|look| look.verdict.fault(kind) == Some(fault)).count();
    let all = Fault::ALL.map(|fault| (fault, count(fault)));
    let told: Vec<String> =
        all.into_iter().filter(|(_, n)| *n > 0).map(|(fault, n)| format!("{n} {fault}")).collect();
    told.join(", ")
}
