//! Errors of pulling models.

use std::path::PathBuf;
use std::{fmt, io};

use serde::{Deserialize, Serialize};

use crate::description::{DescriptionError, Sha256};
use crate::download::{DownloadError, DownloadFailure};
use crate::error::ModelError;

#[derive(Debug, thiserror::Error)]
pub enum HubError {
    #[error("unknown model {name:?}; there are {}: choose one, or give the folder of your own model", known.join(", "))]
    Unknown { name: String, known: Vec<String> },
    #[error(
        "{name} is licensed under {licence} ({url}), which restricts its use{}; if you accept it, pull with \
         --accept-licence {licence}",
        if note.is_empty() { String::new() } else { format!("; note: {}", note.trim_end_matches('.')) }
    )]
    Licence { name: String, licence: String, url: String, note: String },
    #[error(
        "{name}: {repository} publishes weights, but no ONNX files; make them with `{script} {}` where PyTorch and the \
         hub can be reached, then use the model by its name",
        folder.display()
    )]
    NotExported { name: String, repository: String, script: String, folder: PathBuf },
    #[error("{name} finds masks in photos, which a robot does not do; pull it with slag-encoder")]
    NoTextSide { name: String },
    // A line per file; in one line they would be unreadable.
    #[error("{url}: {failure}; try again, or place these files by hand:{}", wanted.iter().map(Wanted::to_string).collect::<String>())]
    Unreachable { url: String, failure: Box<DownloadError>, wanted: Vec<Wanted> },
    #[error("{name} is not pulled yet; run `models pull {name}`, or give the folder of your own model")]
    NotPulled { name: String },
    #[error(
        "neither XDG_CACHE_HOME nor HOME is an absolute path, so there is no folder for models; set one of them"
    )]
    NoFolder,
    #[error("the proxy in HTTPS_PROXY: {0}; correct or unset it")]
    Proxy(#[from] DownloadFailure),
    #[error("{}: SHA-256 is {found}, expected {expected} ({by}); {advice}", path.display())]
    Hash { path: PathBuf, found: Sha256, expected: Sha256, by: Source, advice: &'static str },
    #[error(
        "{url}: the hub advertises SHA-256 {advertised}, expected {expected} ({by}); do not use it, or take the \
         model out of models.lock if you trust the new one"
    )]
    Advertised { url: String, advertised: Sha256, expected: Sha256, by: Source },
    #[error("{url}: the hub serves commit {found}, expected {expected}; give another --hub")]
    Revision { url: String, found: String, expected: String },
    #[error(
        "{url}: the hub advertises no SHA-256 of the image model; pull the whole model with slag-encoder"
    )]
    NoImageHash { url: String },
    #[error("{}: {cause}; correct it, or remove it and pull again", path.display())]
    Lock { path: PathBuf, cause: serde_json::Error },
    #[error("the program's table of models: {0}; this is a bug, please report it")]
    Table(#[from] Box<toml::de::Error>),
    #[error(transparent)]
    Description(#[from] DescriptionError),
    #[error(transparent)]
    Model(#[from] ModelError),
    #[error("{0}; free disk space, or choose another folder with XDG_CACHE_HOME")]
    Io(#[from] io::Error),
}

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
        write!(f, "\n  {url}\n    as {} (SHA-256 {hash})", path.display())
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Source {
    /// The program's table of models.
    Table,
    /// The hub, which advertises it.
    Hub,
    /// Trust on first use: the hash of the first download.
    FirstPull,
    /// The hash of a file placed by hand.
    PlacedByHand,
}

impl fmt::Display for Source {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Table => "known to this program",
            Self::Hub => "advertised by the hub",
            Self::FirstPull => "as pulled first, see models.lock",
            Self::PlacedByHand => "as placed by hand, see models.lock",
        })
    }
}
