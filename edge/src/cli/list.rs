//! `list`.

use std::io::{self, Write};
use std::num::NonZeroUsize;
use std::time::Duration;

use clap::Args;
use glam::DVec3;
use slag_api::objects::{Name, ObjectOnBoard, ObjectPage};
use slag_common::frames::Aabb;
use slag_common::note;

use super::args::{EngineArgs, named, parse_radius, parse_reach};
use super::failure::Failure;
use super::text::{table, visible};
use crate::query::{ListFormat, ObjectFilter, ObjectOrder, check_region, parse_box, parse_point};
use crate::score::{Ball, Budget, Region};

/// Longest wait for the words: a large text model on a slow core takes minutes, once.
const NAMES_WAIT: Duration = Duration::from_secs(3600);

/// Less likely names are hidden from people, except the best.
const LEAST_SHOWN: f64 = 0.01;

const EXAMPLES: &str = "Examples:\n\
    \x20 slag-edge list\n\
    \x20 slag-edge list --near 12.5,-3,0 --radius 10 --sort area\n\
    \x20 slag-edge list --format csv\n";

#[derive(Debug, Args)]
#[command(before_help = EXAMPLES)]
pub struct ListArgs {
    /// List only within a radius of this position, world frame.
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_point, allow_hyphen_values = true, requires = "radius")]
    pub near: Option<DVec3>,
    /// The radius, world units.
    #[arg(long, requires = "near", value_parser = parse_reach)]
    pub radius: Option<f64>,
    /// List only within the box between two corners, world frame.
    #[arg(long = "box", value_name = "X,Y,Z,X,Y,Z", value_parser = parse_box, allow_hyphen_values = true)]
    pub bounds: Option<Aabb>,
    /// Least length of a thing's longest edge, world units.
    #[arg(long, default_value_t = 0.0, value_parser = parse_radius)]
    pub min_size: f64,
    /// Order: name, area (the largest face first) or id.
    #[arg(long, value_name = "ORDER", default_value = "name", value_parser = named::<ObjectOrder>)]
    pub sort: ObjectOrder,
    /// Most things [default: all].
    #[arg(long)]
    pub limit: Option<NonZeroUsize>,
    /// Print json, csv, or geojson, which needs a scene with a place on the earth [default: a table for people].
    #[arg(long, value_name = "FORMAT", value_parser = named::<ListFormat>)]
    pub format: Option<ListFormat>,
    /// Print JSON.
    #[arg(long, conflicts_with = "format")]
    pub json: bool,
    #[command(flatten)]
    pub engine: EngineArgs,
}

pub fn run(args: ListArgs) -> Result<(), Failure> {
    let around = args.near.zip(args.radius);
    let ball = around.map(|(centre_in_world, radius)| Ball { centre_in_world, radius });
    let region = Region { ball, bounds: args.bounds, polygon: None };
    check_region(&region)?;
    let filter = ObjectFilter { after: None, region, min_size: args.min_size, order: args.sort };
    let engine = args.engine.open()?;
    let on_board = engine.on_board()?;
    let format = if args.json { Some(ListFormat::Json) } else { args.format };
    format.unwrap_or_default().check(&on_board.snapshot.manifest)?;
    let limit = args.limit.map_or(usize::MAX, NonZeroUsize::get);
    let page = engine.objects(&on_board, &filter, limit, NAMES_WAIT, &Budget::default())?;
    if let Err(error) = on_board.check() {
        note(format_args!("without names: {error}"));
    }
    match format {
        Some(format) => {
            let text = format.write(&page).map_err(|e| Failure::failed("json", e))?;
            let end: &[u8] = if format == ListFormat::Csv { b"" } else { b"\n" };
            Ok(io::stdout().write_all(&[&text, end].concat())?)
        }
        None => print_page(&page),
    }
}

fn print_page(page: &ObjectPage) -> Result<(), Failure> {
    let ObjectPage { n_objects, scene, generation, unit, .. } = page;
    let listed = page.objects.len();
    if let Some(missing) = page.coverage.missing() {
        note(missing);
    }
    note(format_args!(
        "{listed} of {n_objects} things on board of {}, generation {generation}; in per cent: a share among names, no chance",
        visible(scene)
    ));
    let three = |p: DVec3, between: &str| format!("{:.2}{between}{:.2}{between}{:.2}", p.x, p.y, p.z);
    let row = |object: &ObjectOnBoard| {
        let name = |name: &Name| format!("{} {:.0} %", visible(&name.name), name.confidence * 100.0);
        let size = object.box_max_in_world - object.box_min_in_world;
        let shown = object.names.iter().enumerate();
        let shown = shown.filter(|(at, name)| *at == 0 || name.confidence >= LEAST_SHOWN);
        let names: Vec<String> = shown.map(|(_, of)| name(of)).collect();
        vec![three(object.position_in_world, ", "), three(size, " x "), object.id.clone(), names.join(", ")]
    };
    let rows: Vec<Vec<String>> = page.objects.iter().map(row).collect();
    let head = [&format!("position [{unit}]"), &format!("size [{unit}]"), "id", "names"];
    Ok(write!(io::stdout(), "{}", table(&head, &rows))?)
}
