//! Errors of pulling models.

use std::io;
use std::path::PathBuf;

use super::download::Failure;
use super::source::Source;
use crate::description::{DescriptionError, Sha256};
use crate::error::ModelError;

/// Says why a model is not here.
#[derive(Debug, thiserror::Error)]
pub enum HubError {
    /// The table has no such model.
    #[error("no model {name:?} is known, there are {}; choose one, or give the folder of your own", known.join(", "))]
    Unknown {
        /// The name asked for.
        name: String,
        /// The names there are.
        known: Vec<String>,
    },
    /// The licence has not been accepted.
    #[error(
        "{name} is under {licence} ({url}){}; pull it with --accept-licence if you accept that",
        if note.is_empty() { String::new() } else { format!("; note: {}", note.trim_end_matches('.')) }
    )]
    Licence {
        /// The model.
        name: String,
        /// Its licence.
        licence: String,
        /// Where that stands.
        url: String,
        /// What else is to be known.
        note: String,
    },
    /// The hub does not give the files.
    #[error("{url}: {failure}; to do without the hub, put there from elsewhere: {}", wanted.iter().map(Wanted::to_string).collect::<Vec<_>>().join("; "))]
    Unreachable {
        /// What was asked for.
        url: String,
        /// What happened.
        failure: Box<Failure>,
        /// The model's files that are not here.
        wanted: Vec<Wanted>,
    },
    /// The model is of the table, but not here.
    #[error("{name} is not pulled yet; run `models pull {name}`, or give the folder of a model of your own")]
    NotPulled {
        /// The model.
        name: String,
    },
    /// There is no folder for models.
    #[error("neither XDG_CACHE_HOME nor HOME is an absolute path, so models have no place; set one")]
    NoFolder,
    /// The proxy cannot be used.
    #[error("the proxy that HTTPS_PROXY names: {0}; correct or unset it")]
    Proxy(#[from] Failure),
    /// A file is not the expected one.
    #[error("{}: SHA-256 is {found}, expected {expected} ({}); {advice}", path.display(), source_of(*by))]
    Hash {
        /// The file.
        path: PathBuf,
        /// Its hash.
        found: Sha256,
        /// The hash expected.
        expected: Sha256,
        /// Who expects it.
        by: Source,
        /// What to do.
        advice: &'static str,
    },
    /// The hub now advertises another file.
    #[error(
        "{url}: the hub advertises SHA-256 {advertised}, expected {expected} ({}); do not use it, or take the \
         model out of models.lock if you trust the new one", source_of(*by)
    )]
    Advertised {
        /// The file.
        url: String,
        /// The hash advertised.
        advertised: Sha256,
        /// The hash expected.
        expected: Sha256,
        /// Who expects it.
        by: Source,
    },
    /// The hub answers for another commit.
    #[error("{url}: the hub answers for commit {found}, expected {expected}; give another --hub")]
    Revision {
        /// The file.
        url: String,
        /// The commit answered for.
        found: String,
        /// The commit asked for.
        expected: String,
    },
    /// The image model's hash is not known, though its space's name needs it.
    #[error(
        "{url}: the hub advertises no SHA-256 of the image model; pull the whole model with slag-encoder"
    )]
    NoImageHash {
        /// The image model.
        url: String,
    },
    /// The lock cannot be read.
    #[error("{}: {cause}; correct it, or remove it and pull again", path.display())]
    Lock {
        /// The lock.
        path: PathBuf,
        /// What is wrong.
        cause: serde_json::Error,
    },
    /// The program's own table cannot be read.
    #[error("the program's table of models: {0}; this is our mistake, please report it")]
    Table(#[from] Box<toml::de::Error>),
    /// A model here is not as described.
    #[error(transparent)]
    Description(#[from] DescriptionError),
    /// The same.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A file of this machine fails.
    #[error("{0}; make room, or choose another folder with XDG_CACHE_HOME")]
    Io(#[from] io::Error),
}

fn source_of(by: Source) -> &'static str {
    match by {
        Source::Table => "known to this program",
        Source::Hub => "advertised by the hub",
        Source::FirstPull => "as pulled first, see models.lock",
        Source::PlacedByHand => "as placed by hand, see models.lock",
    }
}

/// A file that is not here.
#[derive(Clone, Debug, PartialEq)]
pub struct Wanted {
    pub(super) url: String,
    pub(super) path: PathBuf,
    pub(super) sha256: Option<Sha256>,
}

impl std::fmt::Display for Wanted {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { url, path, sha256 } = self;
        let hash = sha256.map_or("unknown".to_owned(), |sha256| sha256.to_string());
        write!(f, "{url} as {} (SHA-256 {hash})", path.display())
    }
}
