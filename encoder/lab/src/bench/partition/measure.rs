//! Publishes the site with each width of cells, and fetches from it.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

use anyhow::{Context, Result};
use slag_common::shard::Profile;
use slag_encoder::cells::{CellLimits, PositionError, split};
use slag_encoder::codebook::CodebookSettings;
use slag_encoder::progress::Progress;
use slag_encoder::shard::ShardSettings;

use super::link::{Link, LinkSpeed};
use super::report::{FetchFigures, PartitionReport, StoreFigures};
use super::site::Site;
use crate::bench::field::FieldWriter;
use crate::bench::machine::Machine;
use crate::bench::programs::{Server, json_of, load_1min, remove};

/// What to measure.
#[derive(Clone, Debug)]
pub struct PartitionSettings {
    /// Gaussians of the site.
    pub n_gaussians: usize,
    /// Components of an embedding.
    pub dim: usize,
    /// Width of the site, metres.
    pub site_width_m: f64,
    /// Longest edges of cells, metres.
    pub cell_widths_m: Vec<f64>,
    /// Most Gaussians of a cell.
    pub max_gaussians: usize,
    /// Radii around the robot, metres.
    pub radii_m: Vec<f64>,
    /// Places of the robot for each radius.
    pub n_places: usize,
    /// The link between robot and store.
    pub link: LinkSpeed,
    /// Folder for the report, and for stores while they are needed.
    pub out: PathBuf,
    /// `slag-encoder`.
    pub encoder: PathBuf,
    /// `slag-edge`.
    pub edge: PathBuf,
}

/// Measures all widths and radii and writes the report.
///
/// # Errors
/// A program fails, or a file cannot be written.
pub fn run(settings: &PartitionSettings, progress: &dyn Progress) -> Result<PartitionReport> {
    fs_err::create_dir_all(&settings.out)?;
    let site = Site::new(settings.n_gaussians, settings.dim, settings.site_width_m);
    let mut report = PartitionReport {
        machine: Machine::here(),
        n_gaussians: site.scene.len() as u64,
        site_width_m: settings.site_width_m,
        link: settings.link,
        n_places: settings.n_places,
        load_1min: load_1min(),
        stores: Vec::new(),
        fetches: Vec::new(),
    };
    let n_steps = settings.cell_widths_m.len() * settings.radii_m.len();
    progress.begin("partition", "radius", n_steps as u64, 0);
    for width in &settings.cell_widths_m {
        let store = settings.out.join("store");
        remove(&store)?;
        let figures = publish(settings, &site, *width, &store)?;
        let server = Server::start(&settings.encoder, &store)?;
        let link = Link::open(&server.url, settings.link)?;
        for radius in &settings.radii_m {
            report.fetches.push(fetches(settings, &site, &figures, *radius, &link.url)?);
            progress.advance(1);
        }
        report.stores.push(figures);
        drop((link, server));
        remove(&store)?;
    }
    progress.end();
    report.write(&settings.out)?;
    Ok(report)
}

fn publish(settings: &PartitionSettings, site: &Site, width: f64, store: &Path) -> Result<StoreFigures> {
    let shards = ShardSettings {
        profiles: vec![Profile::Compact],
        codebook: CodebookSettings::default(),
        input_indices: false,
        appearance: false,
    };
    let mut writer = FieldWriter::create(store, &site.field, settings.dim, &shards)?;
    let limits = CellLimits {
        max_gaussians: settings.max_gaussians,
        max_width: Some(width),
        position_error: PositionError::Within(0.01),
    };
    for cell in &split(&site.scene, limits).cells {
        writer.add(&site.scene, cell, &site.embeddings)?;
    }
    let made = writer.publish()?;
    let bytes = made.shard_bytes.values().sum::<u64>() as f64;
    Ok(StoreFigures {
        cell_width_m: width,
        n_cells: made.n_cells,
        bytes_per_gaussian: bytes / made.n_gaussians.max(1) as f64,
        manifest_bytes: fs_err::metadata(store.join("manifest"))?.len(),
    })
}

/// Fetches to an empty cache from each place.
fn fetches(
    settings: &PartitionSettings,
    site: &Site,
    store: &StoreFigures,
    radius: f64,
    url: &str,
) -> Result<FetchFigures> {
    let cache = settings.out.join("cache");
    let (mut n_cells, mut bytes, mut within, mut seconds) = (0.0, 0.0, 0.0, 0.0);
    let places = site.places(settings.n_places, radius);
    for place in &places {
        remove(&cache)?;
        let mut command = Command::new(&settings.edge);
        command.args(["fetch", "--trust-first", "--json", "--quiet", "--profile", "compact", "--from", url]);
        command.arg("--at").arg(format!("{},{},{}", place.x, place.y, place.z));
        command.args(["--radius", &radius.to_string()]).arg("--cache").arg(&cache);
        let start = Instant::now();
        let printed = json_of(&mut command)?;
        seconds += start.elapsed().as_secs_f64();
        let figure = |part: &str, name: &str| {
            let value = printed[part][name].as_f64();
            value.with_context(|| {
                format!("slag-edge fetch printed no {part}.{name}; build it from this version")
            })
        };
        n_cells += figure("downloaded", "n_shards")?;
        bytes += figure("downloaded", "bytes")?;
        within += site.n_within(*place, radius) as f64;
    }
    remove(&cache)?;
    let n = places.len().max(1) as f64;
    Ok(FetchFigures {
        cell_width_m: store.cell_width_m,
        radius_m: radius,
        n_cells: n_cells / n,
        bytes: bytes / n,
        share_within: within * store.bytes_per_gaussian / bytes.max(1.0),
        seconds: seconds / n,
    })
}
