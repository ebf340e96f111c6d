//! `keys`: the key that a store signs with.

use std::fmt;
use std::path::PathBuf;

use anyhow::Result;
use clap::{Args, Subcommand};

use super::common::{now_unix_secs, print};
use super::exit::Exit;
use crate::store::keys::PublicKeys;
use crate::store::{Store, StoreError};

/// `keys`.
#[derive(Debug, Subcommand)]
pub enum KeysCommand {
    /// Shows the public keys, for `slag-edge fetch --key`.
    Show(KeysArgs),
    /// Makes the first key of a store, before the first encode.
    Generate(KeysArgs),
    /// Announces a new key and later, with --finish, switches to it.
    ///
    /// Robots that fetch between the two steps trust the new key by themselves; the others must be given it
    /// (`slag-edge fetch --key`). After the second step robots refuse the old key.
    Rotate {
        /// The store.
        #[command(flatten)]
        at: KeysArgs,
        /// The second step: the new key signs from now on.
        #[arg(long)]
        finish: bool,
    },
}

/// The store whose keys are meant.
#[derive(Debug, Args)]
pub struct KeysArgs {
    /// Store.
    #[arg(long, value_name = "DIR")]
    pub store: PathBuf,
}

pub(super) fn run(command: &KeysCommand, json: bool) -> Result<Exit> {
    let keys = match command {
        KeysCommand::Show(at) => PublicKeys::read(&at.store)?,
        KeysCommand::Generate(at) if PublicKeys::read(&at.store).is_ok() => {
            return Err(StoreError::HasKey { store: at.store.clone() }.into());
        }
        KeysCommand::Generate(at) => {
            Store::create_or_open(&at.store)?;
            PublicKeys::read(&at.store)?
        }
        KeysCommand::Rotate { at, finish } => {
            // A mistyped path must not create a store.
            PublicKeys::read(&at.store)?;
            let mut store = Store::create_or_open(&at.store)?;
            match finish {
                false => store.begin_rotation(now_unix_secs())?,
                true => store.finish_rotation(now_unix_secs())?,
            }
        }
    };
    print(json, &keys, Lines(&keys))?;
    Ok(Exit::Done)
}

struct Lines<'a>(&'a PublicKeys);

impl fmt::Display for Lines<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let PublicKeys { present, next, previous } = self.0;
        writeln!(f, "present   {present}")?;
        if let Some(next) = next {
            writeln!(f, "next      {next} (in place after `slag-encoder keys rotate --finish`)")?;
        }
        match previous {
            Some(previous) => writeln!(f, "previous  {previous} (no longer accepted)"),
            None => Ok(()),
        }
    }
}
