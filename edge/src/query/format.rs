//! Formats of a reply.

use std::io;

#[cfg(feature = "arrow")]
use super::arrow;
use super::json;
use super::ply;
use super::reply::Reply;

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Format {
    /// One object; for several questions, `{"batch":[…]}`.
    #[default]
    Json,
    /// Columns as an Arrow IPC stream; Gaussians only.
    Arrow,
    /// The Gaussians of all answers as a PLY of points.
    Ply,
}

impl Format {
    /// Returns the formats of this build.
    pub fn available() -> &'static [Self] {
        if cfg!(feature = "arrow") { &[Self::Json, Self::Arrow, Self::Ply] } else { &[Self::Json, Self::Ply] }
    }

    /// Returns the name used in URLs.
    pub fn name(self) -> &'static str {
        match self {
            Self::Json => "json",
            Self::Arrow => "arrow",
            Self::Ply => "ply",
        }
    }

    pub fn media_type(self) -> &'static str {
        match self {
            Self::Json => "application/json",
            Self::Arrow => "application/vnd.apache.arrow.stream",
            // PLY has no registered type.
            Self::Ply => "application/octet-stream",
        }
    }
}

impl std::fmt::Display for Format {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl std::str::FromStr for Format {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let found = Self::available().iter().copied().find(|format| format.name() == text);
        found.ok_or_else(|| {
            let names = Self::available().iter().map(|format| format.name()).collect::<Vec<_>>().join(", ");
            let built = if cfg!(feature = "arrow") { "" } else { " (this program is built without Arrow)" };
            format!("one of {names}{built}")
        })
    }
}

impl Reply {
    /// Returns the Gaussians of all answers as a PLY of points, in the same pieces as [`Reply::pieces`] does.
    /// Clusters and objects need [`QueryRequest::members`](super::QueryRequest::members).
    pub fn ply(&self) -> impl Iterator<Item = io::Result<Vec<u8>>> {
        ply::Pieces::new(self)
    }

    /// Returns the reply in pieces of at most a fraction of a megabyte, each made on demand.
    pub fn pieces(self, format: Format) -> Box<dyn Iterator<Item = io::Result<Vec<u8>>> + Send> {
        match format {
            Format::Json => Box::new(json::Pieces::new(self)),
            Format::Ply => Box::new(ply::Pieces::new(self)),
            #[cfg(feature = "arrow")]
            Format::Arrow => Box::new(arrow::Pieces::new(self)),
            #[cfg(not(feature = "arrow"))]
            Format::Arrow => {
                Box::new(std::iter::once(Err(io::Error::other("this program is built without Arrow"))))
            }
        }
    }
}
