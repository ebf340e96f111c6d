//! `query`: the things and the Gaussians that match a text.

use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow};
use clap::Args;
use serde_json::{Value, json};
use slag_common::objects::public_id;
use slag_common::shard::Profile;
use slag_common::splat::{self, ReadOptions, ply};
use slag_common::{Gaussians, durable, files, npy};
use slag_models::one_to_find;

use super::common;
use super::common::{Exit, ModelArgs, print, profile_parser, text_encoder_of};
use crate::query::{self, Hit};
use crate::store::StoreReader;
use crate::view::{Found, Things};

const EXAMPLES: &str = "Examples:\n\
    \x20 slag-encoder query --store STORE \"fire extinguisher\"\n\
    \x20 slag-encoder query --store STORE chair --json\n\
    \x20 slag-encoder query --store STORE chair --ply found.ply\n";

#[derive(Debug, Args)]
#[command(before_help = EXAMPLES)]
pub struct QueryArgs {
    /// Store.
    #[arg(long, value_name = "DIR")]
    pub store: PathBuf,
    /// Models; they must be those that the store was encoded with.
    #[command(flatten)]
    pub models: ModelArgs,
    /// Text to look for.
    pub text: String,
    /// Things to print, best first, or Gaussians where no thing matches.
    #[arg(long, default_value_t = 10)]
    pub limit: u32,
    /// Least cosine of a match, -1 to 1 [default: the encoder's].
    #[arg(long, value_name = "C", allow_hyphen_values = true)]
    pub threshold: Option<f32>,
    /// Scores as a robot with shards of this profile does [default: the field in full precision].
    #[arg(long, value_name = "NAME", value_parser = profile_parser())]
    pub profile: Option<Profile>,
    /// Writes every Gaussian's score, in the input's order, as a NumPy array (NaN: no evidence). Alone, it lists no
    /// things.
    #[arg(long, value_name = "FILE")]
    pub scores: Option<PathBuf>,
    /// Writes the Gaussians that match as a PLY, best first: with --scene a splat, else points with position,
    /// score and index in the input.
    #[arg(long, value_name = "FILE")]
    pub ply: Option<PathBuf>,
    /// The splat that the store was encoded from.
    #[arg(long, value_name = "FILE")]
    pub scene: Option<PathBuf>,
}

/// Positions by which a splat is known to be the store's.
const N_COMPARED: usize = 64;

pub(super) fn run(args: &QueryArgs, json: bool) -> Result<Exit> {
    let outputs = args.scores.iter().chain(&args.ply).map(PathBuf::as_path);
    let read: Vec<&Path> = args.scene.iter().chain(&args.models.models).map(PathBuf::as_path).collect();
    common::check(outputs, &read, Some(&args.store))?;
    args.scores.iter().chain(&args.ply).try_for_each(|path| files::check_writable(path))?;
    let reader = StoreReader::open(&args.store)?;
    let manifest = reader.manifest();
    let threshold = args.threshold.unwrap_or(manifest.encoder.default_threshold);
    if !(-1.0..=1.0).contains(&threshold) {
        return Err(anyhow!("--threshold is {threshold}, expected a cosine, -1 to 1"));
    }
    let mut encoder = text_encoder_of(&reader, &args.models)?;
    let words = one_to_find(&args.text, encoder.known_phrases().map(|known| &**known))?;
    let asked_as = encoder.known_phrases().and_then(|known| known.asked_as(&words));
    let vector = encoder.encode(&words)?;
    let scores = match args.profile {
        Some(profile) => query::scores_of_shards(&reader, &vector, profile)?,
        None => query::scores(&reader, &vector)?,
    };
    if let Some(path) = &args.scores {
        npy::write_file(path, &[scores.cosines.len()], &scores.cosines)?;
    }
    let lists = args.scores.is_none() || args.ply.is_some() || args.scene.is_some();
    let n_listed = if lists { args.limit as usize } else { 0 };
    let hits = query::located(&reader, &scores, &scores.best(n_listed))?;
    let scene = match &args.scene {
        Some(path) => {
            let scene = splat::read(path, &ReadOptions { with_sh_rest: true })?;
            let compared = query::located(&reader, &scores, &scores.best(N_COMPARED))?;
            query::check_scene(&reader, &scene, &compared).with_context(|| path.display().to_string())?;
            Some(scene)
        }
        None => None,
    };
    let matching = scores.matching(threshold);
    if let Some(path) = &args.ply {
        let located = query::located(&reader, &scores, &matching)?;
        write_ply(path, scene.as_ref(), &matching, &located, &args.text)?;
    }
    let n_matching = matching.len();
    let n_scored = scores.cosines.iter().filter(|c| !c.is_nan()).count();
    let things = if lists { Things::open(&reader, |_| {})? } else { Things::default() };
    let least = args.threshold.unwrap_or_else(|| things.threshold(manifest, false));
    let things = things.matching(&[vector], (least, least), n_listed);
    let mut lines = asked_as.as_ref().map_or(String::new(), |asked| format!("{words}: asked as {asked}\n"));
    lines.extend(things.iter().map(of_thing));
    lines += &format!("{n_matching} of {n_scored} Gaussians reach {threshold:.3}\n");
    if things.is_empty() {
        lines.extend(hits.iter().filter(|hit| hit.cosine >= threshold).map(of_hit));
        if let (0, Some(best)) = (n_matching, hits.first()) {
            lines +=
                &format!("the best: {}--threshold {:.2} shows such\n", of_hit(best), best.cosine - 0.005);
        }
    }
    let answers: Vec<Value> = things.iter().zip(1..).map(|(of, rank)| of.answer(manifest, rank)).collect();
    let value = json!({
        "text": args.text, "asked_as": asked_as, "threshold": threshold, "n_matching": n_matching, "n_scored": n_scored, "best": hits,
        "things": answers,
    });
    print(json, &value, lines)?;
    Ok(Exit::Done)
}

fn of_thing(Found { score, record, photo, .. }: &Found) -> String {
    let (at, size) = (record.position(), record.bounds().size());
    let (id, place) = (public_id(record.id), format!("{:.2} {:.2} {:.2}", at.x, at.y, at.z));
    format!("{score:.3}  {id}  at {place}, {:.2} x {:.2} x {:.2}, in {photo}\n", size.x, size.y, size.z)
}

fn of_hit(hit: &Hit) -> String {
    let p = hit.position_in_world;
    format!("{:.3}  Gaussian {:>8}  at {:.2} {:.2} {:.2}\n", hit.cosine, hit.index, p.x, p.y, p.z)
}

/// Writes the matching Gaussians, from the splat if given. `located`: hits whose position a shard knows.
fn write_ply(
    path: &Path,
    scene: Option<&Gaussians>,
    matching: &[u32],
    located: &[Hit],
    text: &str,
) -> Result<()> {
    if let Some(scene) = scene {
        return Ok(ply::write(path, &scene.select(matching))?);
    }
    if located.len() < matching.len() {
        return Err(anyhow!(
            "the shards do not say which Gaussian is which, so {} of {} matches have no position; give the splat with --scene, or encode with --input-indices",
            matching.len() - located.len(),
            matching.len()
        ));
    }
    let points = query::points_ply(located, &[format!("text {text}")]);
    Ok(durable::write_result(path, |file| file.write_all(&points))?)
}
