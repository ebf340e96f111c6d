//! `trust`: the keys a robot trusts.

use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

use crate::fetch::{AddedRoot, FetchError, FirstRoot, accepted, add_root};
use clap::{ArgGroup, Args, Subcommand};
use slag_common::files;
use slag_common::tuf::{MAX_ROOT_BYTES, format_utc};

use super::args::{CacheArgs, parse_store};
use super::failure::Failure;
use super::output::{print_json, print_pairs};
use super::progress::environment;

#[derive(Debug, Subcommand)]
pub enum TrustCommand {
    /// Trust a store by its root: the file metadata/1.root.json of the store, or a later one.
    Add(AddArgs),
    /// Show the root and scene that this robot keeps to.
    Show(ShowArgs),
}

impl TrustCommand {
    pub(crate) fn is_json(&self) -> bool {
        match self {
            Self::Add(args) => args.json,
            Self::Show(args) => args.json,
        }
    }
}

const EXAMPLES: &str = "Examples:\n\
    \x20 slag-edge trust add http://BASE:7733 --sha256 HEX\n\
    \x20 slag-edge trust add --root 1.root.json\n\
    \x20 slag-edge trust add http://BASE:7733 --trust-first\n";

#[derive(Debug, Args)]
#[command(before_help = EXAMPLES)]
#[command(group = ArgGroup::new("first").required(true).args(["root", "sha256", "trust_first"]))]
pub struct AddArgs {
    /// Address of the store; not needed with --root.
    #[arg(value_name = "URL", required_unless_present = "root", value_parser = parse_store)]
    pub from: Option<String>,
    /// The root itself, brought by hand.
    #[arg(long, value_name = "FILE")]
    pub root: Option<PathBuf>,
    /// SHA-256 of the root, brought by hand; the store at the address has the root itself.
    #[arg(long, value_name = "HEX", value_parser = parse_sha256)]
    pub sha256: Option<String>,
    /// Trust whoever answers at the address now: everything later depends on it.
    #[arg(long)]
    pub trust_first: bool,
    /// Certificates (PEM) of the authorities that may vouch for an https:// address, in place of the public ones.
    #[arg(long, value_name = "FILE")]
    pub ca: Option<PathBuf>,
    /// Trust this root in place of another one.
    #[arg(long)]
    pub replace: bool,
    #[command(flatten)]
    pub cache: CacheArgs,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

#[derive(Debug, Args)]
pub struct ShowArgs {
    #[command(flatten)]
    pub cache: CacheArgs,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

pub fn run(command: TrustCommand) -> Result<(), Failure> {
    match command {
        TrustCommand::Add(args) => add(args),
        TrustCommand::Show(args) => show(args),
    }
}

fn add(args: AddArgs) -> Result<(), Failure> {
    let from = args.from.unwrap_or_default();
    let root = match (&args.root, args.sha256) {
        (Some(path), _) => FirstRoot::Bytes(files::read_short(path, MAX_ROOT_BYTES)?),
        (None, Some(sha256)) => FirstRoot::Sha256 { from, sha256 },
        (None, None) => FirstRoot::Any { from },
    };
    let cache = args.cache.open()?;
    let cancel = AtomicBool::new(false);
    let added = add_root(&cache, &root, args.replace, &environment(args.ca.as_deref(), &cancel, &()))
        .map_err(|error| match (error, &args.root) {
            (FetchError::Tuf(error), Some(path)) => {
                let file = path.display().to_string();
                Failure::failed("fetch", anyhow::Error::new(error).context(file))
            }
            (error, _) => error.into(),
        })?;
    if args.json {
        return print_json(&added);
    }
    let AddedRoot { sha256, version, is_new } = added;
    let what = if is_new { "trusted from now on" } else { "this robot began with it; nothing changed" };
    print_pairs(&[("root", format!("{version}, {what}")), ("SHA-256", sha256)])
}

fn show(args: ShowArgs) -> Result<(), Failure> {
    let accepted = accepted(&args.cache.open()?).map_err(FetchError::from)?;
    if args.json {
        return print_json(&accepted);
    }
    let Some(accepted) = accepted else {
        return print_pairs(&[("root", "none: see `slag-edge trust add --help`".into())]);
    };
    let time = |time: Option<u64>| time.map_or("unknown".into(), format_utc);
    print_pairs(&[
        ("root", accepted.root_version.to_string()),
        ("SHA-256", accepted.root_sha256),
        ("scene", accepted.scene.unwrap_or_else(|| "that of the first fetch".into())),
        ("refreshed", time(accepted.signed_unix_secs)),
        ("expires", time(accepted.expires_unix_secs)),
    ])
}

fn parse_sha256(text: &str) -> Result<String, String> {
    match text.len() == 64 && text.bytes().all(|byte| byte.is_ascii_hexdigit()) {
        true => Ok(text.to_ascii_lowercase()),
        false => Err("expected 64 hex digits".into()),
    }
}
