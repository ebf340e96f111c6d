//! `eval relations`.

use std::path::PathBuf;

use anyhow::{Result, anyhow};
use clap::Args;
use slag_encoder::cli::Exit;
use slag_encoder::progress::Progress;

use super::output::Output;
use crate::eval::relations::{self, RelationsSettings};
use crate::generate::grammar::SceneKind;

/// `eval relations`.
#[derive(Debug, Args)]
pub struct EvalRelationsArgs {
    /// Folder for scenes, stores and caches; what an earlier run left there is used.
    #[arg(long, value_name = "DIR", default_value = "target/relations")]
    pub out: PathBuf,
    /// Kinds of scenes.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "room,yard")]
    pub kind: Vec<SceneKind>,
    /// Seeds of each kind. One choice of the relations was made on rooms 1 to 4: judge by others.
    #[arg(long, value_name = "N", value_delimiter = ',', default_values_t = [11, 12, 13, 14])]
    pub seeds: Vec<u64>,
    /// Photos of each scene.
    #[arg(long, value_name = "N", default_value_t = 48, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub n_views: u32,
}

pub(super) fn run(args: &EvalRelationsArgs, progress: &dyn Progress, output: &Output<'_>) -> Result<Exit> {
    let exe = std::env::current_exe()?;
    let programs = exe.parent().ok_or_else(|| anyhow!("{} is in no folder", exe.display()))?.to_owned();
    let settings = RelationsSettings {
        out: args.out.clone(),
        kinds: args.kind.clone(),
        seeds: args.seeds.clone(),
        n_views: args.n_views,
        programs,
    };
    let report = relations::run(&settings, progress)?;
    output.print(&report)?;
    Ok(Exit::Done)
}
