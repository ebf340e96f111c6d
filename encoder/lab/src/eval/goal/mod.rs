//! `eval goal`: places to stand, judged on generated scenes by their true surfaces: the poses that the robot's program
//! gives for each thing.

mod road;
mod truth;

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use clap::Args;
use glam::DVec3;
use road::Road;
use serde::Serialize;
use serde_json::Value;
use slag_common::objects::public_id;
use slag_encoder::objects::NONE;
use slag_encoder::progress::Progress;
use slag_encoder::query::PublishedObjects;
use slag_encoder::store::StoreReader;
use truth::{MIN_SHOWN, RADIUS_M, SENSOR_HEIGHT_M, Truth, goal_request};

use super::truth as labels;
use crate::generate::compose::{Layout, Walk};
use crate::generate::grammar::SceneKind;
use crate::programs::{Prepared, Service, sibling};
use crate::table::{Table, percent};

/// Things with fewer pixels over all photos are not asked about.
const MIN_PIXELS: u64 = 4000;
/// Clearance by which a pose may fall short: a cell of the true map on either side.
const TOLERANCE_M: f64 = 0.03;

/// `eval goal`.
#[derive(Debug, Args)]
pub(crate) struct GoalArgs {
    /// Folder for scenes, stores and caches; what an earlier run left there is used.
    #[arg(long, value_name = "DIR", default_value = "target/goal")]
    out: PathBuf,
    /// Kinds of scenes.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "room,yard")]
    kind: Vec<SceneKind>,
    /// Seeds of each kind.
    #[arg(long, value_name = "N", value_delimiter = ',', default_values_t = [21, 22, 23, 24])]
    seeds: Vec<u64>,
    /// Photos of each scene.
    #[arg(long, value_name = "N", default_value_t = 96, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    n_views: u32,
    /// Goes the whole road instead: from photos that no map has seen to what words name, with the encoder's own
    /// masks.
    #[arg(long)]
    from_photos: bool,
}

pub(crate) fn run(args: &GoalArgs, progress: &dyn Progress) -> Result<GoalReport> {
    let (mut places, mut road) = (Places::default(), Road::default());
    // The objects' outlines are the true ones where places are judged, not segmentation.
    let encode_flags: &[&str] = match args.from_photos {
        true => &["--occupancy", "--locate", "--appearance"],
        false => &["--occupancy", "--masks", "SCENE/gt/masks"],
    };
    let scenes = Prepared {
        out: &args.out,
        kinds: &args.kind,
        seeds: &args.seeds,
        n_views: args.n_views,
        walk: Walk::Everywhere,
        encode_flags,
    };
    let scenes = scenes.judge(progress, |kind, seed, dir| {
        let layout = Layout::new(&[kind], seed, &|_, _| true);
        let views = layout.photos(Walk::Everywhere, args.n_views);
        let cameras = views.iter().map(|view| view.camera_from_world.inverse().translation);
        let truth = Truth::new(&layout, cameras)?;
        let service = Service::start(&sibling("slag-edge")?, "--cache", &dir.join("cache"))?;
        match args.from_photos {
            true => road.add(&dir.join("scene"), &layout, &truth, &service),
            false => judge(dir, &layout, &truth, &service, &mut places),
        }
    })?;
    let (places, road) = if args.from_photos { (None, Some(road)) } else { (Some(places), None) };
    Ok(GoalReport { scenes, places, road })
}

fn judge(
    dir: &Path,
    layout: &Layout,
    truth: &Truth<'_>,
    service: &Service,
    report: &mut Places,
) -> Result<()> {
    let labels = labels(&dir.join("scene"), &dir.join("store"))?;
    for index in (0..layout.placed.len()).filter(|index| !layout.placed[*index].shell) {
        let Some(label) = labels.get(index).filter(|label| label.n_pixels >= MIN_PIXELS) else { continue };
        let pose = match &label.object {
            // The robot has no object that is the thing.
            None => None,
            Some(id) => pose(truth, index, &service.get(&goal_request(&format!("id={id}"), truth.start))?)?,
        };
        report.count(truth.is_reachable(index), pose);
    }
    Ok(())
}

/// Judges the best pose of a reply by the true surfaces.
fn pose(truth: &Truth<'_>, thing: usize, reply: &Value) -> Result<Option<Pose>> {
    let Some(goals) = reply["goals"].as_array() else { bail!("the robot refused: {reply}") };
    let Some(goal) = goals.first() else { return Ok(None) };
    let position: DVec3 = serde_json::from_value(goal["position_in_world"].clone())?;
    let (clearance_m, is_reached) = truth.at(position);
    let is_shown = truth.shown(thing, position.with_z(SENSOR_HEIGHT_M)) >= MIN_SHOWN;
    Ok(Some(Pose { clearance_m, is_reached, is_shown }))
}

struct Label {
    /// Over all photos.
    n_pixels: u64,
    /// The object's id, as replies write it.
    object: Option<String>,
}

fn labels(scene: &Path, store: &Path) -> Result<Vec<Label>> {
    let reader = StoreReader::open(store)?;
    let objects = PublishedObjects::read(&reader)?;
    let truth = labels::Truth::read(scene, objects.object_of.len())?;
    let object_of_thing = objects_of_things(&truth.id_of_gaussian, &objects.object_of);
    // Shell and things are listed apart, each in the order of the layout; shell nouns are placed first.
    let label = |thing: &labels::Thing| {
        let object = object_of_thing.get(&thing.id).map(|object| public_id(objects.ids[*object as usize]));
        Label { n_pixels: thing.train_pixels, object }
    };
    Ok(truth.background.iter().chain(&truth.things).map(label).collect())
}

/// Returns each thing's object: the largest with more than half of its Gaussians on the thing. Boxes are not
/// compared, because strays make them as large as the room.
fn objects_of_things(thing_of: &[u16], object_of: &[u32]) -> BTreeMap<u16, u32> {
    let (mut n_of_object, mut n_of_both) = (BTreeMap::new(), BTreeMap::new());
    for (thing, object) in thing_of.iter().zip(object_of).filter(|(_, object)| **object != NONE) {
        *n_of_object.entry(*object).or_insert(0u64) += 1;
        *n_of_both.entry((*object, *thing)).or_insert(0u64) += 1;
    }
    let mut most: BTreeMap<u16, (u64, u32)> = BTreeMap::new();
    for ((object, thing), both) in n_of_both {
        if 2 * both > n_of_object[&object] && most.get(&thing).is_none_or(|(n, _)| both > *n) {
            most.insert(thing, (both, object));
        }
    }
    most.into_iter().map(|(thing, (_, object))| (thing, object)).collect()
}

/// Where the robot would stand for a thing.
struct Pose {
    clearance_m: f64,
    is_reached: bool,
    is_shown: bool,
}

/// Figures of all scenes: of places, or of the whole road.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct GoalReport {
    scenes: Vec<String>,
    #[serde(flatten)]
    places: Option<Places>,
    #[serde(flatten)]
    road: Option<Road>,
}

#[derive(Clone, Copy, Debug, Default, Serialize)]
struct Places {
    /// Things that the robot truly reaches: places within reach from which they are shown.
    n_reachable: usize,
    /// Those with a pose from which the true surfaces show them.
    n_shown: usize,
    /// Those with a pose from which they do not.
    n_hidden: usize,
    n_poses: usize,
    /// Poses closer than the robot's radius to a true surface, by more than 3 cm.
    n_too_close: usize,
    /// Poses in places that no way leads to.
    n_cut_off: usize,
}

impl Places {
    fn count(&mut self, is_reachable: bool, pose: Option<Pose>) {
        self.n_reachable += usize::from(is_reachable);
        let Some(Pose { clearance_m, is_reached, is_shown }) = pose else { return };
        self.n_poses += 1;
        self.n_cut_off += usize::from(!is_reached);
        self.n_too_close += usize::from(clearance_m < RADIUS_M - TOLERANCE_M);
        self.n_shown += usize::from(is_reachable && is_shown);
        self.n_hidden += usize::from(is_reachable && !is_shown);
    }
}

impl fmt::Display for GoalReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{} scenes: {}\n", self.scenes.len(), self.scenes.join(", "))?;
        let mut table = Table::new(["figure", "n", "of them"]);
        let mut row = |name: &str, n: String, of: String| table.row([name.to_owned(), n, of]);
        if let Some(Places { n_reachable, n_shown, n_hidden, n_poses, n_too_close, n_cut_off }) = self.places
        {
            let share = percent(n_shown as u64, n_reachable as u64);
            let shown =
                format!("{n_shown} with a pose that shows them: {share}; {n_hidden} with one that does not");
            row("reachable things", n_reachable.to_string(), shown);
            let poses = format!("{n_too_close} closer to a surface than the radius, {n_cut_off} cut off");
            row("poses", n_poses.to_string(), poses);
        }
        if let Some(Road { n_photos, n_located, n_runs, n_shown, n_hidden }) = self.road {
            row("photos", n_photos.to_string(), format!("{n_located} located"));
            let shown = percent(n_shown as u64, n_runs as u64);
            let ends = format!("{n_shown} end where it is shown: {shown}; {n_hidden} where it is not");
            row("runs, a photo and a word each", n_runs.to_string(), ends);
        }
        write!(f, "{table}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: object 0 is thing 1 by 3 of 4, object 1 is it by 2 of 2, object 2 is things 2 and 3 by half each.
    #[test]
    fn an_object_is_the_thing_that_it_mostly_is() {
        let found = objects_of_things(&[1, 1, 1, 2, 1, 1, 2, 3, 3], &[0, 0, 0, 0, 1, 1, 2, 2, NONE]);
        assert_eq!(found, BTreeMap::from([(1, 0)]));
    }
}
