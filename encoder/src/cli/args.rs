//! The flags.

use std::net::SocketAddr;
use std::num::NonZeroUsize;
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};

use slag_common::shard::Profile;
use slag_models::commands::{ModelsCommand, RunArgs};

use super::bench::{CodecBenchArgs, FieldBenchArgs, LiftBenchArgs, RasterBenchArgs};
use super::eval::{EvalEncoderArgs, EvalLerfArgs, EvalScannetArgs};
use super::keys::KeysCommand;
use super::noise::EvalNoiseArgs;
use super::preset::Preset;
use super::refine::RefineArgs;
use super::sam::SamArgs;
use super::tradeoff::TradeoffArgs;
use super::views::{ViewsArgs, parse_raster_width, parse_views_limit};
use crate::embed::Background;
use crate::encode::{RasterWidth, ViewsLimit};
use crate::eval::Filter;
use crate::generate::crops::Split;
use crate::generate::grammar::SceneKind;
use crate::raster::WeightKind;
use crate::raster::devices::DeviceChoice;

/// Makes 3D Gaussian splatting scenes searchable by words.
#[derive(Debug, Parser)]
#[command(version, propagate_version = true)]
pub struct Cli {
    /// Prints less: no progress, warnings only.
    #[arg(long, short, global = true)]
    quiet: bool,
    /// Prints the result, or the error, as one JSON object.
    #[arg(long, global = true)]
    pub json: bool,
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

impl Cli {
    /// Returns the log level where RUST_LOG does not say otherwise.
    pub fn log_level(&self) -> &'static str {
        if self.quiet { "warn" } else { "info" }
    }

    /// Returns whether progress may be shown.
    pub fn shows_progress(&self) -> bool {
        !self.quiet && !self.json
    }
}

/// What the program can do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Renders the scene at sample views and compares it with the photos: do poses and scene fit?
    Check(CheckArgs),
    /// Encodes a scene into a store.
    Encode(Box<EncodeArgs>),
    /// Scores every Gaussian of a store against a text, in full precision.
    Query(QueryArgs),
    /// Serves a store's manifest and shards over HTTP.
    Serve(ServeArgs),
    /// Shows, makes and changes the key that a store signs with.
    #[command(subcommand)]
    Keys(KeysCommand),
    /// Public models: what is known, pulling, checking, showing.
    #[command(subcommand)]
    Models(ModelsCommand),
    /// Pushes a store elsewhere.
    #[command(subcommand)]
    Push(PushCommand),
    /// Measures answers against labels.
    #[command(subcommand)]
    Eval(EvalCommand),
    /// Makes scenes and crops whose contents are known.
    #[command(subcommand)]
    Generate(GenerateCommand),
    /// Generates a house and yard, encodes, serves, fetches and asks: the whole system in one command.
    Demo(DemoArgs),
    /// Lists the GPUs that can rasterise.
    Devices,
    /// Measures this machine.
    #[command(subcommand)]
    Bench(BenchCommand),
}

/// Where models come from.
#[derive(Clone, Debug, Args)]
pub struct ModelArgs {
    /// Folder with model.toml, or name of a pulled model (`models list`); the embedded encoders if absent; `colours`
    /// knows colours only, and needs no ONNX Runtime.
    #[arg(long, visible_alias = "encoder", value_name = "NAME|DIR")]
    pub models: Option<PathBuf>,
    /// How they run.
    #[command(flatten)]
    pub how: RunArgs,
}

/// Scene, poses, photos.
#[derive(Debug, Args)]
pub struct InputArgs {
    /// Splat: .ply, .spz, compressed .ply, .sog (file or folder) or .splat.
    #[arg(long, value_name = "FILE")]
    pub scene: PathBuf,
    /// Poses: a COLMAP model's folder or a nerfstudio transforms.json.
    #[arg(long, value_name = "PATH")]
    pub views: PathBuf,
    /// Photos, where they are not beside the poses.
    #[arg(long, value_name = "DIR")]
    pub images: Option<PathBuf>,
    /// Treats a missing or unreadable photo or mask as an error instead of leaving the view out.
    #[arg(long)]
    pub strict: bool,
}

/// `check`.
#[derive(Debug, Args)]
pub struct CheckArgs {
    /// Scene, poses, photos.
    #[command(flatten)]
    pub input: InputArgs,
    /// Views to render, evenly spread.
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..))]
    pub samples: u32,
    /// Where to render: auto, gpu, cpu, or an adapter's number.
    #[arg(long, value_name = "DEVICE", default_value_t)]
    pub device: DeviceChoice,
    /// Width to render at, pixels.
    #[arg(long, value_name = "PX", default_value_t = 1000, value_parser = clap::value_parser!(u32).range(16..=8192))]
    pub raster_width: u32,
    /// Writes photo and rendering side by side as PNG into this folder.
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
}

/// `encode`.
#[derive(Debug, Args)]
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
    /// `auto` for a segmenter (the embedded one, or --segmenter), `graph` for the one that needs no ONNX Runtime, or a
    /// folder of masks: id PNGs or COCO RLE JSON.
    #[arg(long, value_name = "auto|graph|DIR", default_value = "auto")]
    pub masks: String,
    /// The segmenter, where it is not the built-in one.
    #[command(flatten)]
    pub sam: SamArgs,
    /// Ids of mask PNGs that are no mask, beside 0.
    #[arg(long, value_name = "ID", value_delimiter = ',')]
    pub ignore_mask_ids: Vec<u32>,
    /// Bundle of the method's choices; flags change single ones.
    #[arg(long, value_enum, default_value = "balanced")]
    pub preset: Preset,
    /// How sums become embeddings, where not as the preset says.
    #[command(flatten)]
    pub refine: RefineArgs,
    /// What fills a crop outside its mask; the preset's if absent.
    #[arg(long, value_enum)]
    pub background: Option<BackgroundArg>,
    /// Weight that is summed; the preset's if absent. `falloff` is the paper's formula as printed.
    #[arg(long, value_enum)]
    pub weights: Option<WeightsArg>,
    /// Views to use at most, or which part of them: the first ones of --view-order [default: the preset's].
    #[arg(long, value_name = "N|P%", value_parser = parse_views_limit)]
    pub views_limit: Option<ViewsLimit>,
    /// Which views come first, and how long to go on.
    #[command(flatten)]
    pub views: ViewsArgs,
    /// Where weights are rasterised: auto (GPUs, else the CPU), gpu, cpu, or an adapter's number.
    #[arg(long, value_name = "DEVICE", default_value_t)]
    pub device: DeviceChoice,
    /// Width at which weights are rasterised: pixels; `photo` for the photo's own, at most 1024; `auto` for twice as much
    /// in views whose masks have long borders [default: the preset's].
    #[arg(long, value_name = "auto|photo|PX", value_parser = parse_raster_width)]
    pub raster_width: Option<RasterWidth>,
    /// Masks with fewer pixels are left out [default: the preset's].
    #[arg(long, value_name = "PX")]
    pub min_mask_px: Option<u32>,
    /// Threads; all cores if absent.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
    /// Working memory for sums and region vectors: a number with KiB, MiB or GiB.
    #[arg(long, value_name = "BYTES", default_value = "2GiB", value_parser = parse_bytes)]
    pub memory: u64,
    /// Name of the scene; the store's folder name if absent.
    #[arg(long, value_name = "NAME")]
    pub name: Option<String>,
    /// Says that world units are metres (a geo-reference says so too).
    #[arg(long)]
    pub metric: bool,
    /// Geo-reference JSON: {"origin": {"lat", "lon", "alt"}} of the world's east-north-up frame.
    #[arg(long, value_name = "FILE")]
    pub geo: Option<PathBuf>,
    /// Gaussians a cell at most.
    #[arg(long, value_name = "N", default_value_t = 65_536, value_parser = clap::value_parser!(u32).range(1..=65_536))]
    pub cell_gaussians: u32,
    /// Width of a cell at most, metres, in metric scenes.
    #[arg(long, value_name = "M", default_value_t = 25.0)]
    pub cell_width_m: f64,
    /// Which shards to make.
    #[arg(long, value_name = "NAMES", value_delimiter = ',', num_args = 1.., default_values_t = Profile::ALL)]
    pub profiles: Vec<Profile>,
    /// Error of scores that the compact profile may have: mean, relative to the spread of scores [default: the preset's].
    #[arg(long, value_name = "E", value_parser = parse_error)]
    pub compact_error: Option<f32>,
    /// The same for the balanced profile.
    #[arg(long, value_name = "E", value_parser = parse_error)]
    pub balanced_error: Option<f32>,
    /// Error of positions, world units [default: 0.01 in metric scenes, else a quarter of the size of a
    /// cell's small Gaussians].
    #[arg(long, value_name = "E")]
    pub position_error: Option<f64>,
    /// Objects.
    #[command(flatten)]
    pub objects: super::objects::ObjectArgs,
    /// Days after which robots refuse the manifest; never if absent.
    #[arg(long, value_name = "DAYS")]
    pub expires_days: Option<u32>,
    /// Drops an unfinished encode of other inputs or settings.
    #[arg(long)]
    pub restart: bool,
}

/// `--background`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum BackgroundArg {
    /// White.
    White,
    /// Mid-grey.
    Grey,
    /// The photo, blurred.
    Blur,
    /// The photo as it is.
    Keep,
}

impl From<BackgroundArg> for Background {
    fn from(arg: BackgroundArg) -> Self {
        match arg {
            BackgroundArg::White => Self::White,
            BackgroundArg::Grey => Self::Grey,
            BackgroundArg::Blur => Self::Blur,
            BackgroundArg::Keep => Self::Keep,
        }
    }
}

/// `--weights`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum WeightsArg {
    /// Alpha times transmittance: what a Gaussian contributes to the picture.
    Blend,
    /// The Gaussian's falloff alone.
    Falloff,
}

impl From<WeightsArg> for WeightKind {
    fn from(arg: WeightsArg) -> Self {
        match arg {
            WeightsArg::Blend => Self::Blend,
            WeightsArg::Falloff => Self::Falloff,
        }
    }
}

/// `query`.
#[derive(Debug, Args)]
pub struct QueryArgs {
    /// Store.
    #[arg(long, value_name = "DIR")]
    pub store: PathBuf,
    /// Models; the same that the store was encoded with.
    #[command(flatten)]
    pub models: ModelArgs,
    /// What to look for.
    pub text: String,
    /// Gaussians to print, best first.
    #[arg(long, default_value_t = 10)]
    pub limit: u32,
    /// Score as a robot with shards of this profile does [default: the field in full precision].
    #[arg(long, value_name = "NAME")]
    pub profile: Option<Profile>,
    /// Scores coarse and fine masks apart and takes the best, instead of their mean.
    #[arg(long, conflicts_with = "profile")]
    pub by_mask_level: bool,
    /// Writes every Gaussian's score, in the input's order, as a NumPy array (NaN: no evidence).
    #[arg(long, value_name = "FILE")]
    pub scores: Option<PathBuf>,
}

/// `eval`.
#[derive(Debug, Subcommand)]
pub enum EvalCommand {
    /// Against a scene whose every Gaussian has a label (`generate scene` makes such).
    Labelled(EvalLabelledArgs),
    /// Against LangSplat's labels of LERF scenes (LERF-OVS).
    Lerf(EvalLerfArgs),
    /// Against ScanNet's labelled meshes, with OpenGaussian's protocol.
    Scannet(EvalScannetArgs),
    /// On crops of generated things: which noun, colour and material they show.
    Encoder(EvalEncoderArgs),
    /// How each way to aggregate falls with errors laid over true masks.
    Noise(EvalNoiseArgs),
}

/// `eval labelled`.
#[derive(Debug, Args)]
pub struct EvalLabelledArgs {
    /// Store.
    #[arg(long, value_name = "DIR")]
    pub store: PathBuf,
    /// The splat that was encoded.
    #[arg(long, value_name = "FILE")]
    pub scene: PathBuf,
    /// Folder of the labels: gt/instances.json, gt/gaussian_instance.npy; test/ and gt/test_masks/ if there are.
    #[arg(long, value_name = "DIR")]
    pub truth: PathBuf,
    /// Models; the same that the store was encoded with.
    #[command(flatten)]
    pub models: ModelArgs,
    /// Categories to ask for [default: all].
    #[arg(long, value_name = "A,B", value_delimiter = ',')]
    pub words: Vec<String>,
    /// Score as a robot with shards of this profile does [default: the field in full precision].
    #[arg(long, value_name = "NAME")]
    pub profile: Option<Profile>,
    /// Scores coarse and fine masks apart and takes the best, instead of their mean.
    #[arg(long, conflicts_with = "profile")]
    pub by_mask_level: bool,
    /// Score from which something counts as found [default: the store's].
    #[arg(long, value_name = "COSINE", allow_negative_numbers = true)]
    pub threshold: Option<f32>,
    /// Lets the Gaussians of a superpoint answer together, as the paper does.
    #[arg(long, value_enum)]
    pub superpoints: Option<Filter>,
    /// Whether objects are scored.
    #[command(flatten)]
    pub level: super::objects::EvalLevelArgs,
}

/// `serve`.
#[derive(Debug, Args)]
pub struct ServeArgs {
    /// Store.
    #[arg(long, value_name = "DIR")]
    pub store: PathBuf,
    /// Address to listen on; other machines reach it only if this says so.
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:7733")]
    pub listen: SocketAddr,
}

/// `push`.
#[derive(Debug, Subcommand)]
pub enum PushCommand {
    /// Pushes every embedding with its position to a Qdrant collection; resumes where it stopped.
    Qdrant(QdrantArgs),
}

/// `push qdrant`.
#[derive(Debug, Args)]
pub struct QdrantArgs {
    /// Store.
    #[arg(long, value_name = "DIR")]
    pub store: PathBuf,
    /// Qdrant's gRPC address.
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:6334")]
    pub url: String,
    /// Collection; made if absent.
    #[arg(long, value_name = "NAME")]
    pub collection: String,
    /// API key.
    #[arg(long, value_name = "KEY", env = "QDRANT_API_KEY", hide_env_values = true)]
    pub api_key: Option<String>,
    /// Points a request.
    #[arg(long, value_name = "N", default_value = "256")]
    pub batch: NonZeroUsize,
}

/// `generate`.
#[derive(Debug, Subcommand)]
pub enum GenerateCommand {
    /// A scene: Gaussians, photos, poses, and in `gt/` what is true about it.
    Scene(GenerateSceneArgs),
    /// Crops of things with the words that are true of them, to train an encoder.
    Crops(GenerateCropsArgs),
    /// Photos with the thing at each pixel, to train a segmenter.
    Photos(GeneratePhotosArgs),
}

/// `generate scene`.
#[derive(Debug, Args)]
pub struct GenerateSceneArgs {
    /// Folder to write into; made if absent.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// What kind of scene; several, separated by commas, are put side by side.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "room")]
    pub kind: Vec<SceneKind>,
    /// Chooses what stands where and how it looks.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Photos.
    #[arg(long, value_name = "N", default_value_t = 36, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub n_views: u32,
    /// Folder of object files (`NOUN.txt`) instead of those shipped.
    #[arg(long, value_name = "DIR")]
    pub objects: Option<PathBuf>,
}

/// `generate crops`.
#[derive(Debug, Args)]
pub struct GenerateCropsArgs {
    /// Folder to write into; made if absent.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// To learn from, or to test with.
    #[arg(long, value_enum, default_value = "train")]
    pub split: Split,
    /// Scenes to take crops from.
    #[arg(long, value_name = "N", default_value_t = 100)]
    pub n_scenes: u64,
    /// Seed of the first scene; the next ones count up.
    #[arg(long, default_value_t = 1_000_000)]
    pub seed: u64,
    /// Edge of the crops, pixels.
    #[arg(long, value_name = "PX", default_value_t = 64, value_parser = clap::value_parser!(u32).range(8..=512))]
    pub edge: u32,
    /// Folder of object files (`NOUN.txt`) instead of those shipped.
    #[arg(long, value_name = "DIR")]
    pub objects: Option<PathBuf>,
}

/// `generate photos`.
#[derive(Debug, Args)]
pub struct GeneratePhotosArgs {
    /// Folder to write into; made if absent.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Scenes to photograph.
    #[arg(long, value_name = "N", default_value_t = 100)]
    pub n_scenes: u64,
    /// Seed of the first scene; the next ones count up.
    #[arg(long, default_value_t = 2_000_000)]
    pub seed: u64,
    /// Folder of object files (`NOUN.txt`) instead of those shipped.
    #[arg(long, value_name = "DIR")]
    pub objects: Option<PathBuf>,
}

/// `demo`.
#[derive(Debug, Args)]
pub struct DemoArgs {
    /// Folder to work in; emptied of an earlier demo.
    #[arg(long, value_name = "DIR", default_value = "target/demo")]
    pub out: PathBuf,
    /// Chooses house and yard.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// How models are run.
    #[command(flatten)]
    pub how: RunArgs,
    /// Leaves the services running until ctrl-c, to try queries by hand.
    #[arg(long)]
    pub keep: bool,
}

/// `bench`.
#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// Bytes against errors of the shards' codes, beside plain 8 bits and product quantisation.
    Codec(CodecBenchArgs),
    /// Publishes a store of a generated field, for `slag-edge bench query`.
    Field(FieldBenchArgs),
    /// Weights of a view: each device on generated scenes, or on a recorded one.
    Raster(RasterBenchArgs),
    /// From the sparse sums of all views to every Gaussian's embedding, on a made-up scene.
    Lift(LiftBenchArgs),
    /// What each choice of `encode` costs and gives, on labelled scenes: table, front and plots.
    Tradeoff(TradeoffArgs),
}

/// Reads a number of bytes with an optional unit.
pub(super) fn parse_bytes(text: &str) -> Result<u64, String> {
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let factor: u64 = match &text[digits.len()..] {
        "" | "B" => 1,
        "KiB" => 1 << 10,
        "MiB" => 1 << 20,
        "GiB" => 1 << 30,
        unit => return Err(format!("unit {unit:?}: expected none, KiB, MiB or GiB")),
    };
    let number: u64 = digits.parse().map_err(|_| format!("{text:?} is no number of bytes, as 512MiB is"))?;
    let bytes = number.checked_mul(factor).ok_or_else(|| format!("{text:?} is too large"))?;
    if bytes < 64 << 20 { Err(format!("{text:?} is below the least, 64MiB")) } else { Ok(bytes) }
}

/// Reads an error of scores.
pub(super) fn parse_error(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(error) if error >= 0.0 && error.is_finite() => Ok(error),
        _ => Err("a share of the spread of scores, such as 0.1".into()),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn flags_are_consistent_and_checked() {
        Cli::command().debug_assert();
        let parse = |line: &str| Cli::try_parse_from(line.split(' '));
        assert!(
            parse("slag-encoder encode --scene a.ply --views v --store s --memory 512MiB --masks auto")
                .is_ok()
        );
        for wrong in [
            "--memory 1",
            "--memory 5TB",
            "--views-limit 0",
            "--views-limit 0%",
            "--views-limit 101%",
            "--views-limit NaN%",
            "--raster-width 15",
            "--raster-width wide",
            "--view-order best",
            "--mask-levels 0",
            "--time-budget 0",
            "--time-budget inf",
            "--threads 0",
            "--preset best",
            "--background red",
        ] {
            assert!(
                parse(&format!("slag-encoder encode --scene a.ply --views v --store s {wrong}")).is_err(),
                "{wrong}"
            );
        }
    }

    #[test]
    fn bytes_have_units() {
        assert_eq!(parse_bytes("2GiB"), Ok(2 << 30));
        assert_eq!(parse_bytes("67108864"), Ok(1 << 26));
        assert!(
            parse_bytes("99999999999GiB").is_err()
                && parse_bytes("-1").is_err()
                && parse_bytes("GiB").is_err()
        );
    }
}
