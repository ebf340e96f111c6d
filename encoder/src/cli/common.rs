//! Shared by the commands: exit codes; flags of output, models and inputs; logging, printing, interruption.

use std::ffi::OsStr;
use std::fmt::Display;
use std::io::{ErrorKind, IsTerminal, Write};
use std::num::NonZeroU32;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context, Result, anyhow, bail};
use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use serde::Serialize;
use slag_common::note;
use slag_common::shard::Profile;
use slag_models::commands::{self, RunArgs};
use slag_models::session::SessionError;
use slag_models::{ModelDir, SessionOptions, TextEncoder};
use slag_service::stop::{on_stop, stop_signal};
use tracing_subscriber::EnvFilter;

use crate::ingest::{Activated, FrameChoice};
use crate::store::StoreReader;
use crate::store::metadata::{MetadataReader, clock_unix_secs};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    Done,
    /// Failed; the message says why.
    Failed,
    /// Done without some inputs; the summary names them.
    Partly,
    /// The inputs do not fit together (`check`).
    Mismatch,
    /// Interrupted by the user; the same command resumes.
    Interrupted,
}

impl From<Exit> for ExitCode {
    /// 2 is left to clap: wrong usage.
    fn from(exit: Exit) -> Self {
        match exit {
            Exit::Done => 0,
            Exit::Failed => 1,
            Exit::Partly => 3,
            Exit::Mismatch => 4,
            Exit::Interrupted => 130,
        }
        .into()
    }
}

/// Most threads for each processor.
const MOST_THREADS_EACH: usize = 8;

/// Flags that every command has.
#[derive(Clone, Copy, Debug, Args)]
pub struct OutputArgs {
    /// Prints less: no progress, warnings only.
    #[arg(long, short, global = true)]
    pub quiet: bool,
    /// Prints the result, or the error, as one JSON object.
    #[arg(long, global = true)]
    pub json: bool,
}

impl OutputArgs {
    /// Logs to stderr from now on: with `--quiet` warnings and above, else information, too. RUST_LOG overrides both.
    ///
    /// # Panics
    /// If the process logs already.
    pub fn init_logging(self) {
        let level = if self.quiet { "warn" } else { "info" };
        tracing_subscriber::fmt()
            .with_writer(std::io::stderr)
            .with_env_filter(EnvFilter::try_from_default_env().unwrap_or_else(|_| level.into()))
            .with_ansi(std::io::stderr().is_terminal())
            .with_target(false)
            .without_time()
            // Reporting its own errors panics when stderr is closed.
            .log_internal_errors(false)
            .init();
    }

    pub fn shows_progress(self) -> bool {
        !self.quiet && !self.json
    }
}

/// Where models come from.
#[derive(Clone, Debug, Args)]
pub struct ModelArgs {
    /// Folder with model.toml, or name of a pulled model (`models list`). `colours` knows colours and shapes only,
    /// and needs no ONNX Runtime [default: the embedded models; for queries, those that the store was encoded
    /// with].
    #[arg(long, visible_alias = "encoder", value_name = "NAME|DIR", help_heading = "Models")]
    pub models: Option<PathBuf>,
    #[command(flatten)]
    pub how: RunArgs,
}

/// Scene, poses, photos.
#[derive(Clone, Debug, Args)]
pub struct InputArgs {
    /// Splat: .ply, .spz, compressed .ply, .sog (file or folder) or .splat.
    #[arg(long, value_name = "FILE", help_heading = "Inputs")]
    pub scene: PathBuf,
    /// Poses: the folder of a COLMAP model, a nerfstudio transforms.json, or a ScanNet scene folder (color/,
    /// pose/, intrinsic/). `encode` without them plans views of the splat and draws them in place of photos.
    #[arg(long, value_name = "PATH", help_heading = "Inputs")]
    pub views: Option<PathBuf>,
    /// Folder of the photos, if they are not beside the poses.
    #[arg(long, value_name = "DIR", requires = "views", help_heading = "Inputs")]
    pub images: Option<PathBuf>,
    /// Takes every Nth frame, counted by the numbers in the file names.
    #[arg(long, value_name = "N", requires = "views", help_heading = "Inputs")]
    pub every: Option<NonZeroU32>,
    /// Says how the splat's frame follows from that of the poses: `auto` for dataparser_transforms.json beside the
    /// splat, where nerfstudio's export lies with the file of its training run; `none` where both have one frame;
    /// or a file in that format, as `check --write-frame` makes it.
    #[arg(long, value_name = "auto|none|FILE", default_value = "auto", value_parser = parse_frame, help_heading = "Inputs", hide_short_help = true)]
    pub splat_frame: FrameChoice,
    /// What the splat file has in place of logarithms of scales and logits of opacities: `scales`, `opacities` or
    /// `scales,opacities`, as some exporters write them; `check` tells.
    #[arg(long, value_name = "WHICH", default_value = "none", value_parser = parse_activated, help_heading = "Inputs", hide_short_help = true)]
    pub activated: Activated,
    /// Treats a missing or unreadable photo or mask as an error instead of leaving the view out.
    #[arg(long, help_heading = "Inputs")]
    pub strict: bool,
}

impl InputArgs {
    /// Files and folders that are read; photos lie in the folder of their poses.
    pub(super) fn paths_read(&self) -> Vec<&Path> {
        let frame = match &self.splat_frame {
            FrameChoice::File(path) => Some(path.as_path()),
            FrameChoice::Auto | FrameChoice::None => None,
        };
        let views = self.views.as_deref();
        let folder = views.map(folder_of).filter(|_| self.images.is_none());
        let paths = [Some(self.scene.as_path()), views, folder, self.images.as_deref(), frame];
        paths.into_iter().flatten().collect()
    }
}

fn parse_activated(text: &str) -> Result<Activated, String> {
    let mut found = Activated::default();
    for word in text.split(',').filter(|word| *word != "none") {
        match word {
            "scales" => found.scales = true,
            "opacities" => found.opacities = true,
            _ => return Err("expected none, scales, opacities or scales,opacities".into()),
        }
    }
    Ok(found)
}

pub fn parse_frame(text: &str) -> Result<FrameChoice, String> {
    Ok(match text {
        "" => return Err("expected auto, none or a file".into()),
        "auto" => FrameChoice::Auto,
        "none" => FrameChoice::None,
        path => FrameChoice::File(path.into()),
    })
}

pub(crate) fn parse_secs(text: &str) -> Result<Duration, String> {
    let secs = text.parse().ok().filter(|secs: &f64| *secs > 0.0);
    secs.and_then(|secs| Duration::try_from_secs_f64(secs).ok())
        .ok_or_else(|| "expected seconds above 0".into())
}

/// Prints the result: as one JSON object, or as lines for people.
pub fn print(json: bool, value: &impl Serialize, lines: impl Display) -> Result<()> {
    let text = if json { serde_json::to_string(value)? + "\n" } else { lines.to_string() };
    to_stdout(&text)
}

/// The reader of stdout is gone (`| head`), which is no failure.
#[derive(Debug, thiserror::Error)]
#[error("nobody reads what is printed")]
pub struct ReaderGone;

pub(super) fn to_stdout(text: &str) -> Result<()> {
    let mut out = std::io::stdout().lock();
    out.write_all(text.as_bytes()).and_then(|()| out.flush()).map_err(|error| match error.kind() {
        ErrorKind::BrokenPipe => ReaderGone.into(),
        _ => anyhow!("stdout: {error}"),
    })
}

/// Returns a flag that a stop signal sets; a second signal ends the program at once.
pub fn cancel_flag() -> Result<Arc<AtomicBool>> {
    let flag = Arc::new(AtomicBool::new(false));
    let seen = Arc::clone(&flag);
    on_stop(move || {
        if seen.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
        note("stopping after the views in work; press ctrl-c again to stop at once");
    })
    .context("cannot listen for ctrl-c")?;
    Ok(flag)
}

/// Time to sign, seconds since 1970: SOURCE_DATE_EPOCH if set, else now.
pub fn now_unix_secs() -> Result<u64> {
    std::env::var_os("SOURCE_DATE_EPOCH").map_or_else(|| Ok(clock_unix_secs()), |text| parse_epoch(&text))
}

fn parse_epoch(text: &OsStr) -> Result<u64> {
    let secs = text.to_str().and_then(|text| text.parse().ok());
    secs.with_context(|| format!("SOURCE_DATE_EPOCH is {text:?}, expected seconds since 1970; unset it"))
}

/// Warns of store metadata that expires soon: robots then refuse the store.
pub(super) fn warn_of_expiry(store: &Path) {
    match MetadataReader::new(store).expiry_warnings(clock_unix_secs()) {
        Ok(warnings) => warnings.iter().for_each(|warning| tracing::warn!("{warning}")),
        Err(error) => tracing::warn!("{error}"),
    }
}

pub fn open_models(args: &ModelArgs) -> Result<(ModelDir, SessionOptions)> {
    let models = commands::open(args.models.as_deref(), &|name| std::env::var_os(name))?;
    Ok((models, session_options(&args.how)?))
}

/// Makes `--models` valid for a later run in another folder.
pub(crate) fn lasting_name(models: &Path) -> PathBuf {
    // The name of a pulled model is no path.
    let folder = models.is_dir().then(|| std::path::absolute(models).ok()).flatten();
    folder.unwrap_or_else(|| models.into())
}

/// One thread per model, because views are encoded in parallel.
pub fn session_options(how: &RunArgs) -> Result<SessionOptions, SessionError> {
    how.session_options(&commands::runtime_folders(&std::env::current_exe().unwrap_or_default()), 1)
}

/// Opens a store's text encoder: that of --models, else the one that the store remembers.
pub fn text_encoder_of(reader: &StoreReader, args: &ModelArgs) -> Result<Box<dyn TextEncoder>> {
    let expected = &reader.manifest().encoder;
    let remembered = reader.models()?.and_then(|record| record.models);
    let args = ModelArgs { models: args.models.clone().or(remembered), how: args.how.clone() };
    let (models, session) = open_models(&args).with_context(|| {
        format!("the store was encoded with {:?}; name these models with --models", expected.name)
    })?;
    if slag_common::Hash32(models.encoder_id().hash()) != expected.id {
        return Err(anyhow!(
            "the store was encoded with {:?} ({}), but {} is {}; name the store's models with --models",
            expected.name,
            expected.id,
            args.models.map_or("the embedded model".into(), |models| models.display().to_string()),
            models.encoder_id()
        ));
    }
    Ok(models.text_encoder(&session)?)
}

/// Threads to work with: as many as processors, or as asked, but so few that they do not hinder each other.
pub(crate) fn n_threads(asked: Option<u32>) -> usize {
    let n_processors = std::thread::available_parallelism().map_or(1, usize::from);
    let most = MOST_THREADS_EACH * n_processors;
    match asked.map(|n| n as usize) {
        Some(n) if n > most => {
            tracing::warn!("{n} threads are taken as {most}: this machine has {n_processors} processors");
            most
        }
        asked => asked.unwrap_or(n_processors),
    }
}

/// Completes on a stop signal from the user or the system.
pub async fn stopped() {
    match stop_signal() {
        Ok(stop) => stop.await,
        Err(error) => tracing::warn!("cannot listen for signals, stopping: {error}"),
    }
}

pub fn runtime() -> Result<tokio::runtime::Runtime> {
    tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .context("cannot start the service's threads")
}

/// Parser of profiles; the help lists their names.
pub(crate) fn profile_parser() -> impl TypedValueParser<Value = Profile> {
    PossibleValuesParser::new(Profile::ALL.map(Profile::name)).try_map(|name| name.parse::<Profile>())
}

/// Endings of files that are read from a folder of poses, photos or masks.
const ENDINGS: [&str; 6] = ["bin", "txt", "jpg", "jpeg", "png", "webp"];

/// Refuses outputs that would replace what a command reads; files are compared by device and inode. Of a folder of
/// inputs, new files and files of other kinds may be written.
pub(super) fn check<'a>(
    outputs: impl IntoIterator<Item = &'a Path>,
    inputs: &[&Path],
    store: Option<&Path>,
) -> Result<()> {
    for output in outputs {
        let path = std::path::absolute(output)?;
        // Links count as what they lead to.
        let path = path.canonicalize().or_else(|_| Ok::<PathBuf, std::io::Error>(with_real_folder(&path)))?;
        let shown = output.display();
        let is_in = |folder: &Path| {
            identity(folder).is_some_and(|id| path.ancestors().any(|at| identity(at) == Some(id)))
        };
        if let Some(store) = store.filter(|store| is_in(store)) {
            bail!("{shown}: the output would lie in the store {}; name a path elsewhere", store.display());
        }
        let Some(id) = identity(&path) else { continue };
        let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default().to_lowercase();
        let is_kept =
            |input: &Path| input.is_dir() && path.is_file() && is_in(input) && ENDINGS.contains(&&*ending);
        if let Some(input) = inputs.iter().find(|input| identity(input) == Some(id) || is_kept(input)) {
            bail!(
                "{shown}: the output would replace what is read from {}; name another path",
                input.display()
            );
        }
    }
    Ok(())
}

/// The folder that a file lies in.
pub(super) fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if folder.as_os_str().is_empty() => Path::new("."),
        Some(folder) => folder,
        None => path,
    }
}

fn with_real_folder(path: &Path) -> PathBuf {
    let real = path.ancestors().skip(1).find_map(|at| Some((at, at.canonicalize().ok()?)));
    let Some((at, real)) = real else { return path.to_owned() };
    path.strip_prefix(at).map_or_else(|_| path.to_owned(), |rest| real.join(rest))
}

/// Device and inode of a file or folder; `None` of others, such as pipes.
fn identity(path: &Path) -> Option<(u64, u64)> {
    let about = std::fs::metadata(path).ok()?;
    (about.is_file() || about.is_dir()).then(|| (about.dev(), about.ino()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use slag_test_support::assert_error;

    #[test]
    fn threads_are_few_for_each_processor() {
        let n_processors = std::thread::available_parallelism().expect("known").get();
        assert_eq!([n_threads(None), n_threads(Some(1))], [n_processors, 1]);
        assert_eq!(n_threads(Some(100_000)), MOST_THREADS_EACH * n_processors);
    }

    #[test]
    fn a_wrong_time_to_sign_is_refused() {
        assert_eq!(parse_epoch(OsStr::new("1700000000")).expect("seconds"), 1_700_000_000);
        for wrong in ["", "yesterday", "-1", "1.5"] {
            assert_error(parse_epoch(OsStr::new(wrong)), &["expected seconds since 1970"]);
        }
    }

    /// By every name of a file: through links, and from a folder that it lies in.
    #[test]
    fn outputs_replace_no_inputs() {
        let dir = tempfile::tempdir().expect("a folder");
        let at = |name: &str| dir.path().join(name);
        for folder in ["store/keys", "photos"] {
            fs_err::create_dir_all(at(folder)).expect("made");
        }
        for file in ["in.ply", "photos/a.JPG", "photos/report.html"] {
            fs_err::write(at(file), "kept").expect("written");
        }
        fs_err::hard_link(at("in.ply"), at("hard.ply")).expect("linked");
        std::os::unix::fs::symlink(at("store"), at("link")).expect("linked");
        let (scene, photos, store) = (at("in.ply"), at("photos"), at("store"));
        let check = |output: &str| check([&*at(output)], &[&scene, &photos], Some(&store));
        for output in ["in.ply", "hard.ply", "photos", "photos/a.JPG", "photos/../in.ply"] {
            assert_error(check(output), &["would replace what is read"]);
        }
        for output in ["store", "store/manifest", "link/new/deep.html"] {
            assert_error(check(output), &["would lie in the store"]);
        }
        for output in ["new.ply", "photos/new.png", "photos/report.html", "photos/drawn"] {
            check(output).expect(output);
        }
        super::check([Path::new("/dev/null")], &[Path::new("/dev/null")], None).expect("a device");
    }
}
