//! `status`.

use clap::Args;
use serde::Serialize;
use slag_edge::query::Status;
use slag_edge::store::Snapshot;

use super::args::CacheArgs;
use super::failure::{Failure, store_failure};
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
    let snapshot = Snapshot::open(&args.cache.open()?).map_err(store_failure)?;
    let status = Status::of(&snapshot);
    let expires_unix_secs = snapshot.manifest.expires_unix_secs;
    let is_expired = snapshot.manifest.check_expiry(slag_edge::now_unix_secs()).is_err();
    if args.json {
        return print_json(&OnBoard { status: &status, expires_unix_secs, is_expired });
    }
    print_status(&status)?;
    match is_expired {
        true => print_pairs(&[("expired", "yes: queries still work, but fetch refuses it".into())]),
        false => Ok(()),
    }
}

#[derive(Serialize)]
struct OnBoard<'a> {
    #[serde(flatten)]
    status: &'a Status,
    expires_unix_secs: Option<u64>,
    is_expired: bool,
}

/// Prints what is on board.
fn print_status(status: &Status) -> Result<(), Failure> {
    let unit = if status.metric { "m" } else { "world units" };
    print_pairs(&[
        ("scene", status.scene.clone()),
        ("generation", status.generation.to_string()),
        ("encoder", format!("{} ({})", status.encoder_name, status.encoder_id)),
        ("threshold", status.default_threshold.to_string()),
        ("profile", status.profile.to_string()),
        ("fetched", format!("{} {unit} around {:.2}", status.radius, status.centre_in_world)),
        ("shards", format!("{} of {} cells", status.shards.len(), status.n_cells_in_scene)),
        ("Gaussians", status.n_gaussians.to_string()),
        ("bytes", status.len_bytes.to_string()),
        ("signed by", status.key.to_string()),
    ])
}
