//! `eval goal`: places to stand, judged on generated scenes by their true surfaces: the voxels that are called
//! free, and the poses that the robot's program gives for each thing.

mod road;
mod truth;

use std::collections::{BTreeMap, HashSet};
use std::fmt;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Result, anyhow};
use clap::Args;
use glam::DVec3;
use road::Road;
use serde::Serialize;
use serde_json::Value;
use slag_common::objects::public_id;
use slag_common::occupancy::BLOCK_EDGE;
use slag_encoder::objects::NONE;
use slag_encoder::progress::Progress;
use slag_encoder::query::PublishedObjects;
use slag_encoder::store::StoreReader;
use truth::{MIN_SHOWN, RADIUS_M, SENSOR_HEIGHT_M, Truth, goal_request};

use super::truth as labels;
use crate::generate::compose::{Layout, Walk};
use crate::generate::grammar::SceneKind;
use crate::harness::Times;
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
    report.voxels.add(compare_voxels(layout, &dir.join("store"))?);
    let labels = labels(&dir.join("scene"), &dir.join("store"))?;
    let start = truth.start;
    for index in (0..layout.placed.len()).filter(|index| !layout.placed[*index].shell) {
        let Some(label) = labels.get(index).filter(|label| label.n_pixels >= MIN_PIXELS) else { continue };
        let is_reachable = truth.is_reachable(index);
        let verdict = match &label.object {
            None => Verdict::NoObject,
            Some(id) => {
                let asked = Instant::now();
                let reply = service.get(&goal_request(&format!("id={id}"), start))?;
                report.millis.push(asked.elapsed().as_secs_f64() * 1e3);
                verdict(truth, index, &reply)?
            }
        };
        report.count(is_reachable, &verdict);
    }
    Ok(())
}

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

enum Verdict {
    /// The robot has no object that is the thing.
    NoObject,
    None(String),
    Pose {
        clearance_m: f64,
        is_reached: bool,
        shown: f64,
        height_error_m: f64,
    },
}

impl Verdict {
    fn is_shown(&self) -> bool {
        matches!(self, Self::Pose { shown, .. } if *shown >= MIN_SHOWN)
    }
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

#[derive(Clone, Debug, Default, Serialize)]
struct Places {
    voxels: Voxels,
    /// Things that the robot truly reaches: places within reach from which they are shown.
    n_reachable: usize,
    /// Those with a pose from which the true surfaces show them.
    n_shown: usize,
    /// Those with a pose from which they do not.
    n_hidden: usize,
    /// Those without a pose, by reason; `no-object` are no object on board.
    missed: BTreeMap<String, usize>,
    /// Things that the robot truly does not reach.
    n_unreachable: usize,
    n_unreachable_with_pose: usize,
    n_poses: usize,
    /// Poses closer than the robot's radius to a true surface, by more than 3 cm.
    n_too_close: usize,
    /// Poses in places that no way leads to.
    n_cut_off: usize,
    /// Largest distance of a pose's ground from the true one.
    max_height_error_m: f64,
    #[serde(skip)]
    millis: Vec<f64>,
}

impl Places {
    fn count(&mut self, is_reachable: bool, verdict: &Verdict) {
        if let Verdict::Pose { clearance_m, is_reached, height_error_m, .. } = verdict {
            self.n_poses += 1;
            self.n_cut_off += usize::from(!is_reached);
            self.n_too_close += usize::from(*clearance_m < RADIUS_M - TOLERANCE_M);
            self.max_height_error_m = self.max_height_error_m.max(*height_error_m);
        }
        if !is_reachable {
            self.n_unreachable += 1;
            self.n_unreachable_with_pose += usize::from(matches!(verdict, Verdict::Pose { .. }));
            return;
        }
        self.n_reachable += 1;
        match verdict {
            Verdict::NoObject => *self.missed.entry("no-object".into()).or_default() += 1,
            Verdict::None(reason) => *self.missed.entry(reason.clone()).or_default() += 1,
            verdict if verdict.is_shown() => self.n_shown += 1,
            Verdict::Pose { .. } => self.n_hidden += 1,
        }
    }
}

impl fmt::Display for GoalReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{} scenes: {}\n", self.scenes.len(), self.scenes.join(", "))?;
        let mut table = Table::new(["figure", "n", "of them"]);
        let mut row = |name: &str, n: String, of: String| table.row([name.to_owned(), n, of]);
        if let Some(places) = &self.places {
            places.tell(&mut row);
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

impl Places {
    fn tell(&self, row: &mut impl FnMut(&str, String, String)) {
        let Voxels { n_free, n_false, len_bytes } = self.voxels;
        row("free voxels", n_free.to_string(), format!("{n_false} false: {}", percent(n_false, n_free)));
        row("bytes of occupancy in each profile", len_bytes.to_string(), String::new());
        let share = percent(self.n_shown as u64, self.n_reachable as u64);
        let shown = format!("{} with a pose that shows them: {share}", self.n_shown);
        row("reachable things", self.n_reachable.to_string(), shown);
        let hidden =
            format!("{} with a pose that does not; without a pose: {:?}", self.n_hidden, self.missed);
        row("", String::new(), hidden);
        let with_pose = format!("{} with a pose", self.n_unreachable_with_pose);
        row("unreachable things", self.n_unreachable.to_string(), with_pose);
        let (close, cut_off) = (self.n_too_close, self.n_cut_off);
        let poses = format!("{close} closer to a surface than the radius, {cut_off} cut off");
        row("poses", self.n_poses.to_string(), poses);
        row("ground off by at most, m", format!("{:.3}", self.max_height_error_m), String::new());
        let times = Times::of(self.millis.clone());
        let millis = format!("{:.1} ms median, {:.1} ms at most", times.median_ms, times.max_ms);
        row("requests", times.n.to_string(), millis);
    }
}

/// Spacing of the tested surface points.
const SPACING_M: f64 = 0.012;

#[derive(Clone, Copy, Debug, Default, Serialize)]
struct Voxels {
    n_free: u64,
    /// Those with a true surface inside, or inside a solid.
    n_false: u64,
    len_bytes: u64,
}

impl Voxels {
    fn add(&mut self, other: Self) {
        self.n_free += other.n_free;
        self.n_false += other.n_false;
        self.len_bytes += other.len_bytes;
    }
}

fn compare_voxels(layout: &Layout, store: &Path) -> Result<Voxels> {
    let reader = StoreReader::open(store)?;
    let mut found = Voxels::default();
    let mut surfaces: Option<HashSet<[i32; 3]>> = None;
    for cell in &reader.manifest().cells {
        let Some(record) = cell.shards.values().next() else { continue };
        let shard = reader.read_shard(record)?;
        let Some(occupancy) = shard.layout.additions(&shard.bytes).occupancy else { continue };
        let voxel = occupancy.header.voxel;
        let surfaces = surfaces.get_or_insert_with(|| surface_voxels(layout, voxel));
        found.len_bytes += occupancy.sections().iter().map(|(_, bytes)| bytes.len() as u64).sum::<u64>();
        for run in occupancy.runs() {
            for block in run.blocks.clone() {
                let [_, free] = run.masks_of(block);
                let at = occupancy.block_at(block);
                for bit in (0..64).filter(|bit| free >> bit & 1 == 1) {
                    let offset = [bit / 16, bit / 4 % 4, bit % 4];
                    let place = [0, 1, 2].map(|axis| at[axis] * BLOCK_EDGE + offset[axis]);
                    let centre = (DVec3::from(place.map(f64::from)) + 0.5) * voxel;
                    found.n_free += 1;
                    found.n_false += u64::from(surfaces.contains(&place) || is_solid(layout, centre));
                }
            }
        }
    }
    Ok(found)
}

fn surface_voxels(layout: &Layout, voxel: f64) -> HashSet<[i32; 3]> {
    let mut voxels = HashSet::new();
    for placed in &layout.placed {
        for part in &placed.object.parts {
            for surfel in part.surfels(SPACING_M) {
                let at = placed.world_from_object.transform_point3(surfel.position) / voxel;
                voxels.insert(at.floor().to_array().map(|v| v as i32));
            }
        }
    }
    voxels
}

fn is_solid(layout: &Layout, point: DVec3) -> bool {
    // A ceiling's box encloses its whole room, but only the surface is a thing.
    let things = layout.placed.iter().filter(|placed| !placed.shell);
    let near = things.filter(|placed| placed.bounds.contains(point));
    near.flat_map(|placed| placed.object.parts.iter().map(move |part| (placed, part))).any(
        |(placed, part)| {
            let world_from_part = placed.world_from_object * part.object_from_part;
            part.shape.contains(world_from_part.inverse().transform_point3(point))
        },
    )
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
