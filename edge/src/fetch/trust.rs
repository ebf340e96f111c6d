//! First trust: the root that a robot starts from.

use serde::Serialize;
use slag_common::tuf::{Kept, MAX_ROOT_BYTES, MAX_ROOTS, TufError, sha256_hex};

use super::download::Client;
use super::error::FetchError;
use super::records::Records;
use super::request::Environment;
use crate::store::EdgeCache;

#[derive(Clone, Debug, PartialEq, Eq)]
pub enum FirstRoot {
    /// Given by hand.
    Bytes(Vec<u8>),
    /// The first root of a store, with its SHA-256 in hex given by hand.
    Sha256 { from: String, sha256: String },
    /// The first root of a store, unverified.
    Any { from: String },
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct AddedRoot {
    pub sha256: String,
    pub version: u64,
    /// Whether it was trusted just now; otherwise the robot began with it, and nothing changed.
    pub is_new: bool,
}

/// Trusts a root by hand. The first root again changes nothing, so that revoked keys stay revoked. `replace`: trusts
/// it in place of another root.
pub fn add_root(
    cache: &EdgeCache,
    root: &FirstRoot,
    replace: bool,
    environment: &Environment<'_>,
) -> Result<AddedRoot, FetchError> {
    let bytes = match root {
        FirstRoot::Bytes(bytes) => bytes.clone(),
        FirstRoot::Sha256 { from, sha256 } => find_root(&Client::new(from, environment)?, sha256)?,
        FirstRoot::Any { from } => first_root(&Client::new(from, environment)?)?,
    };
    let kept = Kept::from_root(&bytes)?;
    let (sha256, version) = (sha256_hex(&bytes), kept.root_version().unwrap_or(0));
    cache.create_dir(cache.dir())?;
    let mut records = Records::open(cache)?;
    let is_new = match &records.record.first_root_sha256 {
        Some(held) if *held == sha256 => false,
        Some(held) if !replace => {
            return Err(FetchError::OtherRoot { held: held.clone(), offered: sha256 });
        }
        _ => true,
    };
    if is_new {
        records.trust(cache, kept)?;
    }
    Ok(AddedRoot { sha256, version, is_new })
}

pub(super) fn trust_first(
    client: &Client<'_>,
    cache: &EdgeCache,
    records: &mut Records,
) -> Result<bool, FetchError> {
    if records.record.kept.is_some() {
        return Ok(false);
    }
    records.trust(cache, Kept::from_root(&first_root(client)?)?)?;
    Ok(true)
}

fn first_root(client: &Client<'_>) -> Result<Vec<u8>, FetchError> {
    let name = "metadata/1.root.json";
    let missing = || TufError::Missing { what: name.to_owned() };
    Ok(client.file(name, MAX_ROOT_BYTES)?.ok_or_else(missing)?)
}

fn find_root(client: &Client<'_>, sha256: &str) -> Result<Vec<u8>, FetchError> {
    let sha256 = sha256.to_ascii_lowercase();
    for version in 1..=MAX_ROOTS {
        let Some(bytes) = client.file(&format!("metadata/{version}.root.json"), MAX_ROOT_BYTES)? else {
            break;
        };
        if sha256_hex(&bytes) == sha256 {
            return Ok(bytes);
        }
    }
    let from = &client.base;
    Err(FetchError::Request(format!(
        "{from} has no root with SHA-256 {sha256}; check the hash and the address"
    )))
}
