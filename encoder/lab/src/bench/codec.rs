//! Bytes against score error: the curve of the codebook and its residual code, compared with 8-bit vectors and product
//! quantisation, over the embeddings of a published scene or of a generated field.

use std::fmt;
use std::path::PathBuf;

use rayon::prelude::*;
use serde::Serialize;
use slag_common::container::AlignedBytes;
use slag_common::shard::{Profile, ShardLayout};
use slag_common::{Gaussians, Hash32};

use super::machine::Machine;
use super::plot::{Plot, Scale, Series, Style};
use super::timing::timed_ms;
use crate::generate::field::Field;
use slag_encoder::cells::{CellLimits, PositionError, split};
use slag_encoder::codebook::residual::trained;
use slag_encoder::codebook::{CodebookSettings, ScoreMetric, ScoreMetricContext, TextBank};
use slag_encoder::shard::{self, CellEmbeddings, CellExtras, ShardSettings};
use slag_encoder::store::{StoreError, StoreReader};
use slag_math::matrix::{Panels, Rows};
use slag_math::stats::{Rank, quantile};

/// Number of texts with compared rankings.
const N_RANKED: usize = 100;
/// Lengths of the rankings.
const RANKS: [usize; 2] = [1_000, 10_000];
/// Requested errors of the compact profile, relative to the spread.
const COMPACT_ERRORS: [f32; 5] = [0.3, 0.2, 0.14, 0.1, 0.07];
/// Requested errors of the balanced profile.
const BALANCED_ERRORS: [f32; 5] = [0.08, 0.06, 0.04, 0.025, 0.015];
/// Bytes per vector of the product quantiser.
const PRODUCT_BYTES: [usize; 4] = [8, 16, 32, 64];

/// Source of the embeddings.
#[derive(Clone, Debug)]
pub enum Source {
    /// The exact shards of a store.
    Store(PathBuf),
    /// A generated field: number of Gaussians and of components.
    Generated(usize, usize),
}

/// Error of the benchmark.
#[derive(Debug, thiserror::Error)]
pub enum CodecError {
    /// The store cannot be read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A cell has no exact embeddings.
    #[error("{}: cell {cell_id} has no valid exact shard; encode with --profiles compact,balanced,exact", path.display())]
    NoExact {
        /// The store.
        path: PathBuf,
        /// The cell.
        cell_id: u32,
    },
}

/// Figures of a codec with one setting.
#[derive(Clone, Debug, Serialize)]
pub struct Point {
    /// The codec.
    pub codec: &'static str,
    /// Its setting.
    pub setting: String,
    /// Bytes per Gaussian without the position, tables and codebooks included.
    pub embedding_bytes: f64,
    /// Bytes per Gaussian with the position; for shards, of the whole file.
    pub bytes: f64,
    /// Mean of |score error| relative to the spread of scores.
    pub mean_error: f64,
    /// 99.9th percentile of the same.
    pub p999_error: f64,
    /// Maximum of the same.
    pub max_error: f64,
    /// Recall of the best Gaussians of a text, for each of [`CodecReport::ranks`].
    pub recall: [f64; 2],
    /// Gaussians coded per second on all threads; for shards, the writing of the file included.
    pub gaussians_per_sec: f64,
}

/// The curves.
#[derive(Clone, Debug, Serialize)]
pub struct CodecReport {
    /// The machine.
    pub machine: Machine,
    /// Title of the plot.
    pub title: String,
    /// Gaussians with an embedding.
    pub n_gaussians: usize,
    /// Components of an embedding.
    pub dim: usize,
    /// Texts in the bank.
    pub n_texts: usize,
    /// Standard deviation of a text's scores over the Gaussians, averaged over the texts.
    pub spread: f64,
    /// Lengths of the rankings that recall is measured on.
    pub ranks: [usize; 2],
    /// Figures of each codec and setting.
    pub points: Vec<Point>,
}

/// A scene's embeddings, cell after cell.
struct Embeddings {
    dim: usize,
    /// `[n][dim]`.
    vectors: Vec<f32>,
    /// Gaussians of each cell.
    cells: Vec<usize>,
}

/// Measures the curves. `bank` is in the space of a store's embeddings; a generated field has its own.
///
/// # Errors
/// [`CodecError`].
pub fn run(source: &Source, bank: TextBank, title: &str) -> Result<CodecReport, CodecError> {
    let (embeddings, bank) = match source {
        Source::Store(path) => (read(path)?, bank),
        Source::Generated(n, dim) => {
            let field = Field::new(*n, *dim);
            let cells = vec![field.cell_gaussians(); *n / field.cell_gaussians()];
            let vectors: Vec<f32> = (0..cells.len()).flat_map(|cell| field.embeddings(cell)).collect();
            (Embeddings { dim: *dim, vectors, cells }, field.texts())
        }
    };
    let metric = ScoreMetric::new(embeddings.dim, &bank);
    let rows = Rows::all(&embeddings.vectors, embeddings.dim);
    let score_context = ScoreMetricContext { spread: metric.spread(rows), metric, bank };
    let truth = Truth::new(&embeddings, &score_context.bank);
    let mut points = Vec::new();
    let settings = |profile: Profile, compact: f32, balanced: f32| CodebookSettings {
        compact_error: compact,
        balanced_error: balanced,
        max_subspaces: if profile == Profile::Compact { 2 } else { 64 },
        min_gaussians_per_centroid: 16,
        ..CodebookSettings::default()
    };
    for error in COMPACT_ERRORS {
        points.push(shards(
            &embeddings,
            &score_context,
            &truth,
            Profile::Compact,
            settings(Profile::Compact, error, error),
        ));
    }
    for error in BALANCED_ERRORS {
        points.push(shards(
            &embeddings,
            &score_context,
            &truth,
            Profile::Balanced,
            settings(Profile::Balanced, 0.1, error),
        ));
    }
    let default = CodebookSettings::default();
    points.push(shards(&embeddings, &score_context, &truth, Profile::Compact, default));
    points.push(shards(&embeddings, &score_context, &truth, Profile::Balanced, default));
    points.push(int8(&embeddings, &truth));
    points.extend(
        PRODUCT_BYTES
            .into_iter()
            .filter(|n| embeddings.dim.is_multiple_of(*n))
            .map(|n| product(&embeddings, &truth, n)),
    );
    Ok(CodecReport {
        machine: Machine::here(),
        title: title.to_owned(),
        n_gaussians: embeddings.vectors.len() / embeddings.dim,
        dim: embeddings.dim,
        n_texts: score_context.bank.len(),
        spread: f64::from(truth.spread),
        ranks: truth.ranks,
        points,
    })
}

fn read(path: &std::path::Path) -> Result<Embeddings, CodecError> {
    let reader = StoreReader::open(path)?;
    let mut all =
        Embeddings { dim: reader.manifest().encoder.dim as usize, vectors: Vec::new(), cells: Vec::new() };
    for cell in &reader.manifest().cells {
        let missing = || CodecError::NoExact { path: path.to_owned(), cell_id: cell.cell_id };
        let record = cell.shards.get(&Profile::Exact).ok_or_else(missing)?;
        let bytes = reader.read_object(record.hash)?;
        let shard = ShardLayout::check(&bytes).map_err(|_| missing())?;
        let exact = shard.view(&bytes).exact.ok_or_else(missing)?;
        all.vectors.extend(exact.embeddings.iter().map(|v| v.to_f32()));
        all.cells.push(exact.embeddings.len() / all.dim);
    }
    Ok(all)
}

/// True scores and rankings.
struct Truth<'a> {
    dim: usize,
    vectors: &'a [f32],
    texts: Panels,
    n_texts: usize,
    spread: f32,
    /// Vectors of the ranked texts.
    ranked: Vec<f32>,
    ranks: [usize; 2],
    /// Best Gaussians of each ranked text, for each length.
    best: Vec<[Vec<u32>; 2]>,
}

impl<'a> Truth<'a> {
    fn new(embeddings: &'a Embeddings, bank: &TextBank) -> Self {
        let dim = embeddings.dim;
        let n = embeddings.vectors.len() / dim;
        let texts = Panels::new(dim, bank.len(), |c, text| bank.vectors[text * dim + c]);
        let sample: Vec<u32> = (0..n as u32).step_by(n.div_ceil(8192).max(1)).collect();
        let scores = texts.product(Rows { values: &embeddings.vectors, width: dim, index: Some(&sample) });
        let spread = slag_encoder::codebook::measure::spread(&scores, bank.len());
        let stride = bank.len().div_ceil(N_RANKED).max(1);
        let ranked: Vec<f32> = bank.vectors.chunks_exact(dim).step_by(stride).flatten().copied().collect();
        // A ranking that held most Gaussians would hardly tell codecs apart.
        let ranks = RANKS.map(|rank| rank.min(n / 4).max(1));
        let best = rankings(&embeddings.vectors, dim, &ranked, ranks);
        Self { dim, vectors: &embeddings.vectors, texts, n_texts: bank.len(), spread, ranked, ranks, best }
    }

    /// Returns errors (mean, 99.9th percentile, maximum) and recall of decoded embeddings, in the order of the true ones.
    fn judge(&self, decoded: &[f32]) -> ([f64; 3], [f64; 2]) {
        let n = self.vectors.len() / self.dim;
        let sample = (0..n).step_by(n.div_ceil(4096).max(1));
        let missed: Vec<f32> = sample
            .flat_map(|k| (k * self.dim..(k + 1) * self.dim).map(|at| self.vectors[at] - decoded[at]))
            .collect();
        let mut errors = self.texts.product(Rows::all(&missed, self.dim));
        errors.iter_mut().for_each(|e| *e = e.abs());
        let mean = errors
            .chunks(self.n_texts)
            .map(|row| row.iter().map(|e| f64::from(*e)).sum::<f64>())
            .sum::<f64>()
            / errors.len() as f64;
        let max = errors.iter().copied().fold(0.0, f32::max);
        let p999 = quantile(&mut errors, 999, Rank::After).unwrap_or_default();
        let found = rankings(decoded, self.dim, &self.ranked, self.ranks);
        let recall = |rank: usize| {
            let shares = self.best.iter().zip(&found).map(|(truth, found)| {
                let (truth, found) = (&truth[rank], &found[rank]);
                let both = found.iter().filter(|k| truth.binary_search(k).is_ok()).count();
                both as f64 / truth.len() as f64
            });
            shares.sum::<f64>() / self.best.len() as f64
        };
        let spread = f64::from(self.spread);
        ([mean / spread, f64::from(p999) / spread, f64::from(max) / spread], [recall(0), recall(1)])
    }
}

/// Returns the best Gaussians of each text for each rank, in ascending order; ties are broken by index.
fn rankings(vectors: &[f32], dim: usize, texts: &[f32], ranks: [usize; 2]) -> Vec<[Vec<u32>; 2]> {
    let n_texts = texts.len() / dim;
    let panels = Panels::new(dim, n_texts, |c, text| texts[text * dim + c]);
    let scores = panels.product(Rows::all(vectors, dim));
    (0..n_texts)
        .into_par_iter()
        .map(|text| {
            let score = |k: &u32| scores[*k as usize * n_texts + text];
            let mut order: Vec<u32> = (0..(vectors.len() / dim) as u32).collect();
            ranks.map(|rank| {
                order.select_nth_unstable_by(rank - 1, |a, b| score(b).total_cmp(&score(a)).then(a.cmp(b)));
                let mut best = order[..rank].to_vec();
                best.sort_unstable();
                best
            })
        })
        .collect()
}

/// Codes the scene into shards as the encoder does, and decodes them as the robot does.
fn shards(
    embeddings: &Embeddings,
    score_context: &ScoreMetricContext,
    truth: &Truth<'_>,
    profile: Profile,
    codebook: CodebookSettings,
) -> Point {
    let dim = embeddings.dim;
    let settings =
        ShardSettings { profiles: vec![profile], codebook, input_indices: false, appearance: false };
    let mut decoded = vec![0.0f32; embeddings.vectors.len()];
    let (mut bytes, mut position_bytes, mut ms, mut first) = (0, 0, 0.0, 0);
    let (mut n_centroids, mut n_subspaces) = (0, 0);
    for n in &embeddings.cells {
        // Positions do not matter here: all cells get the same cube of 20 m.
        let scene = Gaussians {
            means_in_world: (0..*n as u64).map(crate::generate::field::place_in_cube).collect(),
            scales: vec![[0.01; 3]; *n],
            rotations_wxyz: vec![[1.0, 0.0, 0.0, 0.0]; *n],
            opacities: vec![1.0; *n],
            sh_dc: vec![[0.0; 3]; *n],
            ..Gaussians::default()
        };
        let position_error = PositionError::Within(0.01);
        let cells = split(&scene, CellLimits { position_error, ..CellLimits::by_count(*n) });
        let locals = &cells.cells[0].gaussians;
        let in_order: Vec<f32> = locals
            .iter()
            .flat_map(|k| &embeddings.vectors[(first + *k as usize) * dim..][..dim])
            .copied()
            .collect();
        let cell = CellEmbeddings { dim, vectors: in_order, has_evidence: vec![true; *n] };
        let (id, extras) = (Hash32([0; 32]), CellExtras::default());
        let (built, took) = timed_ms(|| {
            shard::build(&scene, 0, &cells.cells[0], &cell, id, score_context, &settings, &extras)
        });
        ms += took;
        n_centroids += built.n_centroids;
        n_subspaces = n_subspaces.max(built.n_subspaces);
        let file = AlignedBytes::copy_of(&built.shards[0].bytes);
        bytes += file.len();
        let layout = ShardLayout::check(&file).expect("just made");
        let view = layout.view(&file);
        position_bytes += n * 4;
        // Shards reorder Gaussians; positions are distinct and identify them.
        let index = crate::generate::field::index_by_position(&scene, &view);
        let rows: Vec<(usize, Vec<f32>)> = (0..*n)
            .into_par_iter()
            .map_init(
                || vec![0.0f64; dim],
                |out, k| {
                    view.decode(k, out);
                    (first + index[k] as usize, out.iter().map(|v| *v as f32).collect())
                },
            )
            .collect();
        for (k, row) in rows {
            decoded[k * dim..][..dim].copy_from_slice(&row);
        }
        first += n;
    }
    let (errors, recall) = truth.judge(&decoded);
    let n = first as f64;
    Point {
        codec: profile.name(),
        setting: format!(
            "error {} / {}: {n_centroids} centroids, {n_subspaces} subspaces",
            codebook.compact_error, codebook.balanced_error
        ),
        embedding_bytes: (bytes - position_bytes) as f64 / n,
        bytes: bytes as f64 / n,
        mean_error: errors[0],
        p999_error: errors[1],
        max_error: errors[2],
        recall,
        gaussians_per_sec: n / (ms / 1e3),
    }
}

/// Codes every component in 8 bits, with one step per vector.
fn int8(embeddings: &Embeddings, truth: &Truth<'_>) -> Point {
    let mut decoded = embeddings.vectors.clone();
    let ((), ms) = timed_ms(|| {
        decoded.par_chunks_exact_mut(embeddings.dim).for_each(|vector| {
            let (values, step) = slag_common::shard::quantise(vector);
            vector.iter_mut().zip(values).for_each(|(v, q)| *v = f32::from(q) * step);
        });
    });
    let (errors, recall) = truth.judge(&decoded);
    point(
        "int8",
        "one step per vector".into(),
        embeddings.dim as f64 + 4.0,
        errors,
        recall,
        decoded.len() / embeddings.dim,
        ms,
    )
}

/// Codes by product quantisation (Jegou, Douze and Schmid 2011): `n_bytes` subspaces of equal width with 256 codewords
/// each, one codebook for the scene.
fn product(embeddings: &Embeddings, truth: &Truth<'_>, n_bytes: usize) -> Point {
    let dim = embeddings.dim;
    let width = dim / n_bytes;
    let n = embeddings.vectors.len() / dim;
    let mut decoded = vec![0.0; embeddings.vectors.len()];
    let ((), ms) = timed_ms(|| {
        for subspace in 0..n_bytes {
            let points: Vec<f32> = embeddings
                .vectors
                .chunks_exact(dim)
                .flat_map(|v| &v[subspace * width..][..width])
                .copied()
                .collect();
            let stride = n.div_ceil(16_384).max(1);
            let sample: Vec<u32> = (0..n as u32).step_by(stride).collect();
            let codewords = trained(Rows { values: &points, width, index: Some(&sample) }, 256);
            let codes = slag_encoder::codebook::cluster::nearest(Rows::all(&points, width), &codewords);
            for (vector, code) in decoded.chunks_exact_mut(dim).zip(codes) {
                vector[subspace * width..][..width]
                    .copy_from_slice(&codewords[code as usize * width..][..width]);
            }
        }
    });
    let (errors, recall) = truth.judge(&decoded);
    // The codebook in f16.
    let bytes = n_bytes as f64 + (256 * dim * 2) as f64 / n as f64;
    point("product", format!("{n_bytes} bytes"), bytes, errors, recall, n, ms)
}

fn point(
    codec: &'static str,
    setting: String,
    embedding_bytes: f64,
    errors: [f64; 3],
    recall: [f64; 2],
    n: usize,
    ms: f64,
) -> Point {
    let [mean_error, p999_error, max_error] = errors;
    // With a packed position, as in shards.
    let bytes = embedding_bytes + 4.0;
    let gaussians_per_sec = n as f64 / (ms / 1e3);
    Point {
        codec,
        setting,
        embedding_bytes,
        bytes,
        mean_error,
        p999_error,
        max_error,
        recall,
        gaussians_per_sec,
    }
}

impl CodecReport {
    /// Returns the curves as SVG: mean error over bytes per Gaussian, both logarithmic.
    pub fn svg(&self) -> String {
        let names = ["compact", "balanced", "int8", "product"];
        let series = names.map(|name| {
            let of_name = self.points.iter().filter(|p| p.codec == name);
            let mut points: Vec<(f64, f64)> = of_name.map(|p| (p.bytes, p.mean_error)).collect();
            points.sort_by(|a, b| a.0.total_cmp(&b.0));
            Series { name: name.into(), style: Style::Line, points, labels: Vec::new(), spreads: Vec::new() }
        });
        let plot = Plot {
            note: String::new(),
            title: format!("{}: {} Gaussians, {} texts", self.title, self.n_gaussians, self.n_texts),
            across: "bytes per Gaussian, position included",
            up: "mean |score error| / spread of scores",
            up_scale: Scale::Logarithmic,
        };
        plot.svg(&series)
    }
}

impl fmt::Display for CodecReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{}: {} Gaussians, {} texts, spread {:.4}",
            self.title, self.n_gaussians, self.n_texts, self.spread
        )?;
        let [a, b] = self.ranks;
        writeln!(
            f,
            "{:<9} {:<42} {:>7} {:>8} {:>8} {:>8} {:>8} {:>8} {:>10}",
            "codec",
            "setting",
            "bytes",
            "mean",
            "p99.9",
            "max",
            format!("@{a}"),
            format!("@{b}"),
            "per s"
        )?;
        for p in &self.points {
            writeln!(
                f,
                "{:<9} {:<42} {:>7.2} {:>8.4} {:>8.3} {:>8.3} {:>8.3} {:>8.3} {:>10.0}",
                p.codec,
                p.setting,
                p.bytes,
                p.mean_error,
                p.p999_error,
                p.max_error,
                p.recall[0],
                p.recall[1],
                p.gaussians_per_sec
            )?;
        }
        Ok(())
    }
}
