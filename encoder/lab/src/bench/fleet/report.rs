//! Table and plot of simulated fleets.

use std::fmt;

use serde::Serialize;

use super::simulate::{Handing, Links, Work, wall_secs};
use crate::bench::machine::Machine;
use crate::bench::plot::{Plot, Scale, Series, Style};

/// Twice the machines pay if they shorten the time by at least this share.
const PAYS: f64 = 0.25;

/// Fleets of one scene.
#[derive(Clone, Debug, Serialize)]
pub struct FleetReport {
    /// The machine that simulated.
    pub machine: Machine,
    /// Views of the scene.
    pub n_views: usize,
    /// Bytes of their contributions.
    pub len_bytes: u64,
    /// Seconds of a machine for a view, the mean and the largest.
    pub view_secs: [f64; 2],
    /// By number of machines.
    pub rows: Vec<FleetRow>,
    /// The most machines at which twice as many as before shortened the time by a quarter or more; by a queue, by batches.
    pub pays_until: [usize; 2],
}

/// Fleets of one size.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct FleetRow {
    /// Machines.
    pub n: usize,
    /// Seconds where each takes the next piece of work.
    pub queue_secs: f64,
    /// Seconds with batches made beforehand.
    pub batches_secs: f64,
    /// Speed-up of the first, by the number of machines.
    pub efficiency: f64,
}

impl FleetReport {
    /// Simulates fleets of 1, 2, 4, ... machines.
    pub fn simulate(work: &Work, links: &Links, most: usize) -> Self {
        let sizes = std::iter::successors(Some(1usize), |n| Some(n * 2)).take_while(|n| *n <= most);
        let secs = |n, handing| wall_secs(work, links, n, handing);
        let alone = secs(1, Handing::Queue);
        let row = |n| {
            let queue_secs = secs(n, Handing::Queue);
            let efficiency = alone / queue_secs / n as f64;
            FleetRow { n, queue_secs, batches_secs: secs(n, Handing::Batches), efficiency }
        };
        let rows: Vec<FleetRow> = sizes.map(row).collect();
        let pays_until = |of: fn(&FleetRow) -> f64| {
            let pays = |pair: &&[FleetRow]| of(&pair[1]) <= (1.0 - PAYS) * of(&pair[0]);
            rows.windows(2).take_while(pays).last().map_or(1, |pair| pair[1].n)
        };
        let pays_until = [pays_until(|row| row.queue_secs), pays_until(|row| row.batches_secs)];
        let of_views = || work.views.iter().map(|view| view.secs);
        let mean = of_views().sum::<f64>() / work.views.len() as f64;
        Self {
            machine: Machine::here(),
            n_views: work.views.len(),
            len_bytes: work.views.iter().map(|view| view.len_bytes).sum(),
            view_secs: [mean, of_views().fold(0.0, f64::max)],
            rows,
            pays_until,
        }
    }

    /// Draws the times by number of machines.
    pub fn svg(&self) -> String {
        let series = |name: &str, style, of: fn(&FleetRow) -> f64| Series {
            name: name.into(),
            style,
            points: self.rows.iter().map(|row| (row.n as f64, of(row))).collect(),
            labels: Vec::new(),
            spreads: Vec::new(),
        };
        let alone = self.rows.first().map_or(0.0, |row| row.queue_secs);
        let mut ideal = series("no waiting, no network", Style::Points, |_| 0.0);
        ideal.points.iter_mut().for_each(|(n, secs)| *secs = alone / *n);
        let plot = Plot {
            title: format!("Simulated fleets, {} views", self.n_views),
            note: format!(
                "{:.2} s of a machine a view, {:.1} GB of contributions; twice the machines save a quarter or more up to {} (queue)",
                self.view_secs[0],
                self.len_bytes as f64 / 1e9,
                self.pays_until[0]
            ),
            across: "machines",
            up: "seconds to publication",
            up_scale: Scale::Logarithmic,
        };
        plot.svg(&[
            series("queue, costly views first", Style::Line, |row| row.queue_secs),
            series("batches made beforehand", Style::Line, |row| row.batches_secs),
            ideal,
        ])
    }
}

impl fmt::Display for FleetReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{} views, {:.1} GB", self.n_views, self.len_bytes as f64 / 1e9)?;
        writeln!(f, "machines   queue s   batches s   efficiency")?;
        for row in &self.rows {
            let FleetRow { n, queue_secs, batches_secs, efficiency } = row;
            writeln!(f, "{n:8} {queue_secs:9.1} {batches_secs:11.1} {efficiency:12.2}")?;
        }
        let [queue, batches] = self.pays_until;
        writeln!(f, "twice the machines save a quarter or more up to {queue} (queue), {batches} (batches)")
    }
}
