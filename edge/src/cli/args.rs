//! Arguments shared by several commands.

use std::ffi::OsString;
use std::path::PathBuf;

use crate::fetch::{self, FetchRequest, Position};
use crate::query::{Engine, LENGTHS, is_length};
use crate::score::MAX_COORDINATE;
use crate::store::EdgeCache;
use crate::text::TextService;
use anyhow::anyhow;
use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use serde::de::DeserializeOwned;
use serde::de::value::{Error, StrDeserializer};
use slag_common::ByteSize;
use slag_common::shard::Profile;
use slag_models::commands::{self as model_commands, MODELS_HELP, RunArgs};
use slag_models::hub::cache_folder;

use super::failure::Failure;

/// Default most threads for a text model; more gain little for short texts.
const MAX_MODEL_THREADS: usize = 4;

#[derive(Debug, Args)]
pub struct CacheArgs {
    /// Cache folder [default: $XDG_CACHE_HOME/slag, else ~/.cache/slag].
    #[arg(long, value_name = "DIR")]
    pub cache: Option<PathBuf>,
}

impl CacheArgs {
    /// Opens the named cache, or the user's default.
    pub fn open(self) -> Result<EdgeCache, Failure> {
        let dir = self.cache.or_else(|| cache_folder(variable));
        let advice = || Failure::usage(anyhow!("neither XDG_CACHE_HOME nor HOME is set; give --cache DIR"));
        Ok(EdgeCache::open(dir.ok_or_else(advice)?))
    }
}

/// What a fetch brings and whom it trusts.
#[derive(Debug, Args)]
pub struct DownloadArgs {
    /// Radius around the robot within which cells are kept, world units (metres in a metric scene).
    #[arg(long, default_value_t = 50.0, value_parser = parse_radius)]
    pub radius: f64,
    /// Profile of the shards.
    #[arg(long, default_value_t = Profile::Compact, value_parser = profile_parser())]
    pub profile: Profile,
    /// At the first contact, trust whoever answers at the address. Safer: `slag-edge trust add` beforehand.
    #[arg(long)]
    pub trust_first: bool,
    /// Certificates (PEM) of the authorities that may vouch for an https:// address, in place of the public ones.
    #[arg(long, value_name = "FILE")]
    pub ca: Option<PathBuf>,
    /// Most bytes kept on disk for shards and text models [default: twice the bytes of those within the radius].
    #[arg(long, value_name = "SIZE", value_parser = parse_bytes)]
    pub max_bytes: Option<u64>,
}

impl DownloadArgs {
    /// Returns the request for a store and a position; by default those of the last fetch.
    pub fn request(self, from: Option<String>, at: Option<Position>) -> FetchRequest {
        FetchRequest {
            from,
            at,
            radius: self.radius,
            profile: self.profile,
            trust_first: self.trust_first,
            max_bytes: self.max_bytes,
            ..FetchRequest::default()
        }
    }
}

#[derive(Debug, Args)]
pub struct ModelArgs {
    #[arg(long, visible_alias = "encoder", value_name = "NAME|DIR", help = MODELS_HELP)]
    pub models: Option<PathBuf>,
    #[command(flatten)]
    pub how: RunArgs,
}

/// What answers questions: the shards on board and a text model.
#[derive(Debug, Args)]
pub struct EngineArgs {
    /// Threads for answering questions, at most 256 [default: the number of cores].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=256))]
    pub threads: Option<u32>,
    #[command(flatten)]
    pub cache: CacheArgs,
    #[command(flatten)]
    pub models: ModelArgs,
}

impl EngineArgs {
    /// Sets the number of threads for answering; once per process.
    pub fn set_threads(&self) -> Result<(), Failure> {
        let Some(n) = self.threads else { return Ok(()) };
        let built = rayon::ThreadPoolBuilder::new().num_threads(n as usize).build_global();
        built.map_err(|e| Failure::failed("threads", e))
    }

    /// Opens what is on board.
    pub fn open(self) -> Result<Engine, Failure> {
        self.set_threads()?;
        let engine = engine(self.cache.open()?, &self.models)?;
        engine.reload()?;
        Ok(engine)
    }
}

/// Makes an engine from a cache and a text model; without one given, scenes' own models are used.
pub fn engine(cache: EdgeCache, models: &ModelArgs) -> Result<Engine, Failure> {
    let failed = |e: anyhow::Error| Failure::failed("models", e);
    let given = model_commands::open(models.models.as_deref(), &variable);
    let exe = std::env::current_exe().unwrap_or_default();
    let n_cores = std::thread::available_parallelism().map_or(1, usize::from);
    let runtimes = model_commands::runtime_folders(&exe);
    // One text at a time.
    let options = models.how.session_options(&runtimes, n_cores.min(MAX_MODEL_THREADS));
    let (options, given) = (options.map_err(|e| failed(e.into()))?, given.map_err(|e| failed(e.into()))?);
    let open = || TextService::open(&given, &options).map_err(|e| failed(e.into()));
    match &models.models {
        Some(_) => Ok(Engine::new(cache, open()?)),
        None => Engine::with_carried(cache, options.clone(), open),
    }
}

/// Parses a value by its name in JSON.
pub(super) fn named<T: DeserializeOwned>(text: &str) -> Result<T, Error> {
    T::deserialize(StrDeserializer::new(text))
}

pub fn variable(name: &str) -> Option<OsString> {
    std::env::var_os(name)
}

/// Parses a store's address, so that a wrong one is refused before anything starts.
pub(super) fn parse_store(text: &str) -> Result<String, String> {
    let address = fetch::check_address(text).map(|()| text.to_owned());
    address.map_err(|what| format!("{what}; give an address like http://host:port"))
}

pub(super) fn parse_radius(text: &str) -> Result<f64, String> {
    let radius = text.parse::<f64>().ok().filter(|radius| *radius == 0.0 || is_length(*radius));
    radius.ok_or_else(|| format!("expected world units, 0 or more, at most {MAX_COORDINATE:e}"))
}

/// Parses a search radius; 0 would find nothing.
pub(super) fn parse_reach(text: &str) -> Result<f64, String> {
    let radius = parse_radius(text).ok().filter(|radius| *radius > 0.0);
    radius.ok_or_else(|| format!("expected world units, {LENGTHS}"))
}

/// Parses a number of bytes: 2GB, 2GiB or 2G.
pub fn parse_bytes(text: &str) -> Result<u64, String> {
    text.parse::<ByteSize>().map(|size| size.0)
}

pub fn profile_parser() -> impl TypedValueParser<Value = Profile> {
    PossibleValuesParser::new(Profile::ALL.map(Profile::name)).try_map(|name| name.parse::<Profile>())
}
