//! What each command does.

use std::fmt::Display;
use std::io::Write;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, anyhow};
use serde::Serialize;
use serde_json::json;
use slag_common::{poses, splat};
use slag_models::commands::{self, ModelsCommand, RunArgs};
use slag_models::session::SessionError;
use slag_models::{ModelDir, SessionOptions, TextEncoder};

use super::Exit;
use super::args::*;
use super::progress::Shown;
use crate::check::{self, CheckOptions, CheckView};
use crate::demo;
use crate::encode::coverage::CoverageReport;
use crate::encode::{
    self, CellReport, EncodeError, EncodeSettings, EncodeSummary, Masks, StageReport, ViewsReport,
};
use crate::eval::{self, EvalSettings, Truth};
use crate::generate::{crops, grammar, photos};
use crate::palette::PaletteSettings;
use crate::progress::{Progress, Silent};
use crate::publish::{qdrant, serve};
use crate::query::{self, ByLevel};
use crate::raster::devices::Devices;
use crate::raster::gpu::{AdapterReport, GpuOptions, adapters};
use crate::raster::{CpuRasterizer, RasterView};
use crate::shard::ShardSettings;
use crate::shard::cells::CellLimits;
use crate::shard::positions::PositionError;
use crate::store::{Store, StoreReader};
use crate::{generate, ingest};

/// Runs the program and says how it ended.
pub fn run(cli: Cli) -> Exit {
    let json = cli.json;
    let progress: Box<dyn Progress> =
        if cli.shows_progress() { Box::new(Shown::new()) } else { Box::new(Silent) };
    let result = match cli.command {
        Command::Check(args) => run_check(&args, json),
        Command::Encode(args) => run_encode(&args, progress.as_ref(), json),
        Command::Query(args) => run_query(&args, json),
        Command::Serve(args) => run_serve(&args),
        Command::Keys(command) => super::keys::run(&command, json),
        Command::Models(command) => run_models(&command, json),
        Command::Push(PushCommand::Qdrant(args)) => run_push(&args, progress.as_ref(), json),
        Command::Eval(EvalCommand::Labelled(args)) => run_eval_labelled(&args, json),
        Command::Eval(EvalCommand::Encoder(args)) => super::eval::run_encoder(&args, progress.as_ref(), json),
        Command::Eval(EvalCommand::Lerf(args)) => super::eval::run_lerf(&args, json),
        Command::Eval(EvalCommand::Scannet(args)) => super::eval::run_scannet(&args, json),
        Command::Eval(EvalCommand::Noise(args)) => super::noise::run(&args, progress.as_ref(), json),
        Command::Generate(command) => run_generate(&command, progress.as_ref()),
        Command::Demo(args) => run_demo(&args, progress.as_ref(), json),
        Command::Devices => run_devices(json),
        Command::Bench(BenchCommand::Raster(args)) => {
            super::bench::run_raster(&args, progress.as_ref(), json)
        }
        Command::Bench(BenchCommand::Lift(args)) => super::bench::run_lift(&args, json),
        Command::Bench(BenchCommand::Codec(args)) => super::bench::run_codec(&args, json),
        Command::Bench(BenchCommand::Field(args)) => super::bench::run_field(&args, progress.as_ref()),
        Command::Bench(BenchCommand::Tradeoff(args)) => super::tradeoff::run(&args, progress.as_ref(), json),
    };
    match result {
        Ok(exit) => exit,
        Err(error) if is_broken_pipe(&error) => Exit::Done,
        Err(error) => {
            let interrupted = matches!(error.downcast_ref(), Some(EncodeError::Interrupted { .. }))
                || matches!(error.downcast_ref(), Some(qdrant::PushError::Cancelled));
            if json {
                println!(
                    "{}",
                    json!({"error": {"message": format!("{error:#}"), "interrupted": interrupted}})
                );
            } else {
                eprintln!("{}: {error:#}", if interrupted { "interrupted" } else { "error" });
            }
            if interrupted { Exit::Interrupted } else { Exit::Failed }
        }
    }
}

/// A reader that went away (`| head`) is no failure.
fn is_broken_pipe(error: &anyhow::Error) -> bool {
    error
        .chain()
        .filter_map(|e| e.downcast_ref::<std::io::Error>())
        .any(|e| e.kind() == std::io::ErrorKind::BrokenPipe)
}

/// Prints the result: as one JSON object, or as lines for people.
pub(super) fn print(json: bool, value: &impl Serialize, lines: impl Display) -> Result<()> {
    let mut out = std::io::stdout().lock();
    match json {
        true => writeln!(out, "{}", serde_json::to_string(value)?)?,
        false => write!(out, "{lines}")?,
    }
    Ok(out.flush()?)
}

/// Returns a flag that ctrl-c or SIGTERM sets; a second one ends the program at once.
pub(super) fn cancel_flag() -> Result<Arc<AtomicBool>> {
    let flag = Arc::new(AtomicBool::new(false));
    let seen = Arc::clone(&flag);
    ctrlc::set_handler(move || {
        if seen.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
        eprintln!("stopping after the views at hand; once more to stop at once");
    })
    .context("cannot listen for ctrl-c")?;
    Ok(flag)
}

pub(super) fn now_unix_secs() -> u64 {
    // Reproducible builds of a store: the convention of reproducible-builds.org.
    let given = std::env::var("SOURCE_DATE_EPOCH").ok().and_then(|text| text.parse().ok());
    given.unwrap_or_else(|| SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs()))
}

/// Opens the models and says how they are run.
pub(super) fn open_models(args: &ModelArgs) -> Result<(ModelDir, SessionOptions)> {
    let models = commands::open(args.models.as_deref(), &|name| std::env::var_os(name))?;
    Ok((models, session_options(&args.how)?))
}

/// Returns how models are run: with one thread, because views are encoded side by side.
fn session_options(how: &RunArgs) -> Result<SessionOptions, SessionError> {
    how.session_options(&commands::runtime_folders(&std::env::current_exe().unwrap_or_default()), 1)
}

fn run_models(command: &ModelsCommand, json: bool) -> Result<Exit> {
    let context = commands::Context {
        variable: &|name| std::env::var_os(name),
        image: Some(&ModelDir::image_encoder),
        ask: &|question| !json && commands::ask(question),
        session: &session_options,
    };
    let report = commands::run(command, &context)?;
    print(json, &report, &report)?;
    Ok(Exit::Done)
}

fn run_check(args: &CheckArgs, json: bool) -> Result<Exit> {
    let scene = splat::read(&args.input.scene, &splat::ReadOptions { with_sh_rest: true })?;
    let all = poses::read(&args.input.views, args.input.images.as_deref())?.views;
    let missing: Vec<_> = ingest::missing_images(&all).into_iter().map(|v| v.image_path.clone()).collect();
    if let Some(first) = missing.first() {
        let message = format!(
            "{} of {} photos are missing, the first is {}",
            missing.len(),
            all.len(),
            first.display()
        );
        if args.input.strict || missing.len() == all.len() {
            return Err(anyhow!("{message}; give their folder with --images"));
        }
        tracing::warn!("{message}");
    }
    let there: Vec<_> = all.into_iter().filter(|v| !missing.contains(&v.image_path)).collect();
    let n = (args.samples as usize).min(there.len());
    let mut views = Vec::with_capacity(n);
    for i in 0..n {
        let loaded = ingest::load_image(&there[i * there.len() / n])?;
        let view = RasterView {
            camera_from_world: loaded.view.camera_from_world,
            intrinsics: loaded.view.intrinsics,
        };
        views.push(CheckView { name: loaded.view.name, image: loaded.image, view });
    }
    let options = CheckOptions {
        width_px: args.raster_width,
        pictures_dir: args.out.clone(),
        ..CheckOptions::default()
    };
    let report = check::check(&scene, &views, &Devices::open(args.device, GpuOptions::default())?, &options)?;
    print(json, &report, &report)?;
    Ok(if missing.is_empty() { Exit::Done } else { Exit::Partly })
}

/// Returns the settings that the flags stand for.
fn encode_settings(args: &EncodeArgs) -> Result<EncodeSettings> {
    let preset = args.preset.choices();
    let views_limit = args.views_limit.unwrap_or(preset.views_limit);
    // A geo-reference that lies beside the scene belongs to it.
    let beside = args.input.scene.with_file_name("geo.json");
    let geo = args.geo.clone().or_else(|| beside.is_file().then_some(beside));
    let metric = args.metric || geo.is_some();
    let folder_name = args.store.file_name().map(|name| name.to_string_lossy().into_owned());
    let created_unix_secs = now_unix_secs();
    let masks = match (args.masks.as_str(), args.sam.masks()) {
        ("graph", None) => Masks::Graph,
        ("auto", masks) => {
            masks.unwrap_or(Masks::Auto { n_levels: args.views.mask_levels.unwrap_or(preset.mask_levels) })
        }
        (dir, Some(_)) => {
            return Err(anyhow!("--masks {dir} gives masks, --segmenter finds some; choose one"));
        }
        (dir, None) => Masks::Given { dir: dir.into(), ignore_ids: args.ignore_mask_ids.clone() },
    };
    Ok(EncodeSettings {
        scene: args.input.scene.clone(),
        views: args.input.views.clone(),
        images: args.input.images.clone(),
        masks,
        store: args.store.clone(),
        scene_name: args.name.clone().or(folder_name).unwrap_or_else(|| "scene".into()),
        metric,
        geo,
        views_limit,
        view_order: args.views.order(views_limit),
        time_budget: args.views.time_budget,
        raster_width: args.raster_width.unwrap_or(preset.raster_width),
        background: args.background.map_or(preset.background, Into::into),
        min_mask_px: args.min_mask_px.unwrap_or(preset.min_mask_px),
        weights: args.weights.map_or(preset.weights, Into::into),
        aggregation: args.refine.aggregation(preset.aggregation),
        mask_noise: args.refine.mask_noise(),
        keep_views: args.refine.keep_views,
        threads: args.threads.map_or_else(available_threads, |n| n as usize),
        memory_bytes: args.memory,
        strict: args.input.strict,
        restart: args.restart,
        cells: CellLimits {
            max_gaussians: args.cell_gaussians as usize,
            max_width: metric.then_some(args.cell_width_m),
        },
        shards: ShardSettings {
            profiles: args.profiles.clone(),
            palette: PaletteSettings {
                compact_error: args.compact_error.unwrap_or(preset.palette.compact_error),
                balanced_error: args.balanced_error.unwrap_or(preset.palette.balanced_error),
                ..preset.palette
            },
            position_error: args
                .position_error
                .map_or_else(|| PositionError::default_for(metric), PositionError::Within),
        },
        objects: preset.objects && !args.objects.no_objects,
        created_unix_secs,
        expires_unix_secs: args.expires_days.map(|days| created_unix_secs + u64::from(days) * 86_400),
    })
}

pub(super) fn available_threads() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

fn run_encode(args: &EncodeArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    let settings = encode_settings(args)?;
    rayon::ThreadPoolBuilder::new()
        .num_threads(settings.threads)
        .build_global()
        .context("cannot start threads")?;
    let (models, session) = open_models(&args.models)?;
    tracing::info!("models: {} ({})", models.encoder_id(), models.about());
    let devices = Devices::open(args.device, GpuOptions::default())?;
    let summary = encode::encode(&settings, &models, &session, &devices, progress, cancel_flag()?.as_ref())?;
    let busy =
        summary.busy_secs.iter().map(|(stage, s)| format!("{stage} {s:.1}")).collect::<Vec<_>>().join(", ");
    let of_views: String = (summary.view_stages.iter())
        .map(|stage| {
            let StageReport { stage, n_slots, busy_secs, busy_share } = stage;
            format!("  {stage:<9}{n_slots:>8}{busy_secs:>10.1}{:>7.0} %\n", 100.0 * busy_share)
        })
        .collect();
    let sizes = summary
        .shard_bytes
        .iter()
        .map(|(p, b)| format!("{p} {:.1} MB", *b as f64 / 1e6))
        .collect::<Vec<_>>()
        .join(", ");
    let skipped = match summary.skipped_views.len() {
        0 => String::new(),
        n => format!("left out   {n} views, the first: {}\n", summary.skipped_views[0].reason),
    };
    let coverage = summary.coverage.map_or(String::new(), |CoverageReport { coverage, seen }| {
        let (coverage, seen, secs) = (100.0 * coverage, 100.0 * seen, summary.coverage_secs);
        format!("coverage   {coverage:.1} % of all views, {seen:.1} % of the Gaussians seen; found in {secs:.1} s\n")
    });
    let objects = summary.objects.as_ref().map_or(String::new(), |found| {
        let (n, of_masks, aside) = (found.n_objects, found.n_masks_of_objects, found.n_masks_set_aside);
        format!(
            "objects    {n} of {of_masks} masks, {} Gaussians; {aside} masks set aside\n",
            found.n_gaussians
        )
    });
    let most = most_spent(&summary);
    let images_on = summary.images_on.as_ref().map_or(String::new(), |on| format!("images on  {on}\n"));
    let lines = format!(
        "published  generation {} in {}\n\
         Gaussians  {} ({} without evidence, {} unusable)\n\
         views      {} of {} ({} resumed, {} without masks)\n{coverage}{skipped}{images_on}\
         masks      {} in {} regions, {} sums\n\
         cells      {} with {} palette rows\n\
         {objects}shards     {sizes}\n{most}\
         seconds    {:.1}; by stage, all threads: {busy}\n\
         views took {:.1} s\n  stage    at once   seconds    busy\n{of_views}",
        summary.generation,
        settings.store.display(),
        summary.n_gaussians,
        summary.n_without_evidence,
        summary.n_rejected,
        summary.n_views,
        summary.n_views_there,
        summary.n_views_resumed,
        summary.n_views_without_masks,
        summary.n_masks,
        summary.n_regions,
        summary.n_entries,
        summary.n_cells,
        summary.n_rows,
        summary.wall_secs,
        summary.views_secs,
    );
    print(json, &summary, lines)?;
    Ok(if summary.skipped_views.is_empty() { Exit::Done } else { Exit::Partly })
}

/// Returns the line that names the view and the cell on which most was spent.
fn most_spent(summary: &EncodeSummary) -> String {
    let (views, cells) = (&summary.views, &summary.cells);
    let most = (0..views.view.len()).max_by(|a, b| views.secs[*a].total_cmp(&views.secs[*b]));
    let (Some(at), Some(cell)) = (most, cells.iter().max_by_key(|cell| cell.n_rows)) else {
        return String::new();
    };
    let ViewsReport { view, raster_width_px, n_masks, n_regions, n_entries, secs } = views;
    let CellReport { cell_id, n_gaussians, n_rows, .. } = cell;
    format!(
        "most on    view {}, {:.1} s ({} masks, {} regions, {} sums, {} px wide); cell {cell_id}, {n_rows} rows \
         ({n_gaussians} Gaussians)\n",
        view[at], secs[at], n_masks[at], n_regions[at], n_entries[at], raster_width_px[at]
    )
}

fn run_query(args: &QueryArgs, json: bool) -> Result<Exit> {
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
        let mut file = std::io::BufWriter::new(fs_err::File::create(path)?);
        query::write_npy(&mut file, &scores.cosines)?;
        file.flush()?;
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

/// Opens the text encoder that a store was encoded with.
pub(super) fn text_encoder_of(reader: &StoreReader, args: &ModelArgs) -> Result<Box<dyn TextEncoder>> {
    let expected = &reader.manifest().encoder;
    let (models, session) = open_models(args)?;
    if slag_common::Hash32(models.encoder_id().hash()) != expected.id {
        return Err(anyhow!(
            "the store was encoded with {:?} ({}), the models at hand are {}; give the same with --models",
            expected.name,
            expected.id,
            models.encoder_id()
        ));
    }
    Ok(models.text_encoder(&session)?)
}

fn run_eval_labelled(args: &EvalLabelledArgs, json: bool) -> Result<Exit> {
    let reader = StoreReader::open(&args.store)?;
    let mut encoder = text_encoder_of(&reader, &args.models)?;
    let scene = splat::read(&args.scene, &splat::ReadOptions { with_sh_rest: false })?;
    let truth = Truth::read(&args.truth, scene.len())?;
    let settings = EvalSettings {
        words: args.words.clone(),
        profile: args.profile,
        threshold: args.threshold,
        filter: args.superpoints,
        level: args.level.level.map(Into::into),
        by_mask_level: args.by_mask_level,
    };
    let report = eval::labelled(&reader, &truth, &scene, &mut *encoder, &CpuRasterizer, &settings)?;
    print(json, &report, &report)?;
    Ok(Exit::Done)
}

fn runtime() -> Result<tokio::runtime::Runtime> {
    tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .context("cannot start the service's threads")
}

/// Completes when the user or the system asks the program to stop.
async fn stopped() {
    if let Err(error) = serve::stop_signal().await {
        tracing::warn!("cannot listen for signals, stopping: {error}");
    }
}

fn run_serve(args: &ServeArgs) -> Result<Exit> {
    runtime()?.block_on(async {
        // On stdout: with port 0 this is where a script learns the port.
        let listening = |address| println!("listening on http://{address}");
        serve::serve(&args.store, args.listen, serve::Limits::default(), listening, stopped()).await
    })?;
    Ok(Exit::Done)
}

fn run_push(args: &QdrantArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    let options = qdrant::PushOptions {
        api_key: args.api_key.clone(),
        n_points_per_batch: args.batch,
        ..qdrant::PushOptions::new(&args.url, &args.collection)
    };
    // The writer's lock: the state of the push is kept in the store.
    let store = Store::create_or_open(&args.store)?;
    let reader = store.reader()?;
    let vectors = Arc::new(qdrant::ExactShards::new(reader.clone()));
    let mut shown = None;
    let on_batch = |at: qdrant::PushProgress| {
        let before = shown.replace(at.n_points);
        match before {
            None => progress.begin("push", "point", at.n_points_expected, at.n_points),
            Some(before) => progress.advance(at.n_points - before),
        }
    };
    let pushed =
        runtime()?.block_on(qdrant::push(&reader, vectors, store.db(), &options, on_batch, stopped()));
    progress.end();
    let report = pushed?;
    let lines = format!(
        "{} points in collection {}: {} sent now, {} Gaussians without evidence left out, {} attempts repeated\n",
        report.n_points, args.collection, report.n_sent, report.n_without_evidence, report.n_retries
    );
    print(json, &report, lines)?;
    Ok(Exit::Done)
}

fn run_generate(command: &GenerateCommand, progress: &dyn Progress) -> Result<Exit> {
    match command {
        GenerateCommand::Scene(args) => {
            let nouns = grammar::nouns(args.objects.as_deref())?;
            let mut scene = generate::Scene::new(&args.kind, args.seed, args.n_views, &nouns);
            let written = scene.write(&args.out, progress)?;
            println!(
                "{} Gaussians, {} things, {} photos in {}",
                scene.gaussians.len(),
                scene.objects.iter().filter(|object| !object.background).count(),
                scene.views.len(),
                args.out.display()
            );
            println!(
                "next: slag-encoder encode --scene {} --views {} --metric --store STORE",
                written.scene.display(),
                written.views.display()
            );
        }
        GenerateCommand::Crops(args) => {
            let nouns = grammar::nouns(args.objects.as_deref())?;
            let seeds = args.seed..args.seed + args.n_scenes;
            let n_crops = crops::write(&args.out, args.split, &nouns, seeds, args.edge, progress)?;
            println!("{n_crops} crops of {} nouns in {}", nouns.len(), args.out.display());
        }
        GenerateCommand::Photos(args) => {
            let nouns = grammar::nouns(args.objects.as_deref())?;
            let seeds = args.seed..args.seed + args.n_scenes;
            let n_photos = photos::write(&args.out, &nouns, seeds, progress)?;
            println!("{n_photos} photos in {}", args.out.display());
        }
    }
    Ok(Exit::Done)
}

fn run_demo(args: &DemoArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    let edge = std::env::current_exe()?.with_file_name(format!("slag-edge{}", std::env::consts::EXE_SUFFIX));
    let options = demo::DemoOptions {
        out: args.out.clone(),
        seed: args.seed,
        session: session_options(&args.how)?,
        edge,
        created_unix_secs: now_unix_secs(),
    };
    let demo = runtime()?.block_on(async { demo::run(&options, progress, cancel_flag()?.as_ref()).await })?;
    print(json, &demo.report, &demo.report)?;
    if args.keep {
        demo.keep()?;
    }
    Ok(if demo.report.all_right() { Exit::Done } else { Exit::Failed })
}

fn run_devices(json: bool) -> Result<Exit> {
    let reports: Vec<_> = adapters().into_iter().map(|adapter| adapter.report).collect();
    let mut lines = String::new();
    for (number, report) in reports.iter().enumerate() {
        let AdapterReport { name, driver, backend, kind, precision, max_binding_bytes } = report;
        lines += &format!(
            "{number}  {name} ({kind}, {backend}, {driver}); projection in {precision:?}, {} MiB a buffer\n",
            max_binding_bytes >> 20
        );
    }
    if reports.is_empty() {
        lines += "no GPU; the CPU does the work\n";
    }
    print(json, &json!({ "adapters": reports }), lines)?;
    Ok(Exit::Done)
}
