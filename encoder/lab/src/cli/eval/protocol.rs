//! `eval report`.

use std::path::PathBuf;

use anyhow::{Result, anyhow};
use clap::Args;
use slag_encoder::cli::Exit;

use crate::eval::protocol::{self, ProtocolError, ScannetMeans};

/// The paper's threshold on cosines.
const PAPERS_THRESHOLD: f32 = 0.28;

/// `eval report`.
#[derive(Debug, Args)]
pub struct EvalReportArgs {
    /// Folder of a folder per LERF scene with the reports of `eval lerf --json` at several thresholds.
    #[arg(long, value_name = "DIR", requires = "labels")]
    lerf: Option<PathBuf>,
    /// Labels: lerf_ovs/label, a folder per scene.
    #[arg(long, value_name = "DIR")]
    labels: Option<PathBuf>,
    /// Report of `eval scannet --json`, with the name of its row: NAME=FILE; may be repeated.
    #[arg(long, value_name = "NAME=FILE")]
    scannet: Vec<String>,
    /// The page to write, Markdown.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

pub(super) fn run(args: &EvalReportArgs) -> Result<Exit> {
    let (mut frozen, mut fixed) = (Vec::new(), Default::default());
    if let (Some(lerf), Some(labels)) = (&args.lerf, &args.labels) {
        let sweeps = protocol::read_sweeps(lerf)?;
        for sweep in &sweeps {
            protocol::check(sweep, &protocol::read_labelled(&labels.join(&sweep.scene))?)?;
        }
        frozen = protocol::leave_one_out(&sweeps)?;
        fixed = protocol::at_fixed(&sweeps, PAPERS_THRESHOLD);
    }
    let mut scannet = Vec::new();
    for named in &args.scannet {
        let (name, path) =
            named.split_once('=').ok_or_else(|| anyhow!("--scannet {named}: expected NAME=FILE"))?;
        let means: ScannetMeans = serde_json::from_slice(&fs_err::read(path)?)
            .map_err(|cause| ProtocolError::Format { path: path.into(), cause })?;
        scannet.push((name.to_owned(), means));
    }
    if frozen.is_empty() && scannet.is_empty() {
        return Err(anyhow!("nothing to report; give --lerf with --labels, or --scannet"));
    }
    fs_err::write(&args.out, protocol::page(&frozen, &fixed, &scannet))?;
    Ok(Exit::Done)
}
