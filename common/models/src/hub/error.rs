//! Errors of pulling models.

use std::io;
use std::path::PathBuf;

use super::source::Source;
use crate::description::{DescriptionError, Sha256};
use crate::download::{DownloadError, DownloadFailure};
use crate::error::ModelError;

/// Error of pulling, finding or verifying a model.
#[derive(Debug, thiserror::Error)]
pub enum HubError {
    /// The table has no such model.
    #[error("unknown model {name:?}; there are {}: choose one, or give the folder of your own model", known.join(", "))]
    Unknown {
        /// The requested name.
        name: String,
        /// The known names.
        known: Vec<String>,
    },
    /// The licence has not been accepted.
    #[error(
        "{name} is licensed under {licence} ({url}), which restricts its use{}; if you accept it, pull with \
         --accept-licence {licence}",
        if note.is_empty() { String::new() } else { format!("; note: {}", note.trim_end_matches('.')) }
    )]
    Licence {
        /// The model.
        name: String,
        /// Its licence.
        licence: String,
        /// Address of the licence.
        url: String,
        /// Remarks on the licence.
        note: String,
    },
    /// No ONNX export of the weights is published.
    #[error(
        "{name}: {repository} publishes weights, but no ONNX files; make them with `{script} {}` where PyTorch and the \
         hub can be reached, then use the model by its name",
        folder.display()
    )]
    NotExported {
        /// The model.
        name: String,
        /// Owner and name at the hub.
        repository: String,
        /// The script that makes the files.
        script: String,
        /// The folder for them.
        folder: PathBuf,
    },
    /// A segmenter has nothing for a robot.
    #[error("{name} finds masks in photos, which a robot does not do; pull it with slag-encoder")]
    NoTextSide {
        /// The model.
        name: String,
    },
    /// The hub does not provide the files.
    #[error("{url}: {failure}; try again, or place these files by hand: {}", wanted.iter().map(Wanted::to_string).collect::<Vec<_>>().join("; "))]
    Unreachable {
        /// The requested address.
        url: String,
        /// The cause.
        failure: Box<DownloadError>,
        /// The model's missing files.
        wanted: Vec<Wanted>,
    },
    /// The model is in the table but not pulled.
    #[error("{name} is not pulled yet; run `models pull {name}`, or give the folder of your own model")]
    NotPulled {
        /// The model.
        name: String,
    },
    /// There is no folder for models.
    #[error(
        "neither XDG_CACHE_HOME nor HOME is an absolute path, so there is no folder for models; set one of them"
    )]
    NoFolder,
    /// The proxy cannot be used.
    #[error("the proxy in HTTPS_PROXY: {0}; correct or unset it")]
    Proxy(#[from] DownloadFailure),
    /// A file's hash is not the expected one.
    #[error("{}: SHA-256 is {found}, expected {expected} ({}); {advice}", path.display(), source_of(*by))]
    Hash {
        /// The file.
        path: PathBuf,
        /// Its hash.
        found: Sha256,
        /// The expected hash.
        expected: Sha256,
        /// The source of the expected hash.
        by: Source,
        /// Advice to the user.
        advice: &'static str,
    },
    /// The hub advertises another hash.
    #[error(
        "{url}: the hub advertises SHA-256 {advertised}, expected {expected} ({}); do not use it, or take the \
         model out of models.lock if you trust the new one", source_of(*by)
    )]
    Advertised {
        /// The file.
        url: String,
        /// The advertised hash.
        advertised: Sha256,
        /// The expected hash.
        expected: Sha256,
        /// The source of the expected hash.
        by: Source,
    },
    /// The hub serves another commit.
    #[error("{url}: the hub serves commit {found}, expected {expected}; give another --hub")]
    Revision {
        /// The file.
        url: String,
        /// The commit served.
        found: String,
        /// The requested commit.
        expected: String,
    },
    /// The image model's hash, part of the encoder id, is unknown.
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
        /// The parser's error.
        cause: serde_json::Error,
    },
    /// The program's own table cannot be read.
    #[error("the program's table of models: {0}; this is a bug, please report it")]
    Table(#[from] Box<toml::de::Error>),
    /// Error of a model's description.
    #[error(transparent)]
    Description(#[from] DescriptionError),
    /// Error of opening a model.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A local file cannot be read or written.
    #[error("{0}; free disk space, or choose another folder with XDG_CACHE_HOME")]
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

/// A missing file.
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
