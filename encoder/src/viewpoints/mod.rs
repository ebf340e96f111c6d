//! Viewpoints: where to draw a splat that has no photos, from its Gaussians alone.

mod draw;
mod looks;
mod plan;
mod space;

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::sync::atomic::{AtomicBool, Ordering};

use glam::{DAffine3, DVec3};
use rayon::prelude::*;
use slag_common::Gaussians;

use crate::ground::up;
use crate::memory::{MemoryError, MemoryPlan, Phase};
use crate::raster::{RasterError, Rasterizer};
use looks::Look;
use space::Space;

pub(crate) use draw::check_folder;
pub(crate) use draw::{DrawnView, views_of};
pub use draw::{POSES_FILE, draw, draw_sharpened};
pub(crate) use plan::Viewpoint;
pub use plan::{SceneKind, Verdict, ViewpointError, ViewpointPlan, ViewpointSettings};

/// Default number of views: twice as many gain 1 % of average precision.
pub const DEFAULT_N_VIEWS: usize = 48;
/// Fewer good candidates cannot show a scene from several sides.
const MIN_GOOD: usize = 12;
/// Gaussians that suffice for a plan, if enlarged. Small scenes lose by that: a quarter of a yard's 147,000 looks hazy
/// from 150 places, all of them from 24.
const ENOUGH_GAUSSIANS: usize = 1 << 18;
const MAX_STRIDE: usize = 4;
/// Least height of a thing, as a share of its width, that is looked at from around: a robot on a piece of ground has 45
/// %, yards and drone scenes have 4 to 13 %.
const TALL: f64 = 0.25;

/// Gain of a Gaussian's first, second, third and further view, tenths.
const GAINS: [u32; 4] = [10, 6, 4, 1];
/// Gain of a side that no view has shown yet, and of one that a view has shown, fifths.
const NEW_SIDE: u32 = 5;
const USED_SIDE: u32 = 2;

/// Plans a scene's views within `memory_bytes`, including the scene. The plan depends neither on threads nor on the
/// scene's scale.
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
    check_memory(scene, stride, memory_bytes)?;
    let grown = (stride as f32).sqrt();
    let (thin, solid) = space::thinned(scene, stride, grown)?;
    let up = match settings.up {
        Some(up) => {
            let wrong = || format!("--up {up}: expected three finite numbers, not all 0");
            let axis = up.try_normalize().ok_or_else(|| ViewpointError::Refused(wrong()))?;
            up::Up { axis, sign: up::Sign::Known }
        }
        None => up::find(&thin, &solid),
    };
    let planner = Planner { thin, solid, grown, rasterizer, cancel };
    let space = planner.upright(&up)?;
    let candidates = planner.candidates(space, up.sign, MIN_GOOD.min(settings.n_views))?;
    if candidates.kind == SceneKind::Object && settings.up.is_none() {
        let DVec3 { x, y, z } = candidates.space.up_in_world();
        tracing::warn!(
            "an object does not tell surely which way is up; taken to be ({x:.2}, {y:.2}, {z:.2}): give --up X,Y,Z if the \
             drawings are not upright"
        );
    }
    candidates.choose(settings)
}

fn check_memory(scene: &Gaussians, stride: usize, memory_bytes: u64) -> Result<(), MemoryError> {
    // Columns of means, rotations, scales, opacities and colours, and the candidates' looks.
    let mut memory = MemoryPlan::new(memory_bytes);
    memory.reserve(Phase::Always, "the scene with its colours", scene.len_bytes());
    let thin_bytes = Gaussians::decoded_bytes(scene.len() / stride, 0) as u64;
    memory.reserve(Phase::Views, "Gaussians that views are planned by", 3 * thin_bytes);
    memory.reserve(Phase::Views, "what planned views show", looks::MOST as u64 * looks::LOOK_BYTES);
    memory.rest(0).map(drop)
}

struct Planner<'a> {
    /// Some of the scene's Gaussians, enlarged by `grown`, in its world; and which of them are solid.
    thin: Gaussians,
    solid: Vec<u32>,
    grown: f32,
    rasterizer: &'a dyn Rasterizer,
    cancel: &'a AtomicBool,
}

/// Views that were looked at, good and bad.
struct Candidates {
    space: Space,
    kind: SceneKind,
    looked: Vec<Look>,
}

impl Planner<'_> {
    fn space(&self, up: DVec3) -> Space {
        Space::new(&self.thin, &self.solid, self.grown, up)
    }

    /// The scene with its upper side above, which its contents tell where the axis alone is known.
    fn upright(&self, up: &up::Up) -> Result<Space, ViewpointError> {
        let space = self.space(up.axis);
        if !matches!(up.sign, up::Sign::Unknown | up::Sign::OfSpread) {
            return Ok(space);
        }
        let is_upside_down = match looks::kind_of(&space) {
            SceneKind::Indoor => looks::is_upside_down(&space),
            _ => large_from_above(&space, self.rasterizer)?,
        };
        Ok(if is_upside_down { self.space(-up.axis) } else { space })
    }

    /// Looks from where the kind of scene asks for; a kind that gives fewer than `enough` good views may be another.
    fn candidates(&self, space: Space, sign: up::Sign, enough: usize) -> Result<Candidates, ViewpointError> {
        let kind = looks::kind_of(&space);
        let looked = self.look_at_all(&space, kind, looks::of(kind, &space))?;
        let mut found = Candidates { space, kind, looked };
        // A ball has no floor, and no place within; a room full of floaters has a floor.
        let is_solid = sign == up::Sign::Assumed && found.looked.len() < MIN_GOOD;
        if is_solid || found.are_of_an_object() {
            // That a thing is flat does not tell which way is up.
            if sign >= up::Sign::OfSpread {
                found.space = self.space(up::OF_FILES);
            }
            let cameras = looks::of(SceneKind::Object, &found.space);
            found.looked = self.look_at_all(&found.space, SceneKind::Object, cameras)?;
            found.kind = SceneKind::Object;
        } else if sign == up::Sign::Assumed {
            return Err(ViewpointError::Refused(
                "the Gaussians do not tell which way is up; give it with --up X,Y,Z, for example --up 0,0,1 where z points up"
                    .to_owned(),
            ));
        }
        if n_with(&found.looked, found.kind, None) < enough {
            // Floors between storeys; or a thing that cameras among it are too near to.
            let (kind, cameras) = match found.kind {
                SceneKind::Indoor => (SceneKind::Indoor, looks::of_storeys(&found.space)),
                _ => (SceneKind::Object, looks::of(SceneKind::Object, &found.space)),
            };
            let looked = self.look_at_all(&found.space, kind, cameras)?;
            if n_with(&looked, kind, None) >= enough {
                found = Candidates { kind, looked, ..found };
            }
        }
        Ok(found)
    }

    fn look_at_all(
        &self,
        space: &Space,
        kind: SceneKind,
        cameras: Vec<DAffine3>,
    ) -> Result<Vec<Look>, ViewpointError> {
        let loaded = self.rasterizer.load(&space.scene)?;
        let looked = cameras.into_par_iter().map(|camera| {
            if self.cancel.load(Ordering::Relaxed) {
                return Err(ViewpointError::Interrupted);
            }
            Ok(looks::look(loaded.as_ref(), space, camera, kind)?)
        });
        looked.collect::<Vec<_>>().into_iter().collect()
    }
}

impl Candidates {
    /// Whether the scene is a thing with nothing around it: from within, one looks past it, and it is tall, or there is
    /// no other way to look at it.
    fn are_of_an_object(&self) -> bool {
        let Self { space, kind, looked } = self;
        let is_tall = 2.0 * space.half.z > TALL * space::WIDTH;
        2 * n_with(looked, *kind, Some(plan::HOLES)) > looked.len()
            && (is_tall || n_with(looked, *kind, None) < MIN_GOOD)
    }

    fn choose(self, settings: &ViewpointSettings) -> Result<ViewpointPlan, ViewpointError> {
        let Self { space, kind, looked } = self;
        let n_candidates = looked.len();
        let (good, bad): (Vec<Look>, Vec<Look>) =
            looked.into_iter().partition(|look| look.verdict.fault(kind).is_none());
        if good.len() < MIN_GOOD.min(settings.n_views) {
            let why = match n_candidates {
                0 => format!("this {kind} scene has no free place for a camera"),
                _ => format!(
                    "only {} of {n_candidates} planned views of this {kind} scene can be trusted ({})",
                    good.len(),
                    faults(&bad, kind)
                ),
            };
            let or_up =
                if settings.up.is_some() { "" } else { ", or state its upward direction with --up X,Y,Z" };
            return Err(ViewpointError::Refused(format!(
                "{why}; give photos with --views, or remove floaters from the splat{or_up}"
            )));
        }
        let (chosen, seen) = greedy(&good, space.scene.len(), settings.n_views);
        let view = |at: usize| Viewpoint {
            camera_from_world: space.camera_from_world(good[at].camera),
            verdict: good[at].verdict,
        };
        Ok(ViewpointPlan {
            kind,
            up_in_world: space.up_in_world(),
            views: chosen.into_iter().map(view).collect(),
            n_candidates,
            n_good: good.len(),
            seen,
        })
    }
}

fn n_with(looked: &[Look], kind: SceneKind, fault: Option<&str>) -> usize {
    looked.iter().filter(|look| look.verdict.fault(kind) == fault).count()
}

fn faults(bad: &[Look], kind: SceneKind) -> String {
    let all = plan::FAULTS.map(|fault| (fault, n_with(bad, kind, Some(fault))));
    let told = all.iter().filter(|(_, n)| *n > 0).map(|(fault, n)| format!("{n} {fault}"));
    told.collect::<Vec<_>>().join(", ")
}

/// Whether large Gaussians cover more from above than from below: nothing makes Gaussians small that no photo has seen,
/// such as the underside of the ground.
fn large_from_above(space: &Space, rasterizer: &dyn Rasterizer) -> Result<bool, RasterError> {
    let loaded = rasterizer.load(&space.scene)?;
    let large = |sign: f64| {
        let eye = DVec3::new(0.0, 0.0, sign * (space.half.z + 0.6 * space::WIDTH));
        let look = looks::look(loaded.as_ref(), space, looks::look_at(eye, DVec3::ZERO), SceneKind::Outdoor)?;
        Ok::<_, RasterError>(look.verdict.large)
    };
    Ok(large(1.0)? > large(-1.0)?)
}

#[derive(Clone, Copy, Default)]
struct Seen {
    n_views: u8,
    /// A bit for each.
    sides: u16,
}

impl Seen {
    fn gain(self, side: u8) -> u32 {
        let gain = GAINS[usize::from(self.n_views).min(GAINS.len() - 1)];
        gain * if self.sides & (1 << side) == 0 { NEW_SIDE } else { USED_SIDE }
    }
}

/// Picks at most `n_views` looks greedily by gain; also returns the share they see of the Gaussians in any look. Ties
/// go to the first. Gains only fall, so most need not be computed again (Minoux 1978).
fn greedy(looks: &[Look], n_gaussians: usize, n_views: usize) -> (Vec<usize>, f64) {
    let mut state = vec![Seen::default(); n_gaussians];
    let gain = |state: &[Seen], look: &Look| -> u64 {
        let gains = look.seen.iter().map(|(gaussian, side)| u64::from(state[*gaussian as usize].gain(*side)));
        look.preference * gains.sum::<u64>()
    };
    // (gain, first look, number of chosen looks when the gain was computed)
    let mut heap: BinaryHeap<_> =
        looks.iter().enumerate().map(|(at, look)| (gain(&state, look), Reverse(at), 0)).collect();
    let mut chosen = Vec::new();
    while chosen.len() < n_views
        && let Some((_, Reverse(at), n_then)) = heap.pop()
    {
        if n_then != chosen.len() {
            heap.push((gain(&state, &looks[at]), Reverse(at), chosen.len()));
            continue;
        }
        for (gaussian, side) in &looks[at].seen {
            let seen = &mut state[*gaussian as usize];
            seen.n_views = seen.n_views.saturating_add(1);
            seen.sides |= 1 << side;
        }
        chosen.push(at);
    }
    let mut by_any = vec![false; n_gaussians];
    looks.iter().flat_map(|look| &look.seen).for_each(|(gaussian, _)| by_any[*gaussian as usize] = true);
    let n_any = by_any.iter().filter(|seen| **seen).count();
    let n_seen = state.iter().filter(|seen| seen.n_views > 0).count();
    (chosen, n_seen as f64 / n_any.max(1) as f64)
}
