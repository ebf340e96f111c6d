//! `query`: scores of every Gaussian against a text.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use serde_json::json;
use slag_common::npy;
use slag_common::shard::Profile;

use super::common::{ModelArgs, print, profile_parser, text_encoder_of};
use super::exit::Exit;
use crate::query::{self, ByLevel};
use crate::store::StoreReader;

/// `query`.
#[derive(Debug, Args)]
pub struct QueryArgs {
    /// Store.
    #[arg(long, value_name = "DIR")]
    pub store: PathBuf,
    /// Models; they must be those that the store was encoded with.
    #[command(flatten)]
    pub models: ModelArgs,
    /// Text to look for.
    pub text: String,
    /// Gaussians to print, best first.
    #[arg(long, default_value_t = 10)]
    pub limit: u32,
    /// Scores as a robot with shards of this profile does [default: the field in full precision].
    #[arg(long, value_name = "NAME", value_parser = profile_parser())]
    pub profile: Option<Profile>,
    /// Scores coarse and fine masks separately and takes the best score, instead of their mean.
    #[arg(long, conflicts_with = "profile")]
    pub by_mask_level: bool,
    /// Writes every Gaussian's score, in the input's order, as a NumPy array (NaN: no evidence).
    #[arg(long, value_name = "FILE")]
    pub scores: Option<PathBuf>,
}

pub(super) fn run(args: &QueryArgs, json: bool) -> Result<Exit> {
    let reader = StoreReader::open(&args.store)?;
    let manifest = reader.manifest();
    let mut encoder = text_encoder_of(&reader, &args.models)?;
    let vector = encoder.encode(&args.text)?;
    let scores = match args.profile {
        Some(profile) => query::scores_of_shards(&reader, &vector, profile)?,
        None if args.by_mask_level => ByLevel::read(&reader)?.scores(&vector)?,
        None => query::scores(&reader, &vector)?,
    };
    if let Some(path) = &args.scores {
        npy::write_file(path, &[scores.cosines.len()], &scores.cosines)?;
    }
    let hits = query::best(&reader, &scores, args.limit as usize)?;
    let threshold = manifest.encoder.default_threshold;
    let n_matching = scores.cosines.iter().filter(|c| **c >= threshold).count();
    let n_scored = scores.cosines.iter().filter(|c| !c.is_nan()).count();
    let mut lines = format!("{n_matching} of {n_scored} Gaussians reach {threshold}\n");
    for hit in &hits {
        let p = hit.position_in_world;
        lines +=
            &format!("{:.4}  Gaussian {:>8}  at {:.2} {:.2} {:.2}\n", hit.cosine, hit.index, p.x, p.y, p.z);
    }
    let value = json!({
        "text": args.text, "threshold": threshold, "n_matching": n_matching, "n_scored": n_scored, "best": hits,
    });
    print(json, &value, lines)?;
    Ok(Exit::Done)
}
