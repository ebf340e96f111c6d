//! `eval goal`.

use std::path::PathBuf;

use anyhow::{Result, anyhow};
use clap::Args;
use slag_encoder::cli::Exit;
use slag_encoder::progress::Progress;

use super::output::Output;
use crate::eval::goal::{self, GoalSettings};
use crate::generate::compose::Walk;
use crate::generate::grammar::SceneKind;

/// `eval goal`.
#[derive(Debug, Args)]
pub struct EvalGoalArgs {
    /// Folder for scenes, stores and caches; what an earlier run left there is used.
    #[arg(long, value_name = "DIR", default_value = "target/goal")]
    pub out: PathBuf,
    /// Kinds of scenes.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "room,yard")]
    pub kind: Vec<SceneKind>,
    /// Seeds of each kind.
    #[arg(long, value_name = "N", value_delimiter = ',', default_values_t = [21, 22, 23, 24])]
    pub seeds: Vec<u64>,
    /// Photos of each scene.
    #[arg(long, value_name = "N", default_value_t = 96, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub n_views: u32,
    /// Where they are taken.
    #[arg(long, value_enum, default_value = "everywhere")]
    pub walk: Walk,
    /// Radius of the robot.
    #[arg(long, value_name = "M", default_value_t = 0.3)]
    pub radius_m: f64,
    /// Tell each thing and pose that was not as it should be.
    #[arg(long)]
    pub list: bool,
}

pub(super) fn run(args: &EvalGoalArgs, progress: &dyn Progress, output: &Output<'_>) -> Result<Exit> {
    let exe = std::env::current_exe()?;
    let programs = exe.parent().ok_or_else(|| anyhow!("{} is in no folder", exe.display()))?.to_owned();
    let settings = GoalSettings {
        out: args.out.clone(),
        kinds: args.kind.clone(),
        seeds: args.seeds.clone(),
        n_views: args.n_views,
        walk: args.walk,
        radius_m: args.radius_m,
        lists_faults: args.list,
        programs,
    };
    let report = goal::run(&settings, progress)?;
    output.print(&report)?;
    Ok(Exit::Done)
}
