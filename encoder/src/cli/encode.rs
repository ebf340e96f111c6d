//! `encode`: a scene into a store.

use std::ffi::OsStr;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::Duration;

use anyhow::{Context, Result, anyhow};
use clap::{Args, FromArgMatches};
use slag_common::shard::Profile;
use slag_common::{ByteSize, durable, files};
use slag_models::commands;
use slag_models::gpus::GpuChoice;

use super::choices::ChoiceArgs;
use super::common::{
    Exit, InputArgs, ModelArgs, cancel_flag, lasting_name, n_threads, now_unix_secs, open_models, parse_secs,
    print, profile_parser, warn_of_expiry,
};
use super::draw::UpArgs;
use super::memory::{default_memory_bytes, parse_memory};
use super::summary::lines;
use super::{common, next};
use crate::cells::PositionError;
use crate::encode::front::{Expectation, Front, Target};
use crate::encode::{
    DEFAULT_CELL_WIDTH_M, EncodeSettings, Engines, InputSettings, MAX_CELL_GAUSSIANS, Masks, Restart,
    ViewsLimit, count_inputs,
};
use crate::occupancy::OccupancySettings;
use crate::progress::Progress;
use crate::raster::devices::{DeviceChoice, Devices};
use crate::raster::gpu::GpuOptions;
use crate::report::{self, Recorder};
use crate::segment::{SamLevels, SamSettings};
use crate::store;
use crate::viewpoints::{DEFAULT_N_VIEWS, POSES_FILE, ViewpointSettings};

#[cfg(not(feature = "fleet"))]
use crate::encode;

const EXAMPLES: &str = "Examples:\n\
    \x20 slag-encoder encode --scene splat.ply --store STORE\n\
    \x20 slag-encoder encode --scene splat.ply --views sparse/0 --store STORE --models clip-vit-base-patch32-int8 --text-model\n\
    \x20 slag-encoder encode --scene splat.ply --views transforms.json --store STORE --preset fast --time-budget 60\n";

#[derive(Clone, Debug, Args)]
#[command(before_help = EXAMPLES)]
pub struct EncodeArgs {
    /// Scene, poses, photos.
    #[command(flatten)]
    input: InputArgs,
    #[command(flatten)]
    models: ModelArgs,
    /// Store to publish into; made if absent.
    #[arg(long, value_name = "DIR", help_heading = "Output")]
    store: PathBuf,
    /// Where masks come from: `auto` for a model (the embedded one, or --segmenter), `graph` for the segmenter
    /// without a model, which needs no ONNX Runtime, or your own masks: a folder of id PNGs or RLE JSON, or a COCO
    /// file.
    #[arg(long, value_name = "auto|graph|DIR", default_value = "auto", help_heading = "Models")]
    masks: String,
    /// Segment Anything instead of the built-in segmenter.
    #[command(flatten)]
    sam: SamArgs,
    /// Ids in mask PNGs that are no masks; 0 never is one.
    #[arg(long, value_name = "ID", value_delimiter = ',', help_heading = "Models", hide_short_help = true)]
    ignore_mask_ids: Vec<u32>,
    /// A preset, and single choices.
    #[command(flatten)]
    choices: ChoiceArgs,
    /// A target instead of a preset.
    #[command(flatten)]
    target: TargetArgs,
    /// Seconds after which no further view is begun; the finished views are published.
    #[arg(long, value_name = "SECS", value_parser = parse_secs, help_heading = "Speed and accuracy")]
    time_budget: Option<Duration>,
    /// Poses of further photos in the same world, in one file of poses or several: the scene is encoded from these
    /// and those of --views, and only views that the store does not keep are segmented, embedded and rasterised.
    /// Keeps the contributions of views, as --keep-views does.
    #[arg(long = "add", value_name = "POSES", help_heading = "Inputs")]
    added: Vec<PathBuf>,
    /// Leaves out a view, by its name in the poses file; nothing else is segmented, embedded and rasterised again.
    /// Keeps the contributions of views, as --keep-views does.
    #[arg(long = "drop", value_name = "VIEW", help_heading = "Inputs", hide_short_help = true)]
    dropped: Vec<String>,
    /// Keeps the contributions of views, so that another encode of the same views (with another codebook, say) is
    /// quick
    #[arg(long, help_heading = "Inputs", hide_short_help = true)]
    keep_views: bool,
    /// Where weights are rasterised: auto (all GPUs, else the CPU), gpu, cpu, or numbers of `slag-encoder devices`
    /// such as 0,1. --gpus names the GPUs of models.
    #[arg(long, value_name = "DEVICE", default_value_t, help_heading = "Machine")]
    pub(super) device: DeviceChoice,
    /// NVIDIA GPUs that share the work of models, where --provider names cuda or tensorrt: all, or numbers such as
    /// 0,1.
    #[arg(long, value_name = "all|N,...", default_value_t, help_heading = "Machine", hide_short_help = true)]
    gpus: GpuChoice,
    /// Threads [default: all cores].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024), help_heading = "Machine")]
    threads: Option<u32>,
    /// Memory for the scene, photos and lists: a number with MiB or GiB, MB or GB [default: half of the free
    /// memory].
    #[arg(long, value_name = "BYTES", value_parser = parse_memory, help_heading = "Machine")]
    memory: Option<u64>,
    #[command(flatten)]
    up: UpArgs,
    /// Name of the scene [default: that of the store's generation; else of the splat's file or its folders, the first
    /// that is not the like of point_cloud or results; else of the store's folder].
    #[arg(long, value_name = "NAME", value_parser = parse_name, help_heading = "Output", hide_short_help = true)]
    name: Option<String>,
    /// World units are metres; a geo-reference implies it.
    #[arg(long, help_heading = "Inputs")]
    metric: bool,
    /// Geo-reference JSON, {"origin": {"lat", "lon", "alt"}}, of the world's east-north-up frame [default:
    /// geo.json beside the scene, if it exists].
    #[arg(long, value_name = "FILE", help_heading = "Inputs")]
    geo: Option<PathBuf>,
    /// Most Gaussians in a cell.
    #[arg(long, value_name = "N", default_value_t = MAX_CELL_GAUSSIANS as u32, value_parser = clap::value_parser!(u32).range(1..=MAX_CELL_GAUSSIANS as i64), help_heading = "Output", hide_short_help = true)]
    cell_gaussians: u32,
    /// Largest width of a cell, metres, in metric scenes [default: 25].
    #[arg(long, value_name = "M", help_heading = "Output", hide_short_help = true)]
    cell_width_m: Option<f64>,
    /// Shards to make.
    #[arg(long, value_name = "NAMES", value_delimiter = ',', num_args = 1.., default_values_t = Profile::ALL, value_parser = profile_parser(), help_heading = "Output")]
    profiles: Vec<Profile>,
    /// Largest error of positions, world units [default: 0.01 in metric scenes, else a quarter of the size of a
    /// cell's small Gaussians].
    #[arg(long, value_name = "E", help_heading = "Output", hide_short_help = true)]
    position_error: Option<f64>,
    /// Compact and balanced shards say which Gaussian of the splat file each of theirs is, as exact ones always
    /// do: at most 4 bytes a Gaussian, 2.5 in a scene of a million.
    #[arg(long, help_heading = "Output", hide_short_help = true)]
    input_indices: bool,
    /// Compact shards tell how their Gaussians and objects look, too, as balanced and exact ones always do: 10 bytes a
    /// Gaussian and some kB an object, for a robot's page in colours and pictures, and to verify where it is.
    #[arg(long, help_heading = "Output")]
    appearance: bool,
    /// Shards say which places are free, occupied or unknown, so that robots find places to stand; with a value:
    /// the edge of a voxel, metres, 0.02 to 0.5. For metric scenes.
    #[arg(long, value_name = "M", num_args = 0..=1, default_missing_value = "0.05", help_heading = "Output")]
    occupancy: Option<f64>,
    /// Shards say where their photos were taken, so that the page at /view shows cameras on a robot, too: 44 bytes
    /// and the name a photo in every profile. Pictures are not published.
    #[arg(long, help_heading = "Output", hide_short_help = true)]
    photo_poses: bool,
    /// Shards have landmarks, by which robots find the cameras of their photos: at most 2 bytes a Gaussian in every
    /// profile. Every photo is looked at once more.
    #[arg(long, help_heading = "Output", hide_short_help = true)]
    locate: bool,
    /// The store carries the text side of --models, signed as all else: robots fetch it with the scene and need no
    /// --models. Refused unless the licence in model.toml permits passing the weights on.
    #[arg(long, help_heading = "Output")]
    text_model: bool,
    /// Publishes a generation in which no Gaussian has an embedding, too: nothing is found in it.
    #[arg(long, help_heading = "Output", hide_short_help = true)]
    allow_empty: bool,
    #[cfg(feature = "fleet")]
    #[command(flatten)]
    fleet: super::fleet::CoordinatorArgs,
    /// Writes a report of the encode, one HTML file: views, masks, objects, cells, errors by profile, what was
    /// left out and why.
    #[arg(long, value_name = "FILE", help_heading = "Output")]
    report: Option<PathBuf>,
    /// Drops the views that the store keeps, of an unfinished encode or of any other: all are made again.
    #[arg(long, help_heading = "Output", hide_short_help = true)]
    restart: bool,
}

impl EncodeArgs {
    fn paths_read(&self) -> Vec<&Path> {
        let masks = Path::new(&self.masks);
        let files = self.added.iter().chain(&self.geo).chain(&self.target.front).map(PathBuf::as_path);
        self.input.paths_read().into_iter().chain([masks]).chain(files).collect()
    }
}

/// Refuses names that cannot stand in logs and headers.
fn parse_name(text: &str) -> Result<String, String> {
    match (1..=200).contains(&text.len()) && !text.contains(char::is_control) {
        true => Ok(text.to_owned()),
        false => Err("expected 1 to 200 bytes without control characters".into()),
    }
}

/// Names that trainers give to any splat or folder.
const NAMES_OF_TRAINERS: &str =
    "data export iteration meta model out output outputs ply point_cloud results scene splat tmp";

/// Name of a splat: of its file, or of the nearest folder above with a name of its own.
fn name_of(splat: &Path) -> Option<String> {
    let path = std::path::absolute(splat).ok()?;
    let name = |part: &OsStr| Some(part.to_str()?.split('.').next()?.to_owned());
    let is_own = |name: &String| {
        let word = name.trim_end_matches(|c: char| c.is_ascii_digit()).trim_end_matches(['_', '-']);
        !word.is_empty() && !NAMES_OF_TRAINERS.split(' ').any(|known| known == word.to_lowercase())
    };
    let names = path.ancestors().filter_map(|part| name(part.file_name()?));
    names.filter(|name| parse_name(name).is_ok()).find(is_own)
}

/// Settings of the flags, with the choices of `choices` instead of the flags' own.
fn settings(args: &EncodeArgs, choices: &ChoiceArgs) -> Result<EncodeSettings> {
    let input = &args.input;
    // A geo-reference beside the scene belongs to it.
    let beside = input.scene.with_file_name("geo.json");
    let geo = args.geo.clone().or_else(|| beside.is_file().then_some(beside));
    let metric = args.metric || geo.is_some();
    let drawn = || args.store.join("drawn").join(POSES_FILE);
    let views = input.views.clone().unwrap_or_else(drawn);
    let mut settings = EncodeSettings::new(input.scene.clone(), views, args.store.clone(), metric);
    let EncodeSettings { inputs, run, .. } = &mut settings;
    inputs.images = input.images.clone();
    inputs.added = args.added.clone();
    inputs.dropped = args.dropped.clone();
    inputs.every = input.every;
    inputs.splat_frame = input.splat_frame.clone();
    inputs.activated = input.activated;
    inputs.geo = geo;
    run.threads = n_threads(args.threads);
    run.memory_bytes = args.memory.unwrap_or_else(default_memory_bytes);
    run.time_budget = args.time_budget;
    run.strict = input.strict;
    run.restart = if args.restart { Restart::Always } else { Restart::Never };
    run.keep_views = args.keep_views || !args.added.is_empty() || !args.dropped.is_empty();
    run.allow_empty = args.allow_empty;
    choices.apply(&mut settings);
    if input.views.is_some() && args.up.up.is_some() {
        return Err(anyhow!(
            "--up is for the planning of views, which --views replaces; leave one of them out"
        ));
    }
    if input.views.is_none() {
        let n_views = match settings.run.views_limit {
            ViewsLimit::Count(n) => n,
            ViewsLimit::All | ViewsLimit::Share(_) => DEFAULT_N_VIEWS,
        };
        settings.inputs.planned = Some(ViewpointSettings { n_views, up: args.up.up });
    }
    if let Some(masks) = masks(args, choices)? {
        settings.view.masks = masks;
    }
    let EncodeSettings { cells, output, .. } = &mut settings;
    cells.limits.max_gaussians = args.cell_gaussians as usize;
    if !metric && args.cell_width_m.is_some() {
        return Err(anyhow!(
            "--cell-width-m is in metres, which world units are not known to be; give --metric if they are"
        ));
    }
    cells.limits.max_width = metric.then(|| args.cell_width_m.unwrap_or(DEFAULT_CELL_WIDTH_M));
    cells.shards.profiles = args.profiles.clone();
    if let Some(error) = args.position_error {
        cells.limits.position_error = PositionError::Within(error);
    }
    cells.shards.input_indices = args.input_indices;
    cells.shards.compact_appearance = args.appearance;
    cells.occupancy = args.occupancy.map(|voxel_m| OccupancySettings { voxel_m });
    cells.photo_poses = args.photo_poses;
    cells.landmarks = args.locate;
    // Robots recognise a scene by its name.
    let published_name = || store::scene_name(&args.store);
    let of_splat = || name_of(&input.scene);
    let of_store = || args.store.file_name().map(|name| name.to_string_lossy().into_owned());
    let name = args.name.clone().or_else(published_name).or_else(of_splat).or_else(of_store);
    output.scene_name = name.unwrap_or_else(|| "scene".into());
    output.created_unix_secs = now_unix_secs()?;
    output.models = args.models.models.as_deref().map(lasting_name);
    output.text_model = args.text_model;
    Ok(settings)
}

/// Where masks come from, if not from the embedded model.
fn masks(args: &EncodeArgs, choices: &ChoiceArgs) -> Result<Option<Masks>> {
    let other = args.sam.segmenter.is_some();
    let own = !["auto", "graph"].contains(&args.masks.as_str());
    if !own && !args.ignore_mask_ids.is_empty() {
        return Err(anyhow!(
            "--ignore-mask-ids is for masks of your own; give these with --masks, or leave it out"
        ));
    }
    if (args.masks != "auto" || other) && args.choices.mask_levels.is_some() {
        return Err(anyhow!(
            "--mask-levels is for the embedded model of masks; leave it out, or --masks and --segmenter"
        ));
    }
    match (args.masks.as_str(), args.sam.masks(&choices.preset.sam())?) {
        ("auto", of_sam) => Ok(of_sam),
        ("graph", None) => Ok(Some(Masks::Graph)),
        (dir, None) => {
            let ignore_ids = args.ignore_mask_ids.clone();
            Ok(Some(Masks::Given { dir: dir.into(), ignore_ids }))
        }
        (dir, Some(_)) => Err(anyhow!("--masks {dir} and --segmenter exclude each other; give one of them")),
    }
}

pub(super) fn run(args: &EncodeArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    common::check(args.report.as_deref(), &args.paths_read(), Some(&args.store))?;
    args.report.iter().try_for_each(|path| files::check_writable(path))?;
    let mut settings = settings(args, &args.choices)?;
    let target = args.target.choose(&settings.inputs)?;
    if let Some((choices, _)) = &target {
        settings = self::settings(args, choices)?;
    }
    let expected = target.map(|(_, expected)| expected);
    let (models, session) = open_models(&args.models)?;
    tracing::info!("models: {} ({})", models.encoder_id(), models.about());
    settings.run.gpus = args.gpus.numbers(&session);
    let devices = Devices::open(&args.device, GpuOptions::default())?;
    let engines = Engines::new(&models, &session, &devices);
    let cancel = cancel_flag()?;
    let recorder = args.report.as_ref().map(|_| Recorder::new(progress));
    let progress = recorder.as_ref().map_or(progress, |recorder| recorder as &dyn Progress);
    #[cfg(feature = "fleet")]
    let summary = args.fleet.encode(&settings, &engines, progress, cancel.as_ref())?;
    #[cfg(not(feature = "fleet"))]
    let summary = encode::encode(&settings, &engines, progress, cancel.as_ref())?;
    let lines = lines(&settings, &summary, expected.as_ref());
    let next = || next::of_store(&settings.output.store, &args.input).unwrap_or_default();
    let next = if json { String::new() } else { next() };
    print(json, &summary, lines + &next)?;
    warn_of_expiry(&settings.output.store);
    if let (Some(path), Some(recorder)) = (&args.report, &recorder) {
        let report = report::of_encode(&settings.output.scene_name, &summary, recorder)?;
        let written = durable::write_result(path, |file| file.write_all(report.as_ref()));
        written.context("the store is published, but the report is not written")?;
    }
    Ok(match (summary.fits(), summary.is_whole()) {
        (false, _) => Exit::Mismatch,
        (true, false) => Exit::Partly,
        (true, true) => Exit::Done,
    })
}

/// A target instead of a preset.
#[derive(Clone, Debug, Default, Args)]
#[command(next_help_heading = "Target")]
pub(crate) struct TargetArgs {
    /// Picks the most accurate measured setting that is expected to take at most this many seconds. The
    /// expectation holds for the machine, models and size of photos that the front was measured with.
    #[arg(long, value_name = "S", value_parser = parse_secs, requires = "front", conflicts_with_all = ["choices", "segmenter"], hide_short_help = true)]
    target_seconds: Option<Duration>,
    /// Picks the most accurate measured setting whose compact shards are expected to have at most this many bytes.
    #[arg(long, value_name = "BYTES", requires = "front", conflicts_with_all = ["choices", "segmenter"], hide_short_help = true)]
    target_bytes: Option<ByteSize>,
    /// Front to pick from: front.json, as `slag-lab bench tradeoff` writes it for your machine and scenes.
    #[arg(long, value_name = "FILE", hide_short_help = true)]
    front: Option<PathBuf>,
}

impl TargetArgs {
    /// Returns the choices that meet the target on the inputs, and what is expected of them; `None` without a target.
    pub(super) fn choose(&self, inputs: &InputSettings) -> Result<Option<(ChoiceArgs, Expectation)>> {
        let seconds = self.target_seconds.map(|seconds| seconds.as_secs_f64());
        let target = Target { seconds, bytes: self.target_bytes.map(|bytes| bytes.0) };
        let Some(path) = &self.front else { return Ok(None) };
        if target == Target::default() {
            return Err(anyhow!("--front needs --target-seconds or --target-bytes"));
        }
        let front = Front::read(path)?;
        let (n_photos, n_gaussians) = count_inputs(inputs)?;
        let chosen = front.choose(target, n_photos, n_gaussians)?;
        let bytes = ByteSize(chosen.bytes as u64);
        tracing::info!(
            "setting {:?} ({}): {:.1} s and {bytes} of {} shards are expected for {n_photos} photos and {n_gaussians} \
             Gaussians, measured on {} scenes on {} with {}; mIoU there {:.3}",
            chosen.setting.name,
            chosen.setting.flags,
            chosen.seconds,
            chosen.setting.profile,
            front.n_scenes,
            front.machine,
            front.measured_with,
            chosen.setting.miou,
        );
        Ok(Some((parse_choices(&chosen.setting.flags)?, chosen)))
    }
}

fn parse_choices(flags: &str) -> Result<ChoiceArgs> {
    let command = ChoiceArgs::augment_args(clap::Command::new("encode").no_binary_name(true));
    command
        .try_get_matches_from(flags.split_whitespace())
        .and_then(|matches| ChoiceArgs::from_arg_matches(&matches))
        .with_context(|| format!("the front's setting {flags:?} is not understood"))
}

/// Masks from Segment Anything; the other flags need `--segmenter`.
#[derive(Clone, Debug, Args)]
#[command(next_help_heading = "Segment Anything")]
pub(crate) struct SamArgs {
    /// SAM, SAM 2, MobileSAM, EdgeTAM or another model of that kind: a folder with model.toml, or the name of a
    /// pulled model (`models list`).
    #[arg(long, value_name = "NAME|DIR", help_heading = "Models")]
    segmenter: Option<PathBuf>,
    /// Points along each side of the grid of prompts: 8, 16, 32, 64 [default: the preset's].
    #[arg(long, requires = "segmenter", value_name = "N",
        value_parser = clap::value_parser!(u32).range(1..=256), help_heading = "Speed and accuracy", hide_short_help = true)]
    points_per_side: Option<u32>,
    /// Points per run of the model: more are faster on GPUs and take more memory.
    #[arg(long, requires = "segmenter", value_name = "N", default_value_t = SamSettings::default().points_per_batch,
        value_parser = clap::value_parser!(u32).range(1..=1024), hide_short_help = true)]
    sam_points_per_batch: u32,
    /// Least IoU that the model predicts for a mask, 0 to 1 [default: the preset's].
    #[arg(long, requires = "segmenter", value_name = "IOU", value_parser = parse_ratio::<f32>, hide_short_help = true)]
    sam_predicted_iou: Option<f32>,
    /// Least IoU of a mask with itself under a higher and a lower threshold, 0 to 1 [default: the preset's].
    #[arg(long, requires = "segmenter", value_name = "IOU", value_parser = parse_ratio::<f64>, hide_short_help = true)]
    sam_stability: Option<f64>,
    /// Distance of those thresholds from 0, logits.
    #[arg(long, requires = "segmenter", value_name = "LOGITS", default_value_t = SamSettings::default().stability_offset, value_parser = parse_offset, hide_short_help = true)]
    sam_stability_offset: f32,
    /// IoU of boxes from which two masks are the same.
    #[arg(long, requires = "segmenter", value_name = "IOU", default_value_t = SamSettings::default().box_nms_iou, value_parser = parse_ratio::<f64>, hide_short_help = true)]
    sam_box_nms: f64,
    /// IoU of pixels from which two masks are the same; 1 compares boxes only.
    #[arg(long, requires = "segmenter", value_name = "IOU", default_value_t = SamSettings::default().mask_nms_iou, value_parser = parse_ratio::<f64>, hide_short_help = true)]
    sam_mask_nms: f64,
    /// Layers of crops, to find small things: layer i segments 4^i crops besides the whole image [default: the
    /// preset's].
    #[arg(long, requires = "segmenter", value_name = "N",
        value_parser = clap::value_parser!(u32).range(0..=4), hide_short_help = true)]
    sam_crop_layers: Option<u32>,
    /// IoU of boxes from which masks of two crops are the same.
    #[arg(long, requires = "segmenter", value_name = "IOU", default_value_t = SamSettings::default().crop_nms_iou, value_parser = parse_ratio::<f64>, hide_short_help = true)]
    sam_crop_nms: f64,
    /// Fills holes and drops islands of masks with fewer pixels [default: the preset's].
    #[arg(long, requires = "segmenter", value_name = "PX", hide_short_help = true)]
    sam_min_region_px: Option<u32>,
    /// Which of the three masks of each prompt are used [default: the preset's].
    #[arg(long, requires = "segmenter", value_enum, hide_short_help = true)]
    sam_levels: Option<SamLevels>,
    /// Threads within the model; masks may depend on their number in the last bits [default: all cores].
    #[arg(long, requires = "segmenter", value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024), hide_short_help = true)]
    sam_threads: Option<u32>,
}

impl SamArgs {
    /// Segment Anything as the source of masks, if --segmenter names it.
    pub(super) fn masks(&self, preset: &SamSettings) -> Result<Option<Masks>> {
        let Some(segmenter) = &self.segmenter else { return Ok(None) };
        let dir = commands::resolve(segmenter, &|name| std::env::var_os(name))?;
        let settings = SamSettings {
            points_per_side: self.points_per_side.unwrap_or(preset.points_per_side),
            points_per_batch: self.sam_points_per_batch,
            predicted_iou: self.sam_predicted_iou.unwrap_or(preset.predicted_iou),
            stability: self.sam_stability.unwrap_or(preset.stability),
            stability_offset: self.sam_stability_offset,
            box_nms_iou: self.sam_box_nms,
            mask_nms_iou: self.sam_mask_nms,
            crop_layers: self.sam_crop_layers.unwrap_or(preset.crop_layers),
            crop_nms_iou: self.sam_crop_nms,
            min_region_px: self.sam_min_region_px.unwrap_or(preset.min_region_px),
            levels: self.sam_levels.unwrap_or(preset.levels),
            ..*preset
        };
        let n_model_threads = n_threads(self.sam_threads);
        Ok(Some(Masks::Sam { dir, settings, n_model_threads }))
    }
}

fn parse_ratio<T: FromStr + Into<f64> + Copy>(text: &str) -> Result<T, String> {
    parse_up_to(text, 1.0)
}

fn parse_offset(text: &str) -> Result<f32, String> {
    parse_up_to(text, 100.0)
}

fn parse_up_to<T: FromStr + Into<f64> + Copy>(text: &str, most: f64) -> Result<T, String> {
    let number = text.parse().ok().filter(|number: &T| (0.0..=most).contains(&(*number).into()));
    number.ok_or_else(|| format!("expected 0 to {most}"))
}

#[cfg(test)]
mod tests {
    use clap::{CommandFactory, Parser};

    use super::*;
    use crate::cli::{Cli, Command};
    use crate::encode::{EncodeSettings, ViewsLimit};

    #[test]
    fn a_setting_of_a_front_has_choices_and_nothing_else() {
        let choices = parse_choices("--preset fast --views-limit 25% --superpoint 3").expect("understood");
        let mut settings = EncodeSettings::new(PathBuf::new(), PathBuf::new(), PathBuf::new(), true);
        choices.apply(&mut settings);
        let found = (settings.run.views_limit, settings.aggregation.superpoint);
        assert_eq!(found, (ViewsLimit::Share(0.25), 3.0));
        for wrong in ["--scene x", "--segmenter x", "--threads 1", "--preset nothing", "--models=x"] {
            let message = format!("{:#}", parse_choices(wrong).expect_err("refused"));
            assert!(message.contains(wrong), "{message}");
        }
    }

    /// A store keeps its scene's name even if its manifest is damaged; a new one takes the splat's.
    #[test]
    fn a_scene_keeps_its_name() {
        let dir = tempfile::tempdir().expect("a folder");
        let folder = dir.path().join("store");
        let name = |flags: &[&str]| {
            let line = ["slag-encoder", "encode", "--scene", "lab.ply", "--views", "b", "--store"];
            let line = line.iter().map(OsStr::new).chain([folder.as_os_str()]);
            let parsed = Cli::try_parse_from(line.chain(flags.iter().map(OsStr::new))).expect("flags");
            let Command::Encode(args) = parsed.command else { panic!("encode") };
            settings(&args, &args.choices).expect("settings").output.scene_name
        };
        assert_eq!((name(&[]), name(&["--name", "hall"])), ("lab".to_owned(), "hall".to_owned()));
        let published = store::Store::create_or_open(&folder).expect("opens");
        for generation in 1..=2 {
            let manifest = store::tests::manifest(generation, &[]);
            published.publish(&manifest, &store::Extras::new()).expect("publishes");
        }
        assert_eq!((name(&[]), name(&["--name", "hall"])), ("yard".to_owned(), "hall".to_owned()));
        fs_err::write(folder.join("manifest"), "{").expect("damages");
        assert_eq!(name(&[]), "yard");
    }

    /// Flags without effect are refused, with what they are for.
    #[test]
    fn no_flag_is_given_in_vain() {
        let refused = |flags: &str| {
            let line = format!("slag-encoder encode --scene a --views b --store c {flags}");
            let parsed = Cli::try_parse_from(line.split(' ')).map_err(|error| error.to_string())?;
            let Command::Encode(args) = parsed.command else { panic!("encode") };
            settings(&args, &args.choices).map(drop).map_err(|error| error.to_string())
        };
        for (flags, what) in [
            ("--cell-width-m 5", "give --metric"),
            ("--ignore-mask-ids 3", "masks of your own"),
            ("--masks graph --ignore-mask-ids 3", "masks of your own"),
            ("--masks own --mask-levels 2", "embedded model"),
            ("--points-per-side 8", "--segmenter"),
            ("--sam-box-nms 0.5", "--segmenter"),
            ("--sam-levels whole", "--segmenter"),
        ] {
            let error = refused(flags).expect_err(flags);
            assert!(error.contains(what), "{flags}: {error}");
        }
        for flags in ["--cell-width-m 5 --metric", "--masks own --ignore-mask-ids 3", "--mask-levels 2"] {
            refused(flags).expect(flags);
        }
    }

    /// Splat paths as trainers write them.
    #[test]
    fn a_scene_is_called_what_its_splat_is() {
        for (path, name) in [
            ("/scans/me/yard.ply", "yard"),
            ("/scans/me/yard.compressed.ply", "yard"),
            ("/scans/me/yard/point_cloud.ply", "yard"),
            ("/scans/me/yard/results/ply/point_cloud_29999.ply", "yard"),
            ("/scans/me/Hall 3/out/point_cloud/iteration_30000/point_cloud.ply", "Hall 3"),
            ("/scans/me/export/splat.ply", "me"),
        ] {
            assert_eq!(name_of(Path::new(path)).as_deref(), Some(name), "{path}");
        }
        assert_eq!(name_of(Path::new("/tmp/7.ply")), None);
    }

    #[test]
    fn a_target_excludes_what_it_chooses() {
        let parse = |flags: &str| {
            let line = format!("slag-encoder encode --scene a --views b --store c {flags}");
            Cli::command().try_get_matches_from(line.split_whitespace())
        };
        for flag in ["--preset fast", "--no-objects", "--max-components 8", "--fill true", "--segmenter x"] {
            parse(flag).expect("a flag of encode");
            let error = parse(&format!("--front f.json --target-bytes 3MiB {flag}")).expect_err("excluded");
            assert_eq!(error.kind(), clap::error::ErrorKind::ArgumentConflict, "{flag}");
        }
        parse("--front f.json --target-bytes 3MiB --threads 2").expect("no choice");
        assert!(parse("--front f.json --target-seconds 0").is_err());
        let without = parse("--target-seconds 60").expect_err("no front");
        assert_eq!(without.kind(), clap::error::ErrorKind::MissingRequiredArgument);
    }
}
