//! `bench`.

use anyhow::{Context, Result};

use super::Exit;
use super::args::{CodecBenchArgs, FieldBenchArgs, LiftBenchArgs};
use super::run::{available_threads, open_models, print};
use crate::bench::codec::{self, Source};
use crate::bench::field;
use crate::bench::lift::{self, LiftOptions};
use crate::palette::{PaletteSettings, TextBank};
use crate::progress::Progress;
use crate::shard::ShardSettings;
use crate::shard::positions::PositionError;

pub(super) fn run_lift(args: &LiftBenchArgs, json: bool) -> Result<Exit> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(args.threads.map_or_else(available_threads, |n| n as usize))
        .build_global()
        .context("cannot start threads")?;
    let in_temporary = || std::env::temp_dir().join(format!("slag-bench-lift-{}", std::process::id()));
    let options = LiftOptions {
        n_gaussians: args.gaussians as usize,
        n_views: args.views as usize,
        n_masks: args.masks as usize,
        n_visible: args.visible as usize,
        entries_per_visible: args.entries_per_visible,
        dim: args.dim as usize,
        cell_gaussians: args.cell_gaussians as usize,
        memory_bytes: args.memory,
        n_repeats: args.repeats as usize,
        work_dir: args.work.clone().unwrap_or_else(in_temporary),
        plan: (args.plan_gaussians as usize, args.plan_views as usize),
    };
    let measured = lift::run(&options);
    lift::clean(&options)?;
    let report = measured?;
    if let Some(path) = &args.out {
        fs_err::write(path, serde_json::to_string_pretty(&report)?)?;
    }
    print(json, &report, &report)?;
    Ok(Exit::Done)
}

pub(super) fn run_codec(args: &CodecBenchArgs, json: bool) -> Result<Exit> {
    let generated = || Source::Generated(args.gaussians as usize, args.dim as usize);
    let source = args.store.clone().map_or_else(generated, Source::Store);
    let (bank, name) = match &args.store {
        Some(store) => {
            let (models, session) = open_models(&args.models)?;
            let name = store.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
            (TextBank::of_model(&mut *models.text_encoder(&session)?), name)
        }
        None => (TextBank::default(), "generated field".into()),
    };
    let report = codec::run(&source, bank, args.title.as_deref().unwrap_or(&name))?;
    if let Some(path) = &args.svg {
        fs_err::write(path, report.svg())?;
    }
    if let Some(path) = &args.out {
        fs_err::write(path, serde_json::to_string_pretty(&report)?)?;
    }
    print(json, &report, &report)?;
    Ok(Exit::Done)
}

pub(super) fn run_field(args: &FieldBenchArgs, progress: &dyn Progress) -> Result<Exit> {
    let settings = ShardSettings {
        profiles: args.profiles.clone(),
        palette: PaletteSettings { balanced_error: args.balanced_error, ..PaletteSettings::default() },
        position_error: PositionError::Within(0.01),
    };
    let report =
        field::publish(args.gaussians as usize, args.dim as usize, &args.store, &settings, progress)?;
    let text = serde_json::to_string_pretty(&report)?;
    if let Some(path) = &args.out {
        fs_err::write(path, &text)?;
    }
    println!("{text}");
    Ok(Exit::Done)
}
