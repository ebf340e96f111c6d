//! `models list|pull|verify`, shared by both programs.

use std::fmt;
use std::io::{self, BufRead, IsTerminal, Write};
use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use serde::Serialize;

use crate::hub::{Entry, Here, Hub, HubError, HubOptions, PulledFile, Side, cache_folder, models_folder};
use crate::{ModelDir, ModelError, Provider, SessionOptions, find_runtime};

/// The `models` subcommands.
#[derive(Debug, Subcommand)]
pub enum ModelsCommand {
    /// Lists the known public models and shows which are pulled.
    List,
    /// Pulls public models into the user's cache; resumes an interrupted pull.
    Pull(PullArgs),
    /// Compares the files of models with their recorded hashes.
    Verify {
        /// Names of pulled models, or folders [default: all pulled models].
        models: Vec<PathBuf>,
    },
}

/// `models pull`.
#[derive(Debug, Args)]
pub struct PullArgs {
    /// Names from `models list`.
    #[arg(required = true)]
    names: Vec<String>,
    /// Accepts a licence that restricts the use of a model, by its name; without it, the terminal asks. Licences
    /// that do not restrict use are shown and need no consent.
    #[arg(long, visible_alias = "accept-license", value_name = "LICENCE")]
    accept_licence: Vec<String>,
    /// Address of a mirror of the hub.
    #[arg(long, value_name = "URL")]
    hub: Option<String>,
}

const COLOURS: &str = "colours";
/// Help text of the robot's `--models`, the cases of [`open`].
pub const MODELS_HELP: &str = "Folder with model.toml, or name of a pulled model (`models list`), or `colours`, \
    which recognises only colours and needs no ONNX Runtime [default: the text model that the scene carries, else \
    the embedded one]";

/// Options of running models.
#[derive(Clone, Debug, Args)]
pub struct RunArgs {
    /// ONNX Runtime library [default: beside this program, else on the system's library path].
    #[arg(long, value_name = "FILE", env = "ORT_DYLIB_PATH", help_heading = "Machine")]
    pub runtime: Option<PathBuf>,
    /// Devices to run models on, in order of preference: cpu, cuda, tensorrt, coreml, directml. Without cpu in the
    /// list, it is an error if none of them can be used.
    #[arg(
        long,
        value_name = "NAME,...",
        value_delimiter = ',',
        default_value = "cpu",
        help_heading = "Machine"
    )]
    pub provider: Vec<Provider>,
    /// Threads for each run of a model, at most 256 [default: 1 if views are encoded in parallel, else all cores, at
    /// most 4].
    #[arg(
        long,
        value_name = "N",
        value_parser = clap::value_parser!(u32).range(1..=256),
        help_heading = "Machine",
        hide_short_help = true
    )]
    pub model_threads: Option<u32>,
}

impl RunArgs {
    /// `default_threads` applies unless the user sets a number; `beside`: folders to search for the runtime.
    pub fn session_options(
        &self,
        beside: &[PathBuf],
        default_threads: usize,
    ) -> Result<SessionOptions, ModelError> {
        let intra_op_threads = self.model_threads.map_or(default_threads, |n| n as usize);
        let runtime = find_runtime(self.runtime.as_deref(), beside)?;
        let providers = self.provider.clone();
        Ok(SessionOptions { intra_op_threads, providers, ..SessionOptions::new(runtime) })
    }
}

/// What the commands need from their program.
pub struct Context<'a> {
    pub variable: &'a dyn Fn(&str) -> Option<std::ffi::OsString>,
    pub side: Side,
    pub ask: &'a dyn Fn(&str) -> bool,
}

/// Returns the hub's options in this environment; `None` without a cache folder.
fn options(variable: &dyn Fn(&str) -> Option<std::ffi::OsString>) -> Option<HubOptions> {
    let proxy = ["HTTPS_PROXY", "https_proxy"].into_iter().find_map(variable);
    let root = models_folder(&cache_folder(variable)?);
    let proxy = proxy.and_then(|proxy| proxy.into_string().ok()).filter(|proxy| !proxy.is_empty());
    Some(HubOptions { proxy, ..HubOptions::new(root) })
}

pub fn resolve(
    model: &Path,
    variable: &dyn Fn(&str) -> Option<std::ffi::OsString>,
) -> Result<PathBuf, HubError> {
    match options(variable) {
        Some(options) => Hub::new(options).resolve(model),
        None => Ok(model.to_owned()),
    }
}

/// Opens the model of `--models`: by default the embedded encoders, [`ModelDir::colours`] by name, else a folder or a
/// pulled model.
/// # Errors
/// As [`resolve`] and [`ModelDir::open`].
pub fn open(
    asked: Option<&Path>,
    variable: &dyn Fn(&str) -> Option<std::ffi::OsString>,
) -> Result<ModelDir, HubError> {
    Ok(match asked {
        None => ModelDir::embedded()?,
        Some(name) if name == Path::new(COLOURS) => ModelDir::colours(),
        Some(model) => ModelDir::open(&resolve(model, variable)?)?,
    })
}

/// Folders that may hold ONNX Runtime: `exe`'s own, `lib/slag` and `lib/PROGRAM` of its prefix, the build folder above.
pub fn runtime_folders(exe: &Path) -> Vec<PathBuf> {
    let packaged = Path::new("lib").join(exe.file_stem().unwrap_or_default());
    let built = Path::new("onnxruntime").join(std::env::consts::ARCH);
    let within = [Path::new(""), Path::new("lib/slag"), &packaged, &built];
    let above = exe.ancestors().skip(1).take(3);
    above.flat_map(|folder| within.map(|below| folder.join(below))).collect()
}

/// Asks a question on the terminal; false without one.
pub fn ask(question: &str) -> bool {
    if !io::stdin().is_terminal() || !io::stderr().is_terminal() {
        return false;
    }
    let mut answer = String::new();
    let asked =
        write!(io::stderr(), "{question} [y/N] ").and_then(|()| io::stdin().lock().read_line(&mut answer));
    asked.is_ok() && matches!(answer.trim(), "y" | "Y" | "yes")
}

pub fn run(command: &ModelsCommand, context: &Context<'_>) -> Result<Report, HubError> {
    let no_folder = || {
        let fault = "neither XDG_CACHE_HOME nor HOME is an absolute path, so there is no folder for models";
        HubError::Other(format!("{fault}; set one of them"))
    };
    let mut options = options(context.variable).ok_or_else(no_folder)?;
    if let ModelsCommand::Pull(PullArgs { hub, .. }) = command {
        options.hub.clone_from(hub);
    }
    let hub = Hub::new(options);
    match command {
        ModelsCommand::List => {
            Ok(Report::Models(hub.table().models.iter().map(|entry| Listed::new(&hub, entry)).collect()))
        }
        ModelsCommand::Pull(args) => {
            let pulled = args.names.iter().map(|name| pull(&hub, name, &args.accept_licence, context));
            Ok(Report::Pulled(pulled.collect::<Result<_, _>>()?))
        }
        ModelsCommand::Verify { models } => {
            let here = hub.table().models.iter().filter(|entry| hub.here(entry) != Here::No);
            let folders = match models.is_empty() {
                true => here.map(|entry| hub.folder(entry)).collect(),
                false => models.iter().map(|model| hub.resolve(model)).collect::<Result<Vec<_>, _>>()?,
            };
            let verified = folders.into_iter().map(|folder| {
                let files = Hub::verify(&folder)?;
                Ok(Verified { folder, files })
            });
            Ok(Report::Verified(verified.collect::<Result<_, HubError>>()?))
        }
    }
}

fn pull(hub: &Hub, name: &str, accepted: &[String], context: &Context<'_>) -> Result<Pulled, HubError> {
    let side = context.side;
    let entry = hub.entry(name)?;
    let files = match hub.pull(name, side, accepted.contains(&entry.licence)) {
        Err(HubError::Licence { name, licence, url, note }) => {
            let question = format!("{name} is licensed under {licence} ({url}). {note} Accept?");
            if !(context.ask)(&question) {
                return Err(HubError::Licence { name, licence, url, note });
            }
            hub.pull(&name, side, true)?
        }
        pulled => pulled?,
    };
    let Entry { licence, licence_url, licence_note, .. } = entry.clone();
    Ok(Pulled { name: name.to_owned(), licence, licence_url, licence_note, folder: hub.folder(entry), files })
}

#[derive(Debug, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Report {
    Models(Vec<Listed>),
    Pulled(Vec<Pulled>),
    Verified(Vec<Verified>),
}

#[derive(Debug, Serialize)]
pub struct Listed {
    name: String,
    about: String,
    licence: String,
    here: Here,
}

impl Listed {
    fn new(hub: &Hub, entry: &Entry) -> Self {
        let Entry { name, about, licence, .. } = entry.clone();
        Self { name, about, licence, here: hub.here(entry) }
    }
}

#[derive(Debug, Serialize)]
pub struct Pulled {
    name: String,
    licence: String,
    licence_url: String,
    licence_note: String,
    folder: PathBuf,
    files: Vec<PulledFile>,
}

/// A model with files that match their hashes.
#[derive(Debug, Serialize)]
pub struct Verified {
    folder: PathBuf,
    files: Vec<String>,
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Models(models) => models.iter().try_for_each(|model| {
                let here = match model.here {
                    Here::No => "-",
                    Here::Text => "text",
                    Here::All => "here",
                };
                writeln!(f, "{:28} {here:5} {:11} {}", model.name, model.licence, model.about)
            }),
            Self::Pulled(models) => models.iter().try_for_each(|model| {
                writeln!(f, "{} in {}", model.name, model.folder.display())?;
                writeln!(f, "  licence {} ({}) {}", model.licence, model.licence_url, model.licence_note)?;
                model.files.iter().try_for_each(|file| {
                    let was_here = if file.was_here { ", already present" } else { "" };
                    let source = file.hash_source;
                    writeln!(f, "  {}  {} ({source}{was_here})", file.sha256, file.path)
                })
            }),
            Self::Verified(models) if models.is_empty() => writeln!(f, "no models pulled"),
            Self::Verified(models) => models.iter().try_for_each(|model| {
                writeln!(
                    f,
                    "{}: {} match their recorded hashes",
                    model.folder.display(),
                    model.files.join(", ")
                )
            }),
        }
    }
}
