//! Times an engine on vectors and queries written by `slag-lab bench query --dump DIR`. `slag-lab bench robot` runs
//! it once per engine, so that memory is not shared, and judges the answers.

mod dense;
mod dump;
mod measure;
mod qdrant;

use std::path::PathBuf;

use anyhow::{Result, ensure};
use clap::{Parser, ValueEnum};
use serde::Serialize;

use dump::Dump;

/// Times an engine on a dump of vectors and queries.
#[derive(Debug, Parser)]
pub struct Args {
    /// Folder with vectors.f32, queries.f32 and meta.json.
    #[arg(long, value_name = "DIR")]
    dump: PathBuf,
    /// The engine.
    #[arg(long, value_enum)]
    engine: Engine,
    /// Folder for the index; created, and removed at the end [default: ENGINE in the dump].
    #[arg(long, value_name = "DIR")]
    work: Option<PathBuf>,
    /// Numbers of results.
    #[arg(long, value_name = "N,...", value_delimiter = ',', default_values_t = [1_000, 10_000, 50_000, 100_000])]
    limits: Vec<usize>,
    /// Timed searches per limit; queries take turns.
    #[arg(long, default_value_t = 20)]
    runs: usize,
    /// Untimed searches before them.
    #[arg(long, default_value_t = 2)]
    warm_up: usize,
    /// Folder for the ids that each search found, as little-endian u32, best first: ENGINE-LIMIT-QUERY.u32.
    #[arg(long, value_name = "DIR")]
    ids: Option<PathBuf>,
}

/// An engine and its settings. Graphs have 16 edges a node and a list of 100 candidates while they are built.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
enum Engine {
    /// All products in f32, then the best.
    Dense,
    /// qdrant-edge without a graph, f32.
    QdrantScan,
    /// qdrant-edge without a graph, int8, not scored again.
    QdrantScanInt8,
    /// qdrant-edge with HNSW, f32.
    QdrantHnsw,
    /// qdrant-edge with HNSW, int8, not scored again.
    QdrantHnswInt8,
    /// qdrant-edge with HNSW and product quantisation to a sixteenth, not scored again.
    QdrantHnswPq,
}

impl Engine {
    fn name(self) -> String {
        self.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned())
    }

    fn library(self) -> String {
        match self {
            Self::Dense => "plain f32 loop".into(),
            _ => "qdrant-edge 0.7.2".into(),
        }
    }
}

trait Index {
    /// Returns the ids of the best `limit`, best first.
    fn search(&self, query: &[f32], limit: usize) -> Result<Vec<u32>>;
}

fn main() -> Result<()> {
    let args = Args::parse();
    ensure!(args.runs > 0, "--runs is 0, at least one is needed");
    let dump = Dump::open(&args.dump)?;
    let report = measure::run(&args, dump)?;
    println!("{}", serde_json::to_string_pretty(&report)?);
    Ok(())
}
