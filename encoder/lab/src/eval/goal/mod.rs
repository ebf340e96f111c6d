//! Places to stand, judged on generated scenes by their true surfaces: the voxels that are called free, and the poses that the
//! robot's program gives for each thing.

mod asked;
mod labels;
mod report;
mod truth;
mod voxels;

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, Result, anyhow};
use glam::DVec3;
use serde_json::Value;
use slag_encoder::progress::Progress;

use super::robot::{Prepared, Service, flag_value};
use crate::generate::compose::{Layout, Walk};
use crate::generate::grammar::{self, SceneKind};
use asked::{HEIGHT_M, MIN_VISIBLE, REACH_M, SENSOR_HEIGHT_M, STEP_M};
pub use report::GoalReport;
use report::Verdict;
use truth::Truth;

/// Things with fewer pixels over all photos are not asked about.
const MIN_PIXELS: u64 = 4000;
/// What to judge on.
#[derive(Clone, Debug)]
pub struct GoalSettings {
    /// Folder of scenes, stores and caches; what a run before left there is used.
    pub out: PathBuf,
    /// Kinds of scenes.
    pub kinds: Vec<SceneKind>,
    /// Seeds of each kind.
    pub seeds: Vec<u64>,
    /// Photos of each scene.
    pub n_views: u32,
    /// Where they are taken.
    pub walk: Walk,
    /// Radius of the robot.
    pub radius_m: f64,
    /// Whether each fault is logged.
    pub lists_faults: bool,
    /// Folder of the programs.
    pub programs: PathBuf,
}

/// Judges every scene.
///
/// # Errors
/// A program fails, or a scene cannot be read.
pub fn run(settings: &GoalSettings, progress: &dyn Progress) -> Result<GoalReport> {
    let mut report = GoalReport::default();
    progress.begin("goal", "scene", (settings.kinds.len() * settings.seeds.len()) as u64, 0);
    for kind in &settings.kinds {
        for seed in &settings.seeds {
            let name = flag_value(kind)?;
            let dir = settings.out.join(format!("{name}-{seed}"));
            // The objects' outlines are the true ones: places are judged here, not segmentation.
            let encode_flags = &["--occupancy", "--masks", "SCENE/gt/masks"];
            let (programs, n_views, walk) = (&settings.programs, settings.n_views, settings.walk);
            let scene =
                Prepared { programs, dir: &dir, kind: &name, seed: *seed, n_views, walk, encode_flags };
            scene.make().with_context(|| dir.display().to_string())?;
            judge(settings, &scene, *kind, &mut report).with_context(|| dir.display().to_string())?;
            report.scenes.push(format!("{name}-{seed}"));
            progress.advance(1);
        }
    }
    progress.end();
    Ok(report)
}

fn judge(settings: &GoalSettings, at: &Prepared<'_>, kind: SceneKind, report: &mut GoalReport) -> Result<()> {
    let nouns = grammar::nouns(None)?;
    let layout = Layout::new(&[kind], at.seed, &nouns, &|_, _| true);
    report.voxels.add(voxels::compare(&layout, &at.dir.join("store"))?);
    let views = layout.photos(settings.walk, settings.n_views);
    let cameras = views.iter().map(|view| view.camera_from_world.inverse().translation);
    let truth = Truth::new(&layout, settings.radius_m, cameras)?;
    let labels = labels::read(&at.dir.join("scene"), &at.dir.join("store"))?;
    let service = Service::start(&at.program("slag-edge"), &["--cache"], &at.dir.join("cache"))?;
    let start = truth.start();
    for (index, placed) in layout.placed.iter().enumerate().filter(|(_, placed)| !placed.shell) {
        let Some(label) = labels.get(index).filter(|label| label.n_pixels >= MIN_PIXELS) else { continue };
        let is_reachable = truth.is_reachable(index);
        let verdict = match &label.object {
            None => Verdict::NoObject,
            Some(id) => {
                let asked = Instant::now();
                let path = format!(
                    "/v1/goal?id={id}&near={},{},0&radius_m={}&reach_m={REACH_M}&sensor_height_m={SENSOR_HEIGHT_M}&height_m={HEIGHT_M}&step_m={STEP_M}&min_visible={MIN_VISIBLE}",
                    start.x, start.y, settings.radius_m
                );
                let reply = service.get(&path)?;
                report.millis.push(asked.elapsed().as_secs_f64() * 1e3);
                verdict(&truth, index, &reply)?
            }
        };
        let noun = &nouns[placed.noun].name;
        if settings.lists_faults && verdict.is_fault(is_reachable) {
            let id = label.object.as_deref().unwrap_or("no object");
            tracing::warn!("{}-{} {noun} {id} (reachable: {is_reachable}): {verdict:?}", at.kind, at.seed);
        }
        report.count(settings.radius_m, is_reachable, &verdict);
    }
    Ok(())
}

/// Judges the robot's best pose for a thing.
fn verdict(truth: &Truth<'_>, thing: usize, reply: &Value) -> Result<Verdict> {
    let Some(goal) = reply["goals"].as_array().map(|goals| goals.first()) else {
        return Err(anyhow!("the robot refused: {reply}"));
    };
    let Some(goal) = goal else {
        return Ok(Verdict::None(reply["none"]["kind"].as_str().unwrap_or_default().to_owned()));
    };
    let position: DVec3 = serde_json::from_value(goal["position_in_world"].clone())?;
    let sensor = DVec3::new(position.x, position.y, SENSOR_HEIGHT_M);
    let (clearance_m, is_reached) = truth.at(position);
    let (shown, height_error_m) = (truth.shown(thing, sensor), position.z.abs());
    Ok(Verdict::Pose { clearance_m, is_reached, shown, height_error_m })
}
