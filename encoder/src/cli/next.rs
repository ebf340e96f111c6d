//! What to do next, as commands ready to paste.

use std::fmt::Write;
use std::fs;
use std::path::Path;

use anyhow::Result;
use glam::DVec3;
use slag_common::frames::Aabb;
use slag_math::stats::{Rank, quantile};

use super::common::InputArgs;
use crate::ingest::{Activated, FrameChoice};
use crate::store::StoreReader;
use crate::store::metadata::MetadataReader;

/// Share of the Gaussians, in thousandths, that the extent leaves out on each side of each axis: strays lie far away.
const STRAYS_PER_MILLE: usize = 10;
/// Gaussians that are read for the extent; of larger scenes, every n-th.
const MAX_READ: u64 = 1 << 20;
/// Wider scenes are outdoors.
const HOUSE_M: f64 = 25.0;
const PORT: u16 = 7733;

/// Lines for a published store: extent, `query` and `serve` here, `trust` and `fetch` on the robot.
pub(super) fn of_store(store: &Path, input: &InputArgs) -> Result<String> {
    let reader = StoreReader::open(store)?;
    let here = shell_word(store);
    // The page knows no --activated.
    let shown = if input.activated == Activated::default() { of_input(input) } else { String::new() };
    let (extent, at) = extent_and_place(&positions_of(&reader));
    let mut lines = String::from("\nnext\n");
    writeln!(lines, "  slag-encoder query --store {here} {}", example(&reader, extent))?;
    writeln!(lines, "  slag-encoder view --store {here}{shown}")?;
    writeln!(lines, "  slag-encoder serve --store {here} --listen 0.0.0.0:{PORT}")?;
    Ok(lines + &robot_lines(&reader, &format!("http://0.0.0.0:{PORT}"), extent, at)?)
}

/// Lines for a robot, with the extent it can fetch. `url`: where the store is served.
pub(super) fn of_robot(reader: &StoreReader, url: &str) -> Result<String> {
    let (extent, at) = extent_and_place(&positions_of(reader));
    robot_lines(reader, url, extent, at)
}

fn robot_lines(reader: &StoreReader, url: &str, extent: Aabb, at: DVec3) -> Result<String> {
    let manifest = reader.manifest();
    let root = MetadataReader::new(reader.dir()).root_sha256()?;
    let unit = if manifest.metric { "m" } else { "world units" };
    let size = extent.max - extent.min;
    let base = ["0.0.0.0", "[::]"].iter().fold(url.to_owned(), |url, any| url.replace(any, &host_name()));
    let mut lines = String::from("on the robot\n");
    writeln!(lines, "  slag-edge trust add {base} --sha256 {root}")?;
    writeln!(lines, "  slag-edge fetch --from {base} --at {:.2},{:.2},{:.2} --radius 50", at.x, at.y, at.z)?;
    writeln!(lines, "  slag-edge query {}", example(reader, extent))?;
    writeln!(
        lines,
        "The scene is {:.1} x {:.1} x {:.1} {unit}, from {} to {} without strays.",
        size.x,
        size.y,
        size.z,
        point(extent.min),
        point(extent.max)
    )?;
    Ok(lines)
}

/// A word to ask for: drones survey yards and streets.
fn example(reader: &StoreReader, extent: Aabb) -> &'static str {
    let width_m = (extent.max - extent.min).truncate().max_element();
    if reader.manifest().geo_reference.is_some() && width_m > HOUSE_M { "car" } else { "chair" }
}

/// Positions of Gaussians, evenly from all cells; a shard that cannot be read is left out.
fn positions_of(reader: &StoreReader) -> Vec<DVec3> {
    let manifest = reader.manifest();
    let every_nth = manifest.n_gaussians.div_ceil(MAX_READ).max(1) as usize;
    let (mut positions, mut first) = (Vec::new(), 0);
    for cell in &manifest.cells {
        let Some(shard) = cell.shards.values().next() else { continue };
        let Ok(shard) = reader.read_shard(shard) else { continue };
        let (view, n) = (shard.view(), cell.n_gaussians as usize);
        let read = (0..n).filter(|at| (first + at) % every_nth == 0);
        positions.extend(read.map(|at| view.position_in_world(at)));
        first += n;
    }
    positions
}

pub(super) fn of_check(input: &InputArgs) -> String {
    let every = input.every.map_or(String::new(), |n| format!(" --every {n}"));
    let Activated { scales, opacities } = input.activated;
    let activated = match (scales, opacities) {
        (false, false) => "",
        (true, false) => " --activated scales",
        (false, true) => " --activated opacities",
        (true, true) => " --activated scales,opacities",
    };
    format!("\nnext\n  slag-encoder encode{}{every}{activated} --store STORE\n", of_input(input))
}

fn of_input(input: &InputArgs) -> String {
    let frame = match &input.splat_frame {
        FrameChoice::Auto => None,
        FrameChoice::None => Some(Path::new("none")),
        FrameChoice::File(path) => Some(&**path),
    };
    let paths = [
        ("scene", Some(&*input.scene)),
        ("views", input.views.as_deref()),
        ("images", input.images.as_deref()),
        ("splat-frame", frame.filter(|_| input.views.is_some())),
    ];
    let flag = |(name, path): (&str, Option<&Path>)| Some(format!(" --{name} {}", shell_word(path?)));
    paths.into_iter().filter_map(flag).collect()
}

/// Extent without strays, and a place amid the Gaussians: the one nearest to the median along each axis.
fn extent_and_place(positions: &[DVec3]) -> (Aabb, DVec3) {
    let at = |per_mille: usize| {
        let along = |axis: usize| {
            let mut values: Vec<f64> = positions.iter().map(|position| position[axis]).collect();
            quantile(&mut values, per_mille, Rank::Between).unwrap_or_default()
        };
        DVec3::from_array([0, 1, 2].map(along))
    };
    let extent = Aabb { min: at(STRAYS_PER_MILLE), max: at(1000 - STRAYS_PER_MILLE) };
    let middle = at(500);
    let distance = |of: &DVec3| of.distance_squared(middle);
    let nearest = positions.iter().copied().min_by(|a, b| distance(a).total_cmp(&distance(b)));
    (extent, nearest.unwrap_or(middle))
}

fn point(at: DVec3) -> String {
    format!("({:.1}, {:.1}, {:.1})", at.x, at.y, at.z)
}

/// This machine's name, by which robots on the same network may reach it.
fn host_name() -> String {
    let name = fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let name = name.trim();
    if name.is_empty() { "BASE".into() } else { name.into() }
}

fn shell_word(path: &Path) -> String {
    let text = path.display().to_string();
    let is_plain = |c: char| c.is_alphanumeric() || "/._-+,:@%=".contains(c);
    match !text.is_empty() && text.chars().all(is_plain) {
        true => text,
        false => format!("'{}'", text.replace('\'', "'\\''")),
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::cli::{Cli, Command};

    /// By hand: a row of 1,000 Gaussians, and a stray one far away, which widens its cell's box.
    #[test]
    fn the_extent_is_that_of_most_gaussians() {
        let mut positions: Vec<DVec3> = (0..1000).map(|x| DVec3::new(f64::from(x), 3.0, 1.0)).collect();
        positions.push(DVec3::new(90_000.0, -50.0, 70.0));
        let (extent, at) = extent_and_place(&positions);
        assert_eq!((extent.min, extent.max), (DVec3::new(10.0, 3.0, 1.0), DVec3::new(990.0, 3.0, 1.0)));
        assert_eq!(at, DVec3::new(500.0, 3.0, 1.0));
        assert_eq!(extent_and_place(&[]).1, DVec3::ZERO);
    }

    /// The next command gets the same inputs.
    #[test]
    fn lines_repeat_the_inputs() {
        let line = "slag-encoder check --scene a.ply --views b --images c --splat-frame none --every 3 --activated scales";
        let parsed = Cli::try_parse_from(line.split(' ')).expect("flags");
        let Command::Check(args) = parsed.command else { panic!("check") };
        let inputs = "--scene a.ply --views b --images c --splat-frame none";
        assert_eq!(of_input(&args.input), format!(" {inputs}"));
        let expected = format!("encode {inputs} --every 3 --activated scales --store STORE");
        assert!(of_check(&args.input).contains(&expected), "{}", of_check(&args.input));
    }

    #[test]
    fn odd_paths_are_quoted() {
        assert_eq!(shell_word(Path::new("data/sparse/0")), "data/sparse/0");
        assert_eq!(shell_word(Path::new("Bob's yard")), "'Bob'\\''s yard'");
    }
}
