//! Writes files of contributions, times each step on them, and estimates the cost of a larger scene.

use std::io::ErrorKind;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use rayon::prelude::*;
use slag_encoder::lift::{CellField, ContributionError, ContributionIndex};
use slag_encoder::shard;

use super::options::LiftOptions;
use super::plain::Plain;
use super::report::{EmbeddingModel, LiftReport, Plan, Step};
use crate::bench::machine::Machine;
use crate::bench::timing::{Spread, timed_ms};

/// Writes the files, times the steps, and estimates.
///
/// # Errors
/// [`ContributionError`].
pub fn run(options: &LiftOptions) -> Result<LiftReport, ContributionError> {
    let start = Instant::now();
    let plain = Plain::new(options);
    fs_err::create_dir_all(&options.work_dir)?;
    let paths = options.paths();
    let n_visible = AtomicU64::new(0);
    paths.par_iter().enumerate().try_for_each(|(view, path)| {
        let (contributions, n) = plain.view(view as u64);
        n_visible.fetch_add(n, Ordering::Relaxed);
        contributions.write(path)
    })?;
    let disk_bytes =
        paths.iter().map(|path| Ok(fs_err::metadata(path)?.len())).sum::<std::io::Result<u64>>()?;
    let write_secs = start.elapsed().as_secs_f64();

    // Resets the peak on Linux; elsewhere it is not reported.
    let _ = fs_err::write("/proc/self/clear_refs", "5");
    let rss_before_bytes = status_bytes("VmRSS");
    let mut passes = Vec::new();
    for _ in 0..options.n_repeats.max(1) {
        passes.push(Pass::measure(&paths, &plain)?);
    }
    let peak_rss_bytes = status_bytes("VmHWM");
    let report = Report { options, passes: &passes, disk_bytes };
    Ok(LiftReport {
        machine: Machine::here(),
        options: options.clone(),
        n_entries: passes[0].n_entries,
        visible_per_view: n_visible.into_inner() as f64 / options.n_views as f64,
        n_regions: passes[0].n_regions,
        n_cells: plain.n_gaussians_of_cell.len(),
        n_groups: passes[0].n_groups,
        n_with_evidence: passes[0].n_with_evidence,
        disk_bytes,
        write_secs,
        steps: report.steps(),
        aggregation: report.spread(Pass::aggregation_ms),
        with_embeddings: report.spread(|pass| pass.aggregation_ms() + pass.embed.wall_ms),
        embedding_model: report.embedding_model(),
        peak_rss_bytes,
        rss_before_bytes,
        plan: report.plan(),
    })
}

/// Returns a value of `/proc/self/status`, in bytes.
fn status_bytes(key: &str) -> Option<u64> {
    let status = fs_err::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix(':'))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? * 1024)
}

/// Wall-clock time, and processor time of all threads, in milliseconds.
#[derive(Clone, Copy, Default)]
struct Took {
    wall_ms: f64,
    cpu_ms: f64,
}

impl Took {
    fn time<T>(&mut self, work: impl FnOnce() -> T) -> T {
        let before = cpu_ms();
        let (result, wall_ms) = timed_ms(work);
        self.wall_ms += wall_ms;
        self.cpu_ms += cpu_ms() - before;
        result
    }
}

/// Returns the processor time of the process; 0 where the system does not report it.
fn cpu_ms() -> f64 {
    let of_thread = |entry: std::io::Result<fs_err::DirEntry>| {
        let text = fs_err::read_to_string(entry.ok()?.path().join("schedstat")).ok()?;
        text.split(' ').next()?.parse::<f64>().ok()
    };
    let Ok(threads) = fs_err::read_dir("/proc/self/task") else { return 0.0 };
    threads.filter_map(of_thread).sum::<f64>() / 1e6
}

/// One pass from files to embeddings.
#[derive(Default)]
struct Pass {
    n_entries: u64,
    n_regions: usize,
    n_groups: usize,
    n_with_evidence: usize,
    index_bytes: u64,
    open: Took,
    read: Took,
    transpose: Took,
    embed: Took,
    /// Entries, Gaussians and milliseconds of processor time of each part's embeddings.
    embedded: Vec<[f64; 3]>,
}

impl Pass {
    fn measure(paths: &[PathBuf], plain: &Plain<'_>) -> Result<Self, ContributionError> {
        let options = plain.options;
        let mut pass = Self::default();
        let (index, table) =
            pass.open.time(|| ContributionIndex::open(paths, options.dim, &plain.n_gaussians_of_cell))?;
        pass.n_entries = index.n_entries();
        pass.n_regions = table.len();
        pass.index_bytes = table.len_bytes() + index.len_bytes();
        let groups = index.groups(options.group_bytes(pass.index_bytes), 1);
        pass.n_groups = groups.len();
        let mut embeddings = vec![0.0; plain.largest_cell() * options.dim];
        for group in groups {
            let raw = pass.read.time(|| index.read(group))?;
            let contributions = pass.transpose.time(|| index.transpose(&raw, &table))?;
            drop(raw);
            for contributions in contributions {
                let locals = contributions.part.locals.clone();
                let n_entries = contributions.part.n_entries;
                let out = &mut embeddings[locals.start * options.dim..locals.end * options.dim];
                let before_ms = pass.embed.cpu_ms;
                let field =
                    pass.embed.time(|| CellField::new(vec![0; locals.len()], contributions, &table, out));
                let cpu_ms = pass.embed.cpu_ms - before_ms;
                pass.n_with_evidence += (0..field.len()).filter(|k| field.has_evidence(*k)).count();
                pass.embedded.push([n_entries as f64, locals.len() as f64, cpu_ms]);
            }
        }
        Ok(pass)
    }
}

impl Pass {
    fn aggregation_ms(&self) -> f64 {
        self.open.wall_ms + self.read.wall_ms + self.transpose.wall_ms
    }
}

struct Report<'a> {
    options: &'a LiftOptions,
    passes: &'a [Pass],
    disk_bytes: u64,
}

impl Report<'_> {
    fn spread(&self, of: impl Fn(&Pass) -> f64) -> Spread {
        Spread::of(self.passes.iter().map(of).collect())
    }

    fn steps(&self) -> Vec<Step> {
        let n_entries = self.passes[0].n_entries.max(1) as f64;
        let n_gaussians = self.options.n_gaussians as f64;
        let vectors = n_gaussians * (self.options.dim * size_of::<f32>()) as f64;
        let table = self.passes[0].index_bytes as f64;
        let step = |name, of: fn(&Pass) -> Took, read: f64, made: f64| {
            let time = self.spread(|pass| of(pass).wall_ms);
            let cpu_ms = self.spread(|pass| of(pass).cpu_ms).median_ms;
            let ns_per_entry = time.median_ms * 1e6 / n_entries;
            let (bytes_read_per_entry, bytes_made_per_entry) = (read / n_entries, made / n_entries);
            Step { name, time, cpu_ms, ns_per_entry, bytes_read_per_entry, bytes_made_per_entry }
        };
        let contributions = n_entries * 8.0;
        vec![
            step(
                "open: heads, regions, index",
                |pass| pass.open,
                self.disk_bytes as f64 - contributions,
                table,
            ),
            step("read: contributions, checksums", |pass| pass.read, contributions, contributions),
            step(
                "transpose: by Gaussian, total weights",
                |pass| pass.transpose,
                2.0 * contributions,
                contributions + 12.0 * n_gaussians,
            ),
            step("embeddings: unit vectors, mean lengths", |pass| pass.embed, contributions, vectors),
        ]
    }

    /// Least squares over the parts of the last pass.
    fn embedding_model(&self) -> EmbeddingModel {
        let rows = self.passes.last().map_or(&[][..], |pass| &pass.embedded);
        let sum = |f: &dyn Fn(&[f64; 3]) -> f64| rows.iter().map(f).sum::<f64>();
        let (ee, eg, gg) = (sum(&|r| r[0] * r[0]), sum(&|r| r[0] * r[1]), sum(&|r| r[1] * r[1]));
        let (et, gt) = (sum(&|r| r[0] * r[2]), sum(&|r| r[1] * r[2]));
        let determinant = ee * gg - eg * eg;
        let (a, b) = ((et * gg - gt * eg) / determinant, (gt * ee - et * eg) / determinant);
        let (ns_per_entry, ns_per_gaussian) =
            if a >= 0.0 && b >= 0.0 { (a * 1e6, b * 1e6) } else { (et / ee * 1e6, 0.0) };
        EmbeddingModel { ns_per_entry, ns_per_gaussian }
    }

    fn plan(&self) -> Plan {
        let (n_gaussians, n_views) = self.options.plan;
        let more_views = n_views as f64 / self.options.n_views as f64;
        let n_entries = (self.passes[0].n_entries as f64 * more_views) as u64;
        let index_bytes = (self.passes[0].index_bytes as f64 * more_views) as u64;
        let cell_bytes = shard::working_bytes(self.options.cell_gaussians.min(n_gaussians), self.options.dim);
        let model = self.embedding_model();
        let embeddings_ns =
            model.ns_per_entry * n_entries as f64 + model.ns_per_gaussian * n_gaussians as f64;
        let aggregation_ms = self.spread(|p| p.open.cpu_ms + p.read.cpu_ms + p.transpose.cpu_ms).median_ms;
        Plan {
            n_gaussians,
            n_views,
            n_entries,
            disk_bytes: (self.disk_bytes as f64 * more_views) as u64,
            index_bytes,
            cell_bytes,
            group_bytes: self.options.memory_bytes.saturating_sub(index_bytes + cell_bytes),
            aggregation_cpu_secs: aggregation_ms * more_views / 1e3,
            embeddings_cpu_secs: embeddings_ns / 1e9,
        }
    }
}

/// Removes the files of contributions, and the folder if nothing else is in it.
///
/// # Errors
/// If a file cannot be removed.
pub fn clean(options: &LiftOptions) -> std::io::Result<()> {
    for path in options.paths().iter().filter(|path| path.exists()) {
        fs_err::remove_file(path)?;
    }
    match fs_err::remove_dir(&options.work_dir) {
        Err(error) if error.kind() == ErrorKind::DirectoryNotEmpty => Ok(()),
        result => result,
    }
}
