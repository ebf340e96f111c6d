//! `encode`: a scene into a store.

use std::path::PathBuf;

use anyhow::{Context, Result, anyhow};
use clap::{Args, FromArgMatches};
use slag_common::shard::Profile;
use slag_models::gpus::GpuChoice;

use super::Exit;
use super::common::{
    InputArgs, ModelArgs, available_threads, cancel_flag, lasting_name, now_unix_secs, open_models,
    parse_error, print, profile_parser, warn_of_expiry,
};
use super::memory::{default_memory_bytes, parse_memory};
use super::refine::RefineArgs;
use super::sam::SamArgs;
use super::summary::lines;
use super::target::{REFINEMENTS, TUNED, TargetArgs};
use super::views::{ViewsArgs, parse_raster_width, parse_views_limit};
use crate::cells::{CellLimits, PositionError};
use crate::codebook::CodebookSettings;
use crate::codebook::basis::MAX_COMPONENTS;
use crate::embed::Background;
use crate::encode::front::Expectation;
use crate::encode::{
    CellSettings, EncodeSettings, Engines, InputSettings, Masks, OutputSettings, Preset, RasterWidth,
    Regions, RunSettings, ViewSettings, ViewsLimit,
};
use crate::occupancy::OccupancySettings;
use crate::progress::Progress;
use crate::raster::WeightKind;
use crate::raster::devices::{DeviceChoice, Devices};
use crate::raster::gpu::GpuOptions;
use crate::report::{self, Recorder};
use crate::shard::ShardSettings;

/// `encode`.
#[derive(Clone, Debug, Args)]
pub struct EncodeArgs {
    /// Scene, poses, photos.
    #[command(flatten)]
    pub input: InputArgs,
    /// Models.
    #[command(flatten)]
    pub models: ModelArgs,
    /// Store to publish into; made if absent.
    #[arg(long, value_name = "DIR")]
    pub store: PathBuf,
    /// Where masks come from: `auto` for a model (the embedded one, or --segmenter), `graph` for the segmenter without
    /// a model, which needs no ONNX Runtime, or your own masks: a folder of id PNGs or RLE JSON, or a COCO file.
    #[arg(long, value_name = "auto|graph|DIR", default_value = "auto")]
    pub masks: String,
    /// Segment Anything instead of the built-in segmenter.
    #[command(flatten)]
    pub sam: SamArgs,
    /// Which parts of a photo get vectors: `masks`, from their crops and from what the photo shows in and around them (the
    /// image model's patches, or windows over the photo: image.patches and image.windows in model.toml); `crops`, masks from
    /// their crops alone; `patches`, without masks, so no objects are found [default: the preset's].
    #[arg(long, value_enum)]
    pub regions: Option<Regions>,
    /// Ids in mask PNGs that are no masks; 0 never is one.
    #[arg(long, value_name = "ID", value_delimiter = ',')]
    pub ignore_mask_ids: Vec<u32>,
    /// Bundle of choices; other flags override single choices.
    #[arg(long, value_parser = Preset::parser(), default_value = "balanced")]
    pub preset: Preset,
    /// A target instead of a preset.
    #[command(flatten)]
    pub target: TargetArgs,
    /// How contributions become embeddings.
    #[command(flatten)]
    pub refine: RefineArgs,
    /// What fills a crop outside its mask [default: the preset's].
    #[arg(long, value_enum)]
    pub background: Option<Background>,
    /// Weight that is summed; `falloff` is the paper's formula as printed [default: the preset's].
    #[arg(long, value_enum)]
    pub weights: Option<WeightKind>,
    /// Number or share of the views to use: the first ones of --view-order [default: the preset's].
    #[arg(long, value_name = "N|P%", value_parser = parse_views_limit)]
    pub views_limit: Option<ViewsLimit>,
    /// Which views come first, and how long to go on.
    #[command(flatten)]
    pub views: ViewsArgs,
    /// Where weights are rasterised: auto (all GPUs, else the CPU), gpu, cpu, or numbers of `slag-encoder devices` such as
    /// 0,1. --gpus names the GPUs of models.
    #[arg(long, value_name = "DEVICE", default_value_t)]
    pub device: DeviceChoice,
    /// Width at which weights are rasterised: a number of pixels, `photo` for the photo's own width, at most 1024, or
    /// `twice` for twice that width [default: the preset's].
    #[arg(long, value_name = "photo|twice|PX", value_parser = parse_raster_width)]
    pub raster_width: Option<RasterWidth>,
    /// Masks with fewer pixels are left out [default: the preset's].
    #[arg(long, value_name = "PX")]
    pub min_mask_px: Option<u32>,
    /// NVIDIA GPUs that share the work of models, where --provider names cuda or tensorrt: all, or numbers such as 0,1.
    #[arg(long, value_name = "all|N,...", default_value_t)]
    pub gpus: GpuChoice,
    /// Keeps slivers, which ragged edges of overlapping masks leave, as regions; without it they join their neighbours.
    #[arg(long)]
    pub keep_slivers: bool,
    /// Threads [default: all cores].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
    /// Memory for the scene, photos and lists: a number with MiB or GiB, MB or GB [default: half of the free memory].
    #[arg(long, value_name = "BYTES", value_parser = parse_memory)]
    pub memory: Option<u64>,
    /// Name of the scene [default: the name of the store's folder].
    #[arg(long, value_name = "NAME")]
    pub name: Option<String>,
    /// Publishes the scene even where no Gaussian lies in a mask, so that nothing can be found.
    #[arg(long)]
    pub allow_empty: bool,
    /// World units are metres; a geo-reference implies it.
    #[arg(long)]
    pub metric: bool,
    /// Geo-reference JSON, {"origin": {"lat", "lon", "alt"}}, of the world's east-north-up frame [default: geo.json
    /// beside the scene, if it exists].
    #[arg(long, value_name = "FILE")]
    pub geo: Option<PathBuf>,
    /// Most Gaussians in a cell.
    #[arg(long, value_name = "N", default_value_t = 65_536, value_parser = clap::value_parser!(u32).range(1..=65_536))]
    pub cell_gaussians: u32,
    /// Largest width of a cell, metres, in metric scenes.
    #[arg(long, value_name = "M", default_value_t = 25.0)]
    pub cell_width_m: f64,
    /// Shards to make.
    #[arg(long, value_name = "NAMES", value_delimiter = ',', num_args = 1.., default_values_t = Profile::ALL, value_parser = profile_parser())]
    pub profiles: Vec<Profile>,
    /// Mean error of scores that the compact profile may have, relative to the spread of scores [default: the preset's].
    #[arg(long, value_name = "E", value_parser = parse_error)]
    pub compact_error: Option<f32>,
    /// The same for the balanced profile.
    #[arg(long, value_name = "E", value_parser = parse_error)]
    pub balanced_error: Option<f32>,
    /// Most components of a vector in compact and balanced shards, even [default: as many as the errors need, at most 128].
    #[arg(long, value_name = "N", value_parser = parse_components)]
    pub max_components: Option<usize>,
    /// Largest error of positions, world units [default: 0.01 in metric scenes, else a quarter of the size of a
    /// cell's small Gaussians].
    #[arg(long, value_name = "E")]
    pub position_error: Option<f64>,
    /// Compact and balanced shards say which Gaussian of the splat file each of theirs is, as exact ones always do: at most
    /// 4 bytes a Gaussian, 2.5 in a scene of a million.
    #[arg(long)]
    pub input_indices: bool,
    /// Shards tell how their Gaussians look, so that the page at /view shows colours on a robot, too: 10 bytes a Gaussian
    /// in every profile.
    #[arg(long)]
    pub appearance: bool,
    /// Shards say which places are free, occupied or unknown, so that robots find places to stand; with a value: the edge of
    /// a voxel, metres, 0.02 to 0.5. For metric scenes.
    #[arg(long, value_name = "M", num_args = 0..=1, default_missing_value = "0.05")]
    pub occupancy: Option<f64>,
    /// Shards say where their photos were taken, so that the page at /view shows cameras on a robot, too: 44 bytes and the
    /// name a photo in every profile. Pictures are not published.
    #[arg(long)]
    pub photo_poses: bool,
    /// The store carries the text side of --models, signed as all else: robots fetch it with the scene and need no --models.
    /// Refused unless the licence in model.toml permits passing the weights on.
    #[arg(long)]
    pub text_model: bool,
    /// Search for objects.
    #[command(flatten)]
    pub objects: ObjectArgs,
    /// Views by other machines.
    #[command(flatten)]
    pub fleet: super::fleet::CoordinatorArgs,
    /// Writes a report of the encode, one HTML file: views, masks, objects, cells, errors by profile, what was left out and
    /// why.
    #[arg(long, value_name = "FILE")]
    pub report: Option<PathBuf>,
    /// Drops an unfinished encode of another splat or with other settings in the store.
    #[arg(long)]
    pub restart: bool,
}

/// The search for objects.
#[derive(Clone, Debug, Args)]
pub struct ObjectArgs {
    /// Skips the search for objects: masks of different views that show the same Gaussians.
    #[arg(long)]
    pub no_objects: bool,
}

/// Returns the settings of the flags.
fn settings(args: &EncodeArgs) -> Result<EncodeSettings> {
    let preset = args.preset.choices();
    let regions = args.regions.unwrap_or(preset.regions);
    let views_limit = args.views_limit.unwrap_or(preset.views_limit);
    // A geo-reference beside the scene belongs to it.
    let beside = args.input.scene.with_file_name("geo.json");
    let geo = args.geo.clone().or_else(|| beside.is_file().then_some(beside));
    let metric = args.metric || geo.is_some();
    let folder_name = args.store.file_name().map(|name| name.to_string_lossy().into_owned());
    let created_unix_secs = now_unix_secs();
    let masks = match (args.masks.as_str(), args.sam.masks(&preset.sam)?) {
        ("graph", None) => Masks::Graph,
        ("auto", masks) => {
            masks.unwrap_or(Masks::Auto { n_levels: args.views.mask_levels.unwrap_or(preset.mask_levels) })
        }
        (dir, Some(_)) => {
            return Err(anyhow!("--masks {dir} and --segmenter exclude each other; give one of them"));
        }
        (dir, None) => Masks::Given { dir: dir.into(), ignore_ids: args.ignore_mask_ids.clone() },
    };
    Ok(EncodeSettings {
        inputs: InputSettings {
            scene: args.input.scene.clone(),
            views: args.input.views.clone(),
            images: args.input.images.clone(),
            added: args.views.added.clone(),
            dropped: args.views.dropped.clone(),
            every: args.input.every,
            splat_frame: args.input.splat_frame.clone(),
            activated: args.input.activated,
            metric,
            geo,
        },
        view: ViewSettings {
            masks,
            min_mask_px: args.min_mask_px.unwrap_or(preset.min_mask_px),
            background: args.background.unwrap_or(preset.background),
            raster_width: args.raster_width.unwrap_or(preset.raster_width),
            weights: args.weights.unwrap_or(preset.weights),
            merges_slivers: preset.merges_slivers && !args.keep_slivers,
            regions,
        },
        aggregation: args.refine.aggregation(preset.aggregation),
        cells: CellSettings {
            limits: CellLimits {
                max_gaussians: args.cell_gaussians as usize,
                max_width: metric.then_some(args.cell_width_m),
                position_error: args
                    .position_error
                    .map_or_else(|| PositionError::default_for(metric), PositionError::Within),
            },
            shards: shard_settings(args, preset.codebook),
            objects: preset.objects && !args.objects.no_objects && regions.have_masks(),
            occupancy: args.occupancy.map(|voxel_m| OccupancySettings { voxel_m }),
            photo_poses: args.photo_poses,
        },
        output: OutputSettings {
            store: args.store.clone(),
            scene_name: args.name.clone().or(folder_name).unwrap_or_else(|| "scene".into()),
            created_unix_secs,
            models: args.models.models.as_deref().map(lasting_name),
            text_model: args.text_model,
        },
        run: RunSettings {
            threads: args.threads.map_or_else(available_threads, |n| n as usize),
            memory_bytes: args.memory.unwrap_or_else(default_memory_bytes),
            views_limit,
            view_order: args.views.order(views_limit),
            time_budget: args.views.time_budget,
            strict: args.input.strict,
            allow_empty: args.allow_empty,
            restart: args.restart,
            keep_views: args.refine.keep_views || args.views.changes_photos(),
            gpus: vec![0],
        },
    })
}

fn parse_components(text: &str) -> Result<usize, String> {
    let is_valid = |n: &usize| (2..=MAX_COMPONENTS).contains(n) && n.is_multiple_of(2);
    let components = text.parse().ok().filter(is_valid);
    components.ok_or_else(|| format!("expected an even number from 2 to {MAX_COMPONENTS}"))
}

fn shard_settings(args: &EncodeArgs, preset: CodebookSettings) -> ShardSettings {
    ShardSettings {
        profiles: args.profiles.clone(),
        codebook: CodebookSettings {
            compact_error: args.compact_error.unwrap_or(preset.compact_error),
            balanced_error: args.balanced_error.unwrap_or(preset.balanced_error),
            max_components: args.max_components.unwrap_or(preset.max_components),
            ..preset
        },
        input_indices: args.input_indices,
        appearance: args.appearance,
    }
}

/// Returns the settings of the flags, with those that a target chooses, and what it expects.
fn settings_and_target(args: &EncodeArgs) -> Result<(EncodeSettings, Option<Expectation>)> {
    let settings = settings(args)?;
    match args.target.choose(&settings.inputs)? {
        Some(expected) => {
            Ok((self::settings(&with_setting(args, &expected.setting.flags)?)?, Some(expected)))
        }
        None => Ok((settings, None)),
    }
}

pub(super) fn run(args: &EncodeArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    let (mut settings, expected) = settings_and_target(args)?;
    let (models, session) = open_models(&args.models)?;
    tracing::info!("models: {} ({})", models.encoder_id(), models.about());
    settings.run.gpus = args.gpus.numbers(&session);
    let devices = Devices::open(&args.device, GpuOptions::default())?;
    let engines = Engines::new(&models, &session, &devices);
    let cancel = cancel_flag()?;
    let recorder = args.report.as_ref().map(|_| Recorder::new(progress));
    let progress = recorder.as_ref().map_or(progress, |recorder| recorder as &dyn Progress);
    let summary = args.fleet.encode(&settings, &engines, progress, cancel.as_ref())?;
    let lines = lines(&settings, &summary, expected.as_ref());
    print(json, &summary, lines)?;
    warn_of_expiry(&settings.output.store);
    if let (Some(path), Some(recorder)) = (&args.report, &recorder) {
        fs_err::write(path, report::of_encode(&settings.output.scene_name, &summary, recorder)?)?;
    }
    Ok(if summary.skipped_views.is_empty() { Exit::Done } else { Exit::Partly })
}

/// Returns the arguments with the choices of a setting's flags.
///
/// # Errors
/// If the flags have one that is no choice of a front.
fn with_setting(args: &EncodeArgs, setting: &str) -> Result<EncodeArgs> {
    let foreign = setting.split_whitespace().filter_map(|word| word.strip_prefix("--")).find(|flag| {
        let name = flag.split('=').next().unwrap_or_default().replace('-', "_");
        name == "segmenter" || !TUNED.iter().chain(&REFINEMENTS).any(|tuned| *tuned == name)
    });
    if let Some(flag) = foreign {
        return Err(anyhow!(
            "the front's setting {setting:?} has --{flag}, which no front may set; remove it"
        ));
    }
    let words =
        ["--scene", "-", "--views", "-", "--store", "-"].into_iter().chain(setting.split_whitespace());
    let command = EncodeArgs::augment_args(clap::Command::new("encode").no_binary_name(true));
    let chosen = command
        .try_get_matches_from(words)
        .and_then(|matches| EncodeArgs::from_arg_matches(&matches))
        .with_context(|| format!("the front's setting {setting:?} is not understood"))?;
    let mut with = args.clone();
    with.preset = chosen.preset;
    with.background = chosen.background;
    with.weights = chosen.weights;
    with.views_limit = chosen.views_limit;
    with.raster_width = chosen.raster_width;
    with.min_mask_px = chosen.min_mask_px;
    with.keep_slivers = chosen.keep_slivers;
    with.compact_error = chosen.compact_error;
    with.max_components = chosen.max_components;
    with.objects = chosen.objects.clone();
    with.refine = chosen.refine.clone();
    with.refine.keep_views = args.refine.keep_views;
    with.views = chosen.views.clone();
    with.views.time_budget = args.views.time_budget;
    with.views.added = args.views.added.clone();
    with.views.dropped = args.views.dropped.clone();
    Ok(with)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(flags: &str) -> Result<EncodeArgs, clap::Error> {
        let command = EncodeArgs::augment_args(clap::Command::new("encode").no_binary_name(true));
        let line = format!("--scene a --views b --store c {flags}");
        EncodeArgs::from_arg_matches(&command.try_get_matches_from(line.split_whitespace())?)
    }

    #[test]
    fn a_setting_changes_its_choices_and_nothing_else() {
        let args = parse("--front f.json --target-seconds 60 --time-budget 9 --threads 3 --keep-views")
            .expect("parses");
        let with =
            with_setting(&args, "--preset fast --views-limit 25% --median-steps 3").expect("understood");
        assert_eq!((with.preset, with.views_limit), (Preset::Fast, Some(ViewsLimit::Share(0.25))));
        assert_eq!(with.refine.aggregation(crate::lift::Aggregation::REFINED).median_steps, 3);
        assert_eq!((with.threads, with.refine.keep_views, with.store), (Some(3), true, "c".into()));
        assert_eq!(with.views.time_budget.map(|t| t.as_secs()), Some(9));
        for wrong in ["--scene x", "--segmenter x", "--threads 1", "--preset nothing", "--models=x"] {
            let message = with_setting(&args, wrong).expect_err("refused").to_string();
            assert!(message.contains(wrong), "{message}");
        }
    }

    #[test]
    fn a_removed_preset_names_its_replacement() {
        assert_eq!(parse("--preset balanced").expect("parses").preset, Preset::Balanced);
        let message = parse("--preset accurate").expect_err("refused").to_string();
        assert!(message.contains("--raster-width twice"), "{message}");
        let others = parse("--preset best").expect_err("refused").to_string();
        assert!(others.contains("[possible values: paper, plain, fast, balanced]"), "{others}");
    }

    #[test]
    fn a_target_excludes_what_it_chooses() {
        for tuned in TUNED.iter().chain(&REFINEMENTS) {
            let value = match *tuned {
                "preset" => " fast",
                "background" => " white",
                "weights" => " blend",
                "view_order" => " names",
                "raster_width" => " 320",
                "max_components" => " 8",
                "fill" => " true",
                "keep_slivers" | "no_objects" => "",
                _ => " 1",
            };
            let flag = format!("--{}{value}", tuned.replace('_', "-"));
            parse(&flag).expect("a flag of encode");
            let error = parse(&format!("--front f.json --target-bytes 3MiB {flag}")).expect_err("excluded");
            assert_eq!(error.kind(), clap::error::ErrorKind::ArgumentConflict, "{flag}");
        }
        assert!(parse("--front f.json --target-seconds 0").is_err());
        let without = parse("--target-seconds 60").expect_err("no front");
        assert_eq!(without.kind(), clap::error::ErrorKind::MissingRequiredArgument);
    }
}
