//! `status`.

use crate::fetch::accepted;
use crate::query::Status;
use crate::store::Snapshot;
use clap::Args;
use serde::Serialize;
use slag_common::ByteSize;

use super::args::CacheArgs;
use super::failure::Failure;
use super::output::{print_json, print_pairs};

#[derive(Debug, Args)]
pub struct StatusArgs {
    #[command(flatten)]
    pub cache: CacheArgs,
    /// Print the status as JSON.
    #[arg(long)]
    pub json: bool,
}

pub fn run(args: StatusArgs) -> Result<(), Failure> {
    let cache = args.cache.open()?;
    let snapshot = Snapshot::open(&cache)?;
    let accepted = accepted(&cache).ok().flatten();
    let expires_unix_secs = accepted.as_ref().and_then(|accepted| accepted.expires_unix_secs);
    let is_expired = expires_unix_secs.is_some_and(|expires| expires <= crate::now_unix_secs());
    let pinned_scene = accepted.and_then(|accepted| accepted.scene);
    let status = Status::of(&snapshot);
    if args.json {
        return print_json(&OnBoard { status: &status, pinned_scene, expires_unix_secs, is_expired });
    }
    print_status(&status, pinned_scene)?;
    match is_expired {
        true => print_pairs(&[(
            "expired",
            "yes: queries still work, but there may be news; fetch again, or have the store refreshed".into(),
        )]),
        false => Ok(()),
    }
}

#[derive(Serialize)]
struct OnBoard<'a> {
    #[serde(flatten)]
    status: &'a Status,
    pinned_scene: Option<String>,
    expires_unix_secs: Option<u64>,
    is_expired: bool,
}

fn print_status(status: &Status, pinned_scene: Option<String>) -> Result<(), Failure> {
    let unit = if status.metric { "m" } else { "world units" };
    let bad_cells: Vec<String> = status.bad_cells.iter().map(ToString::to_string).collect();
    print_pairs(&[
        ("scene", status.scene.clone()),
        ("pinned to", pinned_scene.unwrap_or_else(|| "unknown: see the next fetch".into())),
        ("generation", status.generation.to_string()),
        ("encoder", format!("{} ({})", status.encoder_name, status.encoder_id)),
        ("threshold", status.default_threshold.to_string()),
        ("profile", status.profile.to_string()),
        ("fetched", format!("{} {unit} around {:.2}", status.radius, status.centre_in_world)),
        ("shards", format!("{} of {} cells", status.shards.len(), status.n_cells_in_scene)),
        ("bad cells", if bad_cells.is_empty() { "none".into() } else { bad_cells.join(", ") }),
        ("Gaussians", status.n_gaussians.to_string()),
        ("size", ByteSize(status.len_bytes).to_string()),
    ])
}
