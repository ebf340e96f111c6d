//! Figures of the table.

use serde::{Deserialize, Serialize};

use crate::bench::machine::Machine;

/// Figures of an engine at one size.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EngineFigures {
    /// Engine.
    pub engine: String,
    /// Library and version.
    pub library: String,
    /// Gaussians.
    pub n_gaussians: u64,
    /// Seconds to build the index from vectors; absent for shards, which the encoder makes.
    pub build_secs: Option<f64>,
    /// Bytes on disk; absent if nothing is kept there.
    pub disk_bytes: Option<u64>,
    /// Resident memory of the process after the queries.
    pub rss_bytes: Option<u64>,
    /// Load average of the last minute before it was measured: above the number of engines' threads, others shared the
    /// machine.
    pub load_1min: Option<f64>,
    /// Times by number of results.
    pub searches: Vec<SearchFigures>,
}

/// Times for one number of results, from the query's vector to ids and scores.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SearchFigures {
    /// Number of results.
    pub limit: u64,
    /// Timed queries.
    pub n_runs: u64,
    /// Least.
    pub min_ms: f64,
    /// Median.
    pub median_ms: f64,
    /// 99th percentile.
    pub p99_ms: f64,
    /// Share of the true best that is found, mean over the queries; absent where the vectors are not at hand.
    pub recall: Option<f64>,
}

/// Time of the text model.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TextFigures {
    /// The model.
    pub model: String,
    /// The text.
    pub text: String,
    /// Median.
    pub median_ms: f64,
}

/// The table.
#[derive(Clone, Debug, Serialize)]
pub struct RobotReport {
    /// The machine.
    pub machine: Machine,
    /// Components of an embedding.
    pub dim: u32,
    /// Sizes, as asked for.
    pub sizes: Vec<u64>,
    /// Numbers of results.
    pub limits: Vec<u64>,
    /// Text model.
    pub texts: Vec<TextFigures>,
    /// All figures, by size and engine.
    pub figures: Vec<EngineFigures>,
    /// What was not run, and why.
    pub not_run: Vec<String>,
}

/// The paper's table: Qdrant on a Jetson Orin (Szilagyi et al. 2025), seconds by 1, 2, 4 and 8 million Gaussians.
pub(super) const PAPER: [(&str, [f64; 4]); 8] = [
    ("1,000 results, s", [0.02, 0.02, 0.02, 0.03]),
    ("10,000", [0.09, 0.11, 0.12, 0.23]),
    ("50,000", [0.43, 0.64, 1.16, 1.32]),
    ("100,000", [0.52, 0.74, 1.36, 2.37]),
    ("PyTorch, dense, s", [0.05, 0.09, 0.17, 0.33]),
    ("Qdrant, RAM, GB", [2.9, 4.9, 9.2, 17.7]),
    ("Qdrant, disk, GB", [0.8, 1.3, 2.3, 4.3]),
    ("PyTorch, RAM, GB", [2.0, 4.0, 8.0, 16.0]),
];
