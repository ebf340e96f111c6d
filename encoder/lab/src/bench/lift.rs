//! `bench lift`: from files of contributions to embeddings, on a made-up scene of any size.
//!
//! The scene is a plain of Gaussians, numbered along a Morton curve as those of a cell are. A view
//! sees a square of it, cut into a grid of regions; of the Gaussians in the square some are hidden,
//! and those near a border have contributions in two or four regions.

use std::fmt;
use std::io::ErrorKind;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use rayon::prelude::*;
use serde::Serialize;

use super::{Machine, Spread, timed_ms};
use slag_encoder::lift::{CellField, Contribution, ContributionError, ContributionIndex, ViewContributions};
use slag_encoder::shard;
use slag_math::random::mix64;

/// Gaussians of the square in which they are enumerated, a power of four.
const BLOCK: u64 = 4096;
/// Share of the Gaussians in a view's square that are not hidden.
const SHARE_IN_SIGHT: f64 = 0.6;
/// Levels of masks, from wholes to parts: so many masks cover a region.
const LEVELS: usize = 4;
/// Regions a mask: where masks of several levels overlap.
const REGIONS_PER_MASK: usize = 3;

/// What is measured.
#[derive(Clone, Debug, Serialize)]
pub struct LiftOptions {
    /// Gaussians.
    pub n_gaussians: usize,
    /// Views.
    pub n_views: usize,
    /// Masks a view.
    pub n_masks: usize,
    /// Gaussians that have a sum, a view.
    pub n_visible: usize,
    /// Sums of each of these, about.
    pub entries_per_visible: f64,
    /// Components of an embedding.
    pub dim: usize,
    /// Gaussians a cell at most.
    pub cell_gaussians: usize,
    /// Working memory, as `encode --memory`.
    pub memory_bytes: u64,
    /// Times that everything is done.
    pub n_repeats: usize,
    /// Folder for the files of contributions; made if absent.
    pub work_dir: PathBuf,
    /// Gaussians and views of the scene that a plan is made for.
    pub plan: (usize, usize),
}

/// One step, over all repeats.
#[derive(Clone, Debug, Serialize)]
pub struct Step {
    /// What is done.
    pub name: &'static str,
    /// Milliseconds.
    pub time: Spread,
    /// Milliseconds of processor time, median over the repeats: what counts where others are at work too.
    pub cpu_ms: f64,
    /// Nanoseconds an entry, of the median.
    pub ns_per_entry: f64,
    /// Bytes an entry that it reads from the page cache or from memory.
    pub bytes_read_per_entry: f64,
    /// Bytes an entry that it leaves in memory.
    pub bytes_made_per_entry: f64,
}

/// What a scene of another size would take, from the figures of this run. An estimate.
#[derive(Clone, Debug, Serialize)]
pub struct Plan {
    /// Gaussians.
    pub n_gaussians: usize,
    /// Views, each with as many entries as here.
    pub n_views: usize,
    /// Entries of all views.
    pub n_entries: u64,
    /// Bytes of the files of contributions, read once.
    pub disk_bytes: u64,
    /// Bytes of mask vectors, regions and index.
    pub index_bytes: u64,
    /// Bytes of the largest cell's embeddings, codebook and shard.
    pub cell_bytes: u64,
    /// Bytes that `--memory` leaves for contributions at a time.
    pub group_bytes: u64,
    /// Seconds of one processor to open, read and transpose.
    pub aggregation_cpu_secs: f64,
    /// Seconds of one processor to compute the embeddings.
    pub embeddings_cpu_secs: f64,
}

/// What was measured.
#[derive(Clone, Debug, Serialize)]
pub struct LiftReport {
    /// Where.
    pub machine: Machine,
    /// Of what.
    pub options: LiftOptions,
    /// Entries of all views.
    pub n_entries: u64,
    /// Gaussians that have a sum, a view, as they came out.
    pub visible_per_view: f64,
    /// Regions of all views.
    pub n_regions: usize,
    /// Cells.
    pub n_cells: usize,
    /// Groups of cells that were transposed at a time.
    pub n_subspaces: usize,
    /// Gaussians with an embedding.
    pub n_with_evidence: usize,
    /// Bytes of the files of contributions.
    pub disk_bytes: u64,
    /// Seconds to make and write them, which is no part of the aggregation.
    pub write_secs: f64,
    /// The steps.
    pub steps: Vec<Step>,
    /// Files of contributions to contributions by Gaussian, with total weights: open, read, transpose.
    pub aggregation: Spread,
    /// That, and each Gaussian's embedding and its length.
    pub with_embeddings: Spread,
    /// What the embeddings' processor time is made of.
    pub embedding_model: EmbeddingModel,
    /// Most memory that the process held during the aggregation.
    pub peak_rss_bytes: Option<u64>,
    /// What it held before.
    pub rss_before_bytes: Option<u64>,
    /// What a larger scene would take.
    pub plan: Plan,
}

/// Processor time of the embeddings: so much an entry, so much a Gaussian.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct EmbeddingModel {
    /// Nanoseconds an entry.
    pub ns_per_entry: f64,
    /// Nanoseconds a Gaussian.
    pub ns_per_gaussian: f64,
}

/// Makes the files, measures, and plans.
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

    // Linux counts the peak from here on; elsewhere it is of the whole run.
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
        n_subspaces: passes[0].n_subspaces,
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

/// Returns a line of Linux's account of this process.
fn status_bytes(key: &str) -> Option<u64> {
    let status = fs_err::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix(':'))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? * 1024)
}

/// Milliseconds that passed, and milliseconds of processor time of all threads.
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

/// Returns the processor time of the process; 0 where the system does not say.
fn cpu_ms() -> f64 {
    let of_thread = |entry: std::io::Result<fs_err::DirEntry>| {
        let text = fs_err::read_to_string(entry.ok()?.path().join("schedstat")).ok()?;
        text.split(' ').next()?.parse::<f64>().ok()
    };
    let Ok(threads) = fs_err::read_dir("/proc/self/task") else { return 0.0 };
    threads.filter_map(of_thread).sum::<f64>() / 1e6
}

/// The way from files to embeddings, once.
#[derive(Default)]
struct Pass {
    n_entries: u64,
    n_regions: usize,
    n_subspaces: usize,
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
        let groups = index.groups(options.group_bytes(pass.index_bytes));
        pass.n_subspaces = groups.len();
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

impl LiftOptions {
    fn paths(&self) -> Vec<PathBuf> {
        (0..self.n_views).map(|view| self.work_dir.join(format!("{view:05}.contributions"))).collect()
    }

    fn group_bytes(&self, index_bytes: u64) -> u64 {
        let cell_bytes = shard::working_bytes(self.cell_gaussians.min(self.n_gaussians), self.dim);
        self.memory_bytes.saturating_sub(cell_bytes + index_bytes)
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

/// A plain of Gaussians, and what views see of it.
struct Plain<'a> {
    options: &'a LiftOptions,
    n_gaussians_of_cell: Vec<usize>,
    /// Points of the square lattice along an edge, a power of two.
    edge: u64,
}

impl<'a> Plain<'a> {
    fn new(options: &'a LiftOptions) -> Self {
        let n = options.n_gaussians;
        // As a split at medians does: halves, until they are small enough.
        let mut n_cells = 1;
        while n.div_ceil(n_cells) > options.cell_gaussians.max(1) {
            n_cells *= 2;
        }
        let bound = |cell: usize| (cell as u128 * n as u128 / n_cells as u128) as usize;
        let n_gaussians_of_cell = (0..n_cells).map(|cell| bound(cell + 1) - bound(cell)).collect();
        let mut edge = 64;
        while edge * edge < n as u64 {
            edge *= 2;
        }
        Self { options, n_gaussians_of_cell, edge }
    }

    fn largest_cell(&self) -> usize {
        self.n_gaussians_of_cell.iter().copied().max().unwrap_or(0)
    }

    /// Returns the first Gaussian at or behind a place along the curve.
    fn gaussian_at(&self, place: u64) -> u64 {
        let n_places = u128::from(self.edge) * u128::from(self.edge);
        (u128::from(place) * self.options.n_gaussians as u128).div_ceil(n_places) as u64
    }

    fn place_of(&self, gaussian: u64) -> u64 {
        let n_places = u128::from(self.edge) * u128::from(self.edge);
        (u128::from(gaussian) * n_places / self.options.n_gaussians as u128) as u64
    }

    /// Returns a view's contributions, and how many Gaussians have any.
    fn view(&self, view: u64) -> (ViewContributions, u64) {
        let LiftOptions { n_gaussians, n_visible, n_masks, entries_per_visible, dim, .. } = *self.options;
        let share = (n_visible as f64 / SHARE_IN_SIGHT / n_gaussians as f64).min(1.0);
        let width = (share.sqrt() * self.edge as f64).max(1.0);
        let corner = |axis| uniform(view, axis) * (self.edge as f64 - width);
        let (left, top) = (corner(1), corner(2));
        let n_across = (((n_masks * REGIONS_PER_MASK) as f64).sqrt() as u32).max(1);
        // A border of this share of a region on two sides: (1 + b)^2 contributions a Gaussian.
        let border = entries_per_visible.sqrt() - 1.0;
        let mut entries_of_cell: Vec<(u32, Vec<Contribution>)> = Vec::new();
        let (mut cell, mut first_of_cell, mut n_seen) = (0, 0, 0);
        let overlaps = |from: f64, low: u64| from < (low + 64) as f64 && low as f64 <= from + width;
        for block in 0..self.edge * self.edge / BLOCK {
            let (x, y) = (compact_bits(block) * 64, compact_bits(block >> 1) * 64);
            if !overlaps(left, x) || !overlaps(top, y) {
                continue;
            }
            for gaussian in self.gaussian_at(block * BLOCK)..self.gaussian_at((block + 1) * BLOCK) {
                let place = self.place_of(gaussian);
                let u = (compact_bits(place) as f64 - left) / width;
                let v = (compact_bits(place >> 1) as f64 - top) / width;
                let random = mix64(view << 40 ^ gaussian);
                if !(0.0..1.0).contains(&u)
                    || !(0.0..1.0).contains(&v)
                    || (random >> 40) as f64 >= SHARE_IN_SIGHT * (1u64 << 24) as f64
                {
                    continue;
                }
                n_seen += 1;
                while gaussian >= first_of_cell + self.n_gaussians_of_cell[cell] as u64 {
                    first_of_cell += self.n_gaussians_of_cell[cell] as u64;
                    cell += 1;
                }
                if entries_of_cell.last().is_none_or(|(last, _)| *last != cell as u32) {
                    entries_of_cell.push((cell as u32, Vec::new()));
                }
                let Some((_, entries)) = entries_of_cell.last_mut() else { continue };
                let columns = neighbours(u * f64::from(n_across), border);
                for row in neighbours(v * f64::from(n_across), border) {
                    for column in columns.clone() {
                        let exponent = (mix64(random ^ u64::from(row * 3 + column)) >> 48) as f32 / 65536.0;
                        let weight = 10f32.powf(exponent * 4.5 - 3.0);
                        let local = (gaussian - first_of_cell) as u32;
                        entries.push(Contribution { local, region: row * n_across + column, weight });
                    }
                }
            }
        }
        let per_level = (n_masks / LEVELS).max(1) as u64;
        let masks = |region: u64| {
            let mask = |level| (level * per_level + mix64(region << 8 ^ level) % per_level) as u32;
            (0..LEVELS.min(n_masks) as u64).map(mask).collect()
        };
        let masks_of_region = (0..u64::from(n_across * n_across)).map(masks).collect();
        let mask_vectors = (0..n_masks as u64).flat_map(|mask| unit_vector(view << 20 ^ mask, dim)).collect();
        (ViewContributions { dim, mask_vectors, masks_of_region, entries_of_cell }, n_seen)
    }
}

/// Returns the regions along an axis that a Gaussian at `at` has contributions in, ascending.
fn neighbours(at: f64, border: f64) -> std::ops::RangeInclusive<u32> {
    let own = at as u32;
    let reaches_before = own > 0 && at - f64::from(own) < border;
    own - u32::from(reaches_before)..=own
}

/// Returns a unit vector near a common direction, as those of one encoder are.
fn unit_vector(seed: u64, dim: usize) -> Vec<f32> {
    let component = |c: u64| 0.5 * uniform(7, c) + uniform(mix64(seed), c) - 0.75;
    let raw: Vec<f64> = (0..dim as u64).map(component).collect();
    let length = raw.iter().map(|c| c * c).sum::<f64>().sqrt();
    raw.into_iter().map(|c| (c / length) as f32).collect()
}

fn uniform(seed: u64, index: u64) -> f64 {
    (mix64(seed.wrapping_mul(0x2545_f491_4f6c_dd1d) ^ index) >> 11) as f64 / (1u64 << 53) as f64
}

/// Gathers every second bit: a coordinate of a place along the Morton curve.
fn compact_bits(place: u64) -> u64 {
    let mut v = place & 0x5555_5555_5555_5555;
    v = (v | v >> 1) & 0x3333_3333_3333_3333;
    v = (v | v >> 2) & 0x0f0f_0f0f_0f0f_0f0f;
    v = (v | v >> 4) & 0x00ff_00ff_00ff_00ff;
    v = (v | v >> 8) & 0x0000_ffff_0000_ffff;
    (v | v >> 16) & 0xffff_ffff
}

/// Removes the files of contributions, and the folder if nothing else is in it.
///
/// # Errors
/// Whatever the file system gives.
pub fn clean(options: &LiftOptions) -> std::io::Result<()> {
    for path in options.paths().iter().filter(|path| path.exists()) {
        fs_err::remove_file(path)?;
    }
    match fs_err::remove_dir(&options.work_dir) {
        Err(error) if error.kind() == ErrorKind::DirectoryNotEmpty => Ok(()),
        result => result,
    }
}

impl fmt::Display for LiftReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let LiftOptions { n_gaussians, n_views, n_masks, dim, .. } = self.options;
        let gb = |bytes: u64| bytes as f64 / 1e9;
        writeln!(
            f,
            "{n_gaussians} Gaussians, {n_views} views of {n_masks} masks, {dim} components: {} entries, {:.2} GB; {}",
            self.n_entries,
            gb(self.disk_bytes),
            self.machine.cpu
        )?;
        for step in &self.steps {
            writeln!(
                f,
                "{:<42} {:>9.0} ms  {:>6.2} ns an entry  {:>9.0} ms of processor time",
                step.name, step.time.median_ms, step.ns_per_entry, step.cpu_ms
            )?;
        }
        writeln!(f, "{:<42} {:>9.0} ms", "aggregation: open, read, transpose", self.aggregation.median_ms)?;
        writeln!(f, "{:<42} {:>9.0} ms", "with embeddings", self.with_embeddings.median_ms)?;
        if let Some(peak) = self.peak_rss_bytes {
            writeln!(
                f,
                "{:<42} {:>9.2} GB of {:.2} GB",
                "peak memory",
                gb(peak),
                gb(self.options.memory_bytes)
            )?;
        }
        let plan = &self.plan;
        writeln!(
            f,
            "estimate for {} Gaussians, {} views: {} entries, {:.1} GB on disk read once, none written; \
             aggregation {:.1} s and embeddings {:.1} s of one processor; memory {:.2} GB for the index, {:.2} GB for a cell",
            plan.n_gaussians,
            plan.n_views,
            plan.n_entries,
            gb(plan.disk_bytes),
            plan.aggregation_cpu_secs,
            plan.embeddings_cpu_secs,
            gb(plan.index_bytes),
            gb(plan.cell_bytes)
        )
    }
}
