//! Figures and plots of the partition.

use std::fmt;
use std::path::Path;

use serde::Serialize;

use super::link::LinkSpeed;
use crate::bench::machine::Machine;
use crate::bench::plot::{Plot, Scale, Series, Style};

/// A fetch with one radius from a store with one width of cells; means over the places.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FetchFigures {
    /// Longest edge of a cell, metres, as asked for.
    pub cell_width_m: f64,
    /// Radius around the robot, metres.
    pub radius_m: f64,
    /// Cells fetched.
    pub n_cells: f64,
    /// Bytes of their shards.
    pub bytes: f64,
    /// Share of these bytes that the Gaussians within the radius account for, at the store's mean bytes per Gaussian.
    pub share_within: f64,
    /// Seconds of the fetch through the link, from the start of the program to its end.
    pub seconds: f64,
}

/// A store with one width of cells.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StoreFigures {
    /// Longest edge of a cell, metres, as asked for.
    pub cell_width_m: f64,
    /// Cells.
    pub n_cells: usize,
    /// Bytes per Gaussian of all shards.
    pub bytes_per_gaussian: f64,
    /// Bytes of the signed manifest, which every fetch of a new generation reads.
    pub manifest_bytes: u64,
}

/// The report.
#[derive(Clone, Debug, Serialize)]
pub struct PartitionReport {
    /// The machine.
    pub machine: Machine,
    /// Gaussians of the site.
    pub n_gaussians: u64,
    /// Width of the site, metres.
    pub site_width_m: f64,
    /// The link.
    pub link: LinkSpeed,
    /// Places of the robot for each radius.
    pub n_places: usize,
    /// Load average of the last minute at the start.
    pub load_1min: Option<f64>,
    /// By width of cells.
    pub stores: Vec<StoreFigures>,
    /// By width of cells and radius.
    pub fetches: Vec<FetchFigures>,
}

impl PartitionReport {
    /// Writes `partition.json`, `partition.txt`, `bytes.svg` and `seconds.svg`.
    pub(super) fn write(&self, out: &Path) -> std::io::Result<()> {
        fs_err::write(out.join("partition.json"), serde_json::to_vec_pretty(self)?)?;
        fs_err::write(out.join("partition.txt"), self.to_string())?;
        let bytes = self.svg("bytes of a fetch", |f| f.bytes);
        fs_err::write(out.join("bytes.svg"), bytes)?;
        fs_err::write(out.join("seconds.svg"), self.svg("seconds of a fetch", |f| f.seconds))
    }

    fn svg(&self, up: &'static str, value: impl Fn(&FetchFigures) -> f64) -> String {
        let series: Vec<Series> = self
            .stores
            .iter()
            .map(|store| {
                let of_store = || self.fetches.iter().filter(|f| f.cell_width_m == store.cell_width_m);
                Series {
                    name: format!("cells of {} m", store.cell_width_m),
                    style: Style::Line,
                    points: of_store().map(|f| (f.radius_m, value(f))).collect(),
                    labels: Vec::new(),
                    spreads: Vec::new(),
                }
            })
            .collect();
        let plot = Plot {
            title: format!("{up} by radius and width of cells"),
            note: format!("{}; {}", self.site(), self.machine.cpu),
            across: "radius around the robot, m",
            up,
            up_scale: Scale::Logarithmic,
        };
        plot.svg(&series)
    }

    fn site(&self) -> String {
        format!(
            "{:.1} million Gaussians on {} m x {} m, compact shards, {} Mbit/s, {} ms a request",
            self.n_gaussians as f64 / 1e6,
            self.site_width_m,
            self.site_width_m,
            self.link.bits_per_s / 1e6,
            self.link.delay_ms
        )
    }

    /// Returns the width with the least of a figure at each radius.
    fn least(&self, value: impl Fn(&FetchFigures) -> f64) -> Vec<(f64, f64)> {
        let mut best: Vec<&FetchFigures> = Vec::new();
        for fetch in &self.fetches {
            match best.iter_mut().find(|b| b.radius_m == fetch.radius_m) {
                Some(b) if value(fetch) < value(b) => *b = fetch,
                Some(_) => {}
                None => best.push(fetch),
            }
        }
        best.into_iter().map(|f| (f.radius_m, f.cell_width_m)).collect()
    }
}

impl fmt::Display for PartitionReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}; mean of {} places\n", self.site(), self.n_places)?;
        writeln!(f, "{:>8} {:>7} {:>8} {:>12}", "cells, m", "cells", "bytes/G", "manifest, B")?;
        for s in &self.stores {
            writeln!(
                f,
                "{:>8} {:>7} {:>8.2} {:>12}",
                s.cell_width_m, s.n_cells, s.bytes_per_gaussian, s.manifest_bytes
            )?;
        }
        writeln!(
            f,
            "\n{:>8} {:>9} {:>7} {:>11} {:>7} {:>8}",
            "cells, m", "radius, m", "cells", "bytes", "within", "seconds"
        )?;
        for e in &self.fetches {
            writeln!(
                f,
                "{:>8} {:>9} {:>7.1} {:>11.0} {:>6.0}% {:>8.3}",
                e.cell_width_m,
                e.radius_m,
                e.n_cells,
                e.bytes,
                100.0 * e.share_within,
                e.seconds
            )?;
        }
        let show = |least: Vec<(f64, f64)>| {
            let words: Vec<String> = least.iter().map(|(r, w)| format!("{w} m for radius {r} m")).collect();
            words.join(", ")
        };
        writeln!(f, "\nfewest bytes: cells of {}", show(self.least(|f| f.bytes)))?;
        writeln!(f, "least time: cells of {}", show(self.least(|f| f.seconds)))
    }
}
