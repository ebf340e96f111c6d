//! `eval scannet`.

use std::path::PathBuf;

use anyhow::{Result, anyhow};
use clap::Args;
use slag_common::poses::PoseSource;
use slag_common::shard::Profile;
use slag_common::splat;
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::{ModelArgs, parse_frame, text_encoder_of};
use slag_encoder::ingest::{self, FrameChoice};
use slag_encoder::store::StoreReader;

use super::output::Output;
use crate::eval::EvalSettings;
use crate::eval::scan::Scan;
use crate::eval::scannet::{self, Matching, ScannetReport, Segments};

/// `eval scannet`.
#[derive(Debug, Args)]
pub struct EvalScannetArgs {
    /// Store; once per scan.
    #[arg(long, value_name = "DIR", required = true)]
    store: Vec<PathBuf>,
    /// The splat that was encoded; once per scan.
    #[arg(long, value_name = "FILE", required = true)]
    scene: Vec<PathBuf>,
    /// Scan: scans/sceneXXXX_YY; may be repeated.
    #[arg(long, value_name = "DIR", required = true)]
    scan: Vec<PathBuf>,
    /// scannetv2-labels.combined.tsv, for scans without a labelled mesh.
    #[arg(long, value_name = "FILE")]
    categories: Option<PathBuf>,
    /// Compares Gaussians and vertices one by one, for splats trained with Gaussians fixed to the vertices (OpenGaussian).
    #[arg(long)]
    by_index: bool,
    /// Also evaluates with the paper's prediction filter (PF): all vertices of a segment take its most frequent class.
    /// `scan` reads ScanNet's segs.json, `superpoints` segments the splat, `auto` the first that there is.
    #[arg(long, value_enum, value_name = "FROM", num_args = 0..=1, default_missing_value = "auto")]
    segments: Option<Segments>,
    /// Says how the splat's frame follows from that of the scan, see `slag-encoder encode --help`: auto, none or a file.
    #[arg(long, value_name = "auto|none|FILE", default_value = "auto", value_parser = parse_frame)]
    splat_frame: FrameChoice,
    /// The models that the stores were encoded with.
    #[command(flatten)]
    models: ModelArgs,
    /// Scores this profile's shards, as a robot does [default: the field in full precision].
    #[arg(long, value_name = "NAME")]
    profile: Option<Profile>,
}

pub(super) fn run(args: &EvalScannetArgs, output: &Output<'_>) -> Result<Exit> {
    let (n_scans, n_stores, n_scenes) = (args.scan.len(), args.store.len(), args.scene.len());
    if n_stores != n_scans || n_scenes != n_scans {
        return Err(anyhow!(
            "{n_scans} scans, {n_stores} stores and {n_scenes} splats; give --scan, --store and --scene once per scan, \
             in the same order"
        ));
    }
    let matching = if args.by_index { Matching::Index } else { Matching::Nearest };
    let settings = EvalSettings { profile: args.profile, ..EvalSettings::default() };
    let mut scenes = Vec::new();
    for ((scan, store), scene) in args.scan.iter().zip(&args.store).zip(&args.scene) {
        let reader = StoreReader::open(store)?;
        let mut encoder = text_encoder_of(&reader, &args.models)?;
        let frame = ingest::find_frame(scene, &args.splat_frame, PoseSource::Scannet, None)?;
        let mut scene = splat::read(scene, &splat::ReadOptions { with_sh_rest: false })?;
        if let Some(frame) = frame {
            tracing::info!("{frame}; the splat is brought into the world of the scan");
            frame.to_poses(&mut scene);
        }
        let scan = Scan::read(scan, args.categories.as_deref())?;
        scenes.push(scannet::scannet(
            &reader,
            &scan,
            &scene,
            &mut *encoder,
            matching,
            args.segments,
            &settings,
        )?);
    }
    let report = ScannetReport::new(scenes);
    output.print(&report)?;
    let is_complete = |s: &scannet::ScanReport| s.unknown_words.is_empty() && s.unknown_labels.is_empty();
    Ok(if report.scenes.iter().all(is_complete) { Exit::Done } else { Exit::Partly })
}
