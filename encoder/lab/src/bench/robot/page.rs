//! The report as a page in Markdown.

use std::fmt;

use super::report::{EngineFigures, PAPER, RobotReport, SearchFigures};

impl RobotReport {
    /// Returns the engines in the order of their first figures.
    fn engines(&self) -> Vec<&str> {
        let mut engines: Vec<&str> = Vec::new();
        for figures in &self.figures {
            if !engines.contains(&figures.engine.as_str()) {
                engines.push(&figures.engine);
            }
        }
        engines
    }

    fn at(&self, engine: &str, n_gaussians: u64) -> Option<&EngineFigures> {
        self.figures.iter().find(|f| f.engine == engine && f.n_gaussians == n_gaussians)
    }

    /// Writes a row: a cell for each size.
    fn row(
        &self,
        f: &mut fmt::Formatter<'_>,
        name: &str,
        cell: impl Fn(u64) -> Option<String>,
    ) -> fmt::Result {
        let cells: Vec<String> =
            self.sizes.iter().map(|n| cell(*n).unwrap_or_else(|| "not run".into())).collect();
        writeln!(f, "| {name} | {} |", cells.join(" | "))
    }

    fn header(&self, f: &mut fmt::Formatter<'_>, first: &str) -> fmt::Result {
        let sizes: Vec<String> = self.sizes.iter().map(|n| millions(*n)).collect();
        writeln!(f, "\n| {first} | {} |\n|---|{}", sizes.join(" | "), "---|".repeat(self.sizes.len()))
    }
}

impl fmt::Display for RobotReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let m = &self.machine;
        writeln!(f, "# Queries on the robot: {}, {} threads, {}\n", m.cpu, m.n_threads, m.platform)?;
        writeln!(
            f,
            "`slag-lab bench robot`, slag {}, {} components, {}. From a text's vector to ids and scores.",
            m.version, self.dim, m.build
        )?;
        let loads = || self.figures.iter().filter_map(|f| f.load_1min);
        let (least, most) = loads().fold((f64::MAX, 0.0f64), |(l, m), load| (l.min(load), m.max(load)));
        if loads().next().is_some() {
            writeln!(
                f,
                "The load average of the minute before each engine was {least:.1} to {most:.1}, this run's own work \
                 included; medians grow with the load of others, the least times hardly do."
            )?;
        }
        for text in &self.texts {
            writeln!(f, "Text to vector adds {:.2} ms ({}, {:?}).", text.median_ms, text.model, text.text)?;
        }
        for engine in self.engines() {
            let library = self.figures.iter().find(|f| f.engine == engine).map_or("", |f| &f.library);
            self.header(f, &format!("**{engine}** ({library})"))?;
            for limit in &self.limits {
                let search = |n| self.at(engine, n)?.searches.iter().find(|s| s.limit == *limit);
                self.row(f, &format!("{} results, ms: median (least)", thousands(*limit)), |n| {
                    search(n).map(|s| format!("{} ({})", ms(s.median_ms), ms(s.min_ms)))
                })?;
            }
            let recalls = |s: &[SearchFigures]| {
                let recalls: Vec<f64> = s.iter().filter_map(|s| s.recall).collect();
                let of = |pick: fn(f64, f64) -> f64| recalls.iter().copied().reduce(pick);
                of(f64::min).zip(of(f64::max))
            };
            self.row(f, "recall, least and largest of these rows", |n| {
                let found = self.at(engine, n)?;
                Some(recalls(&found.searches).map_or("-".into(), |(a, b)| format!("{a:.3}, {b:.3}")))
            })?;
            self.row(f, "RAM, GB", |n| Some(gigabytes(self.at(engine, n)?.rss_bytes)))?;
            self.row(f, "disk, GB", |n| Some(gigabytes(self.at(engine, n)?.disk_bytes)))?;
            if self.figures.iter().any(|f| f.engine == engine && f.build_secs.is_some()) {
                self.row(f, "building the index, s", |n| {
                    Some(format!("{:.0}", self.at(engine, n)?.build_secs?))
                })?;
            }
        }
        if !self.not_run.is_empty() {
            writeln!(f, "\nNot run:\n")?;
            self.not_run.iter().try_for_each(|line| writeln!(f, "- {line}"))?;
        }
        writeln!(
            f,
            "\n| the paper: Qdrant on a Jetson Orin | 1 M | 2 M | 4 M | 8 M |\n|---|---|---|---|---|"
        )?;
        for (name, row) in PAPER {
            writeln!(f, "| {name} | {} |", row.map(|v| v.to_string()).join(" | "))?;
        }
        writeln!(f, "\nText encoding adds 0.20 to 0.25 s there (Szilagyi et al. 2025).")
    }
}

fn millions(n: u64) -> String {
    format!("{} M", n as f64 / 1e6)
}

fn thousands(n: u64) -> String {
    if n >= 1000 { format!("{},{:03}", n / 1000, n % 1000) } else { n.to_string() }
}

/// Milliseconds in three digits.
fn ms(value: f64) -> String {
    match value {
        v if v < 1.0 => format!("{v:.2}"),
        v if v < 100.0 => format!("{v:.1}"),
        v => format!("{v:.0}"),
    }
}

fn gigabytes(bytes: Option<u64>) -> String {
    bytes.map_or("-".into(), |bytes| format!("{:.2}", bytes as f64 / 1e9))
}
