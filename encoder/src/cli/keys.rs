//! `keys`: the keys of a store's roles.

use std::fmt::{self, Write};
use std::path::PathBuf;

use anyhow::{Result, bail};
use clap::{Args, Subcommand, ValueEnum};
use serde_json::json;
use slag_common::tuf::format_utc;

use super::common::{Exit, print, warn_of_expiry};
use crate::store::ceremony::{Change, Changed, KeysStatus, default_root_folder, sign_draft};
use crate::store::check_folder;
use crate::store::metadata::{Metadata, MetadataReader, signing_unix_secs};

/// `keys`.
#[derive(Debug, Subcommand)]
pub enum KeysCommand {
    /// Makes all keys and the first root, before the first encode. Without it, the first encode makes one key a
    /// role.
    Init {
        /// The store.
        #[command(flatten)]
        at: KeysArgs,
        /// Number of root keys.
        #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=64))]
        n_root_keys: u32,
        /// Root keys that must sign a change of keys.
        #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=64))]
        threshold: u32,
    },
    /// Shows root, keys and expiry, and the SHA-256 for `slag-edge trust add --sha256`.
    Status(KeysArgs),
    /// Signs the root anew with the same keys, for five more years, before or after it expires. Robots follow by
    /// themselves.
    Renew(KeysArgs),
    /// Replaces all keys of some roles by new ones. Robots follow by themselves.
    Rotate {
        /// The roles.
        #[arg(required = true, value_name = "ROLE")]
        roles: Vec<Role>,
        /// The store.
        #[command(flatten)]
        at: KeysArgs,
    },
    /// Replaces a key that leaked or was lost, by its id (`keys status`). Robots follow by themselves.
    Revoke {
        /// Id of the key.
        #[arg(value_name = "ID")]
        id: String,
        /// The store.
        #[command(flatten)]
        at: KeysArgs,
    },
    /// Signs the draft of a root, on the machine that has root's keys.
    Sign {
        /// The draft, `keys/N.root.draft.json` of the store.
        #[arg(value_name = "FILE")]
        draft: PathBuf,
        /// Folder of root's keys.
        #[arg(long, value_name = "DIR")]
        root_keys: PathBuf,
    },
    /// Puts a signed draft in place, and signs again what the former keys signed.
    Install {
        /// The draft.
        #[arg(value_name = "FILE")]
        draft: PathBuf,
        /// The store.
        #[command(flatten)]
        at: KeysArgs,
    },
}

/// The store whose keys are meant.
#[derive(Debug, Args)]
pub struct KeysArgs {
    /// Store.
    #[arg(long, value_name = "DIR")]
    pub store: PathBuf,
    /// Folder of root's keys [default: keys/root in the store].
    #[arg(long, value_name = "DIR")]
    pub(crate) root_keys: Option<PathBuf>,
}

impl KeysArgs {
    fn root_folder(&self) -> PathBuf {
        self.root_keys.clone().unwrap_or_else(|| default_root_folder(&self.store))
    }

    /// Refuses a path without a store.
    fn check(&self) -> Result<()> {
        if !self.store.join("metadata").is_dir() {
            bail!("{}: there is no store; run `slag-encoder keys init`, or encode", self.store.display());
        }
        Ok(())
    }

    fn change(&self, change: &Change, now_unix_secs: u64) -> Result<Changed> {
        self.check()?;
        Ok(Metadata::open(&self.store)?.change_keys(change, &self.root_folder(), now_unix_secs)?)
    }
}

/// A role of The Update Framework.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Role {
    /// Names the keys of all roles.
    Root,
    /// Signs for the manifest.
    Targets,
    /// Signs the version of the targets metadata.
    Snapshot,
    /// Signs the version of the snapshot, for a short time.
    Timestamp,
}

pub(super) fn run(command: &KeysCommand, json: bool) -> Result<Exit> {
    let now = signing_unix_secs();
    match command {
        KeysCommand::Init { at, n_root_keys, threshold } => {
            if threshold > n_root_keys {
                bail!("--threshold is {threshold} of {n_root_keys} root keys; expected at most as many");
            }
            check_folder(&at.store)?;
            fs_err::create_dir_all(&at.store)?;
            let metadata = Metadata::open(&at.store)?;
            metadata.make_root(&at.root_folder(), *n_root_keys as usize, *threshold, now)?;
            show(json, &metadata.keys_status(&at.root_folder())?)
        }
        KeysCommand::Status(at) => {
            at.check()?;
            warn_of_expiry(&at.store);
            show(json, &MetadataReader::new(&at.store).keys_status(&at.root_folder())?)
        }
        KeysCommand::Renew(at) => changed(json, &at.change(&Change::Roles(Vec::new()), now)?),
        KeysCommand::Rotate { roles, at } => {
            let names = roles.iter().filter_map(|role| Some(role.to_possible_value()?.get_name().to_owned()));
            let change = Change::Roles(names.collect());
            changed(json, &at.change(&change, now)?)
        }
        KeysCommand::Revoke { id, at } => changed(json, &at.change(&Change::Key(id.clone()), now)?),
        KeysCommand::Sign { draft, root_keys } => {
            let n_keys = sign_draft(draft, root_keys)?;
            let line =
                format!("signed with {n_keys} keys; next: slag-encoder keys install, where the store lies\n");
            print(json, &json!({ "n_keys": n_keys }), line)?;
            Ok(Exit::Done)
        }
        KeysCommand::Install { draft, at } => {
            at.check()?;
            changed(json, &Metadata::open(&at.store)?.install_root(draft, now)?)
        }
    }
}

fn show(json: bool, status: &KeysStatus) -> Result<Exit> {
    print(json, status, lines(status)?)?;
    Ok(Exit::Done)
}

fn changed(json: bool, changed: &Changed) -> Result<Exit> {
    let version = changed.root_version;
    let line = match (&changed.draft, &changed.root_sha256) {
        (Some(draft), _) => format!(
            "root {version} lacks signatures: carry {} to root's keys, run `slag-encoder keys sign` there, and \
             `slag-encoder keys install` here\n",
            draft.display()
        ),
        (None, sha256) => {
            format!("root {version} is in place, SHA-256 {}\n", sha256.as_deref().unwrap_or(""))
        }
    };
    print(json, changed, line)?;
    Ok(Exit::Done)
}

fn lines(status: &KeysStatus) -> Result<String, fmt::Error> {
    let mut lines = String::new();
    let expires = format_utc(status.root_expires_unix_secs);
    writeln!(lines, "root       {} until {expires}", status.root_version)?;
    writeln!(lines, "SHA-256    {}", status.root_sha256)?;
    writeln!(lines, "threshold  {}", status.threshold)?;
    let timestamp = status.timestamp_expires_unix_secs.map_or("not published yet".into(), format_utc);
    writeln!(lines, "timestamp  until {timestamp}")?;
    for key in &status.keys {
        let place = if key.is_here { "" } else { " (elsewhere)" };
        writeln!(lines, "{:<10} {}{place}", key.role, key.id)?;
    }
    Ok(lines)
}
