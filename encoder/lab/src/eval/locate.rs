//! `eval locate`: photos that the map has not seen, located in it; photos of the other scenes must not be.
//!
//! Three quarters of a scene's photos make the map; the rest, and those of `test/`, are the queries. An unsure answer
//! counts as lost.

use std::fmt;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, Result};
use clap::{Args, ValueEnum};
use rayon::prelude::*;
use serde::Serialize;
use slag_common::appearance::AppearanceColumns;
use slag_common::landmarks::BuiltLandmarks;
use slag_common::splat::{self, ReadOptions};
use slag_common::{Gaussians, Intrinsics, View, poses};
use slag_encoder::ingest;
use slag_encoder::landmarks::{self, SceneRenderer};
use slag_encoder::progress::Progress;
use slag_encoder::raster::{CpuRasterizer, LoadedScene, RasterView, Rasterizer};
use slag_locate::{Grey, Map, MappingView, Outcome, Photo, Renderer, locate};

use super::truth::Truth;
use crate::scenes::SceneFiles;
use crate::table::{Table, figure};

/// One photo in this many is a query.
const HELD_OUT: usize = 4;
/// Most foreign photos tried in a scene, evenly spread over all.
const MAX_FOREIGN: usize = 48;
const FOCAL_FACTOR: f64 = 1.03;
const DARK_FACTOR: f32 = 0.4;
/// Step to which a robot's positions are rounded where the scene is metric, metres.
const POSITION_STEP_M: f64 = 0.02;
/// Width of the square of [`Change::Covered`], as a share of each side: 20 % of the area.
const COVERED_SIDE: f64 = 0.447;
/// One thing in this many is moved, and by this many metres.
const MOVED_THINGS: u16 = 3;
const MOVED_M: f64 = 1.0;

/// `eval locate`.
#[derive(Debug, Args)]
pub(crate) struct LocateArgs {
    /// Folders of scenes: a splat, poses, photos, and optionally test/transforms.json.
    #[arg(long = "scene", value_name = "DIR", num_args = 1.., required = true)]
    scenes: Vec<PathBuf>,
    /// Changes each query.
    #[arg(long, value_enum, default_value = "none")]
    change: Change,
    /// Tells each query that was not found where it is.
    #[arg(long)]
    list: bool,
}

/// How queries differ from their photos.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Change {
    None,
    /// 40 % of the light.
    Dark,
    /// Half the resolution, and back.
    Blurred,
    /// The focal length is stated 3 % too large.
    Focal,
    /// A grey square hides 20 % of the photo.
    Covered,
    /// The splat drawn in the photo's place.
    Drawn,
    /// The same, with a third of the labelled things 1 m from where the map has them.
    Moved,
}

struct Located {
    name: String,
    gaussians: Gaussians,
    map: Map,
    len_bytes: u64,
    map_secs: f64,
    queries: Vec<View>,
    /// What queries show instead of their photos.
    drawn: Option<Gaussians>,
}

/// Errors in metres and degrees, or why the query was not found.
struct Try {
    found: Result<[f64; 2], String>,
    secs: f64,
}

impl Try {
    fn is_within(&self, metres: f64, degrees: f64) -> bool {
        self.found.as_ref().is_ok_and(|[m, deg]| *m <= metres && *deg <= degrees)
    }
}

/// In JSON the figures of all scenes together.
#[derive(Debug, Serialize)]
#[serde(transparent)]
pub(crate) struct LocateReport {
    all: Figures,
    #[serde(skip)]
    scenes: Vec<Figures>,
}

/// Shares of queries, of a scene or of all.
#[derive(Debug, Serialize)]
struct Figures {
    #[serde(skip)]
    name: String,
    n: usize,
    n_foreign: usize,
    within_25cm_5deg: Option<f64>,
    within_1m_10deg: Option<f64>,
    lost: Option<f64>,
    /// Found, but further away than 1 m or 10 degrees.
    wrong: Option<f64>,
    foreign_accepted: Option<f64>,
    /// Median error of those that were found.
    median_m: Option<f64>,
    median_secs: Option<f64>,
    bytes_per_million: Option<f64>,
    #[serde(skip)]
    map_secs: f64,
}

pub(crate) fn run(args: &LocateArgs, progress: &dyn Progress) -> Result<LocateReport> {
    let files = SceneFiles::find_all(&args.scenes)?;
    progress.begin("locate", "scene", files.len() as u64, 0);
    let scenes = files.iter().map(|files| prepare(files, args)).collect::<Result<Vec<_>>>()?;
    let drawn =
        scenes.iter().map(|scene| scene.drawn.as_ref().map(|drawn| CpuRasterizer.load(drawn)).transpose());
    let drawn = drawn.collect::<Result<Vec<_>, _>>()?;
    let (mut of_scenes, mut all_tries, mut all_foreign) = (Vec::new(), Vec::new(), Vec::new());
    for (at, scene) in scenes.iter().enumerate() {
        let loaded = CpuRasterizer.load(&scene.gaussians)?;
        let renderer = SceneRenderer(loaded.as_ref());
        let attempt = |of: usize, view: &View| -> Result<Try> {
            Ok(attempt(scene, &query(view, args.change, drawn[of].as_deref())?, &renderer))
        };
        let mut tries = Vec::new();
        for view in &scene.queries {
            let one = attempt(at, view)?;
            if args.list && !one.is_within(0.25, 5.0) {
                let told = match &one.found {
                    Err(reason) => reason.clone(),
                    Ok([m, deg]) => format!("off by {m:.2} m, {deg:.1} degrees"),
                };
                tracing::warn!("{} {}: {told}", scene.name, view.name);
            }
            tries.push(one);
        }
        let others = (0..scenes.len()).filter(|other| *other != at);
        let others: Vec<(usize, &View)> =
            others.flat_map(|other| scenes[other].queries.iter().map(move |view| (other, view))).collect();
        let others: Vec<_> = others.iter().step_by(others.len().div_ceil(MAX_FOREIGN).max(1)).collect();
        let foreign =
            others.par_iter().map(|(other, view)| attempt(*other, view)).collect::<Result<Vec<_>>>()?;
        of_scenes.push(Figures::of(&scene.name, &[scene], &tries, &foreign));
        all_tries.extend(tries);
        all_foreign.extend(foreign);
        progress.advance(1);
    }
    progress.end();
    let all = Figures::of("all", &scenes.iter().collect::<Vec<_>>(), &all_tries, &all_foreign);
    Ok(LocateReport { all, scenes: of_scenes })
}

fn prepare(files: &SceneFiles, args: &LocateArgs) -> Result<Located> {
    let gaussians = splat::read(&files.splat, &ReadOptions { with_sh_rest: true })?;
    let views = poses::read(&files.poses, files.images.as_deref())?.views;
    // The last photo of each group.
    let is_query = |at: usize| at % HELD_OUT == HELD_OUT - 1;
    let start = Instant::now();
    let loaded = CpuRasterizer.load(&gaussians)?;
    let mapping = views.iter().enumerate().filter(|(at, _)| !is_query(*at));
    let mapping: Vec<MappingView> = mapping
        .map(|(at, view)| {
            landmarks::observe(loaded.as_ref(), at as u16, view).with_context(|| view.name.clone())
        })
        .collect::<Result<_>>()?;
    drop(loaded);
    let found = landmarks::landmarks(&mapping, gaussians.len());
    let drawn = match args.change {
        Change::Drawn => Some(gaussians.clone()),
        Change::Moved => Some(moved(&gaussians, &Truth::read(&files.dir, gaussians.len())?)),
        _ => None,
    };
    let built = BuiltLandmarks::pack(slag_locate::CODE_VERSION, &found);
    let mut queries: Vec<View> =
        views.iter().enumerate().filter(|(at, _)| is_query(*at)).map(|(_, view)| view.clone()).collect();
    let test = files.dir.join("test/transforms.json");
    if test.is_file() {
        queries.extend(poses::read(&test, None)?.views);
    }
    Ok(Located {
        name: files.name.clone(),
        map: Map::new(built.view().map(|view| view.iter().collect()).unwrap_or_default()),
        len_bytes: built.len_bytes(),
        map_secs: start.elapsed().as_secs_f64(),
        gaussians: on_board(&gaussians),
        queries,
        drawn,
    })
}

/// Moves some of the things sideways, each its own way.
fn moved(scene: &Gaussians, truth: &Truth) -> Gaussians {
    let mut moved = scene.clone();
    let is_thing = |id: u16| truth.things.iter().any(|thing| thing.id == id);
    for (mean, id) in moved.means_in_world.iter_mut().zip(&truth.id_of_gaussian) {
        if id % MOVED_THINGS == 0 && is_thing(*id) {
            *mean += MOVED_M * glam::DVec2::from_angle(f64::from(*id)).extend(0.0);
        }
    }
    moved
}

/// Returns a scene as a robot holds it: rounded, without harmonics.
fn on_board(scene: &Gaussians) -> Gaussians {
    let indices: Vec<u32> = (0..scene.len() as u32).collect();
    let columns = AppearanceColumns::of(scene, &indices);
    let mut on_board = Gaussians::default();
    for (index, mean) in scene.means_in_world.iter().enumerate() {
        columns.view().add_to(&mut on_board, index, (mean / POSITION_STEP_M).round() * POSITION_STEP_M);
    }
    on_board
}

struct Query {
    grey: Grey,
    intrinsics: Intrinsics,
    camera_from_world: glam::DAffine3,
}

fn query(view: &View, change: Change, drawn: Option<&dyn LoadedScene>) -> Result<Query> {
    let loaded = ingest::load_image(view).with_context(|| view.name.clone())?;
    let mut intrinsics = loaded.view.intrinsics;
    let camera_from_world = view.camera_from_world;
    let image = match drawn {
        Some(scene) => scene.draw(&RasterView { camera_from_world, intrinsics }, [0.5; 3])?.image(),
        None => loaded.image,
    };
    let (width, height) = image.dimensions();
    let mut grey = Grey::from_rgb8(width as usize, height as usize, image.as_raw());
    changed(change, &mut grey, &mut intrinsics);
    Ok(Query { grey, intrinsics, camera_from_world })
}

fn attempt(scene: &Located, query: &Query, renderer: &dyn Renderer) -> Try {
    let photo =
        Photo { grey: &query.grey, intrinsics: &query.intrinsics, gravity_in_camera: None, prior: None };
    let start = Instant::now();
    let outcome = locate(&scene.map, &photo, Some(renderer));
    let secs = start.elapsed().as_secs_f64();
    let found = match outcome {
        Outcome::Found(found) => {
            let (truth, pose) = (query.camera_from_world, found.camera_from_world);
            let metres = truth.inverse().translation.distance(pose.inverse().translation);
            let between = glam::DQuat::from_mat3(&(pose.matrix3 * truth.matrix3.transpose()));
            let degrees = between.to_axis_angle().1.to_degrees();
            Ok([metres, degrees.min(360.0 - degrees)])
        }
        Outcome::Unsure(_) => Err("unsure".into()),
        Outcome::Lost(reason) => Err(reason.to_string()),
    };
    Try { found, secs }
}

fn changed(change: Change, grey: &mut Grey, intrinsics: &mut Intrinsics) {
    let (width, height) = (grey.width, grey.height);
    match change {
        Change::None | Change::Drawn | Change::Moved => {}
        Change::Dark => grey.values.iter_mut().for_each(|v| *v = (*v * DARK_FACTOR * 255.0).round() / 255.0),
        Change::Blurred => {
            let sharp = grey.values.clone();
            for y in 0..height {
                for x in 0..width {
                    let (x0, y0) = (x / 2 * 2, y / 2 * 2);
                    let (x1, y1) = ((x0 + 1).min(width - 1), (y0 + 1).min(height - 1));
                    let corners = [(x0, y0), (x1, y0), (x0, y1), (x1, y1)];
                    grey.values[y * width + x] =
                        0.25 * corners.map(|(x, y)| sharp[y * width + x]).iter().sum::<f32>();
                }
            }
        }
        Change::Focal => {
            intrinsics.focal_x_px *= FOCAL_FACTOR;
            intrinsics.focal_y_px *= FOCAL_FACTOR;
        }
        Change::Covered => {
            let side = |n: usize| (n as f64 * COVERED_SIDE) as usize;
            for y in height / 4..height / 4 + side(height) {
                grey.values[y * width + width / 4..][..side(width)].fill(0.5);
            }
        }
    }
}

impl Figures {
    fn of(name: &str, scenes: &[&Located], tries: &[Try], foreign: &[Try]) -> Self {
        let share = |n: usize, of: usize| (of > 0).then(|| n as f64 / of as f64);
        let of_tries =
            |is: &dyn Fn(&Try) -> bool| share(tries.iter().filter(|one| is(one)).count(), tries.len());
        let median = |mut values: Vec<f64>| {
            values.sort_by(f64::total_cmp);
            values.get(values.len() / 2).copied()
        };
        let n_gaussians: usize = scenes.iter().map(|scene| scene.gaussians.len()).sum();
        let len_bytes: u64 = scenes.iter().map(|scene| scene.len_bytes).sum();
        Self {
            name: name.to_owned(),
            n: tries.len(),
            n_foreign: foreign.len(),
            within_25cm_5deg: of_tries(&|one| one.is_within(0.25, 5.0)),
            within_1m_10deg: of_tries(&|one| one.is_within(1.0, 10.0)),
            lost: of_tries(&|one| one.found.is_err()),
            wrong: of_tries(&|one| one.found.is_ok() && !one.is_within(1.0, 10.0)),
            foreign_accepted: share(foreign.iter().filter(|one| one.found.is_ok()).count(), foreign.len()),
            median_m: median(tries.iter().filter_map(|one| Some(one.found.as_ref().ok()?[0])).collect()),
            median_secs: median(tries.iter().map(|one| one.secs).collect()),
            bytes_per_million: (n_gaussians > 0).then(|| len_bytes as f64 * 1e6 / n_gaussians as f64),
            map_secs: scenes.iter().map(|scene| scene.map_secs).sum(),
        }
    }
}

impl fmt::Display for LocateReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let of_queries =
            ["scene", "n", "0.25 m, 5 deg", "1 m, 10 deg", "lost", "wrong", "median m", "median s"];
        let others = ["foreign", "accepted", "bytes a million", "map s"];
        let mut table = Table::new(of_queries.into_iter().chain(others));
        for of in self.scenes.iter().chain([&self.all]) {
            let shares =
                [of.within_25cm_5deg, of.within_1m_10deg, of.lost, of.wrong, of.median_m, of.median_secs];
            let mut row = vec![of.name.clone(), of.n.to_string()];
            row.extend(shares.map(figure));
            row.extend([of.n_foreign.to_string(), figure(of.foreign_accepted)]);
            row.extend([
                of.bytes_per_million.map_or("-".into(), |b| format!("{b:.0}")),
                format!("{:.1}", of.map_secs),
            ]);
            table.row(row);
        }
        write!(f, "{table}")
    }
}
