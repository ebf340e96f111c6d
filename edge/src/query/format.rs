//! Formats of a reply.

use std::io;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

#[cfg(feature = "arrow")]
use super::arrow;
use super::json;
use super::ply;
use super::reply::Reply;

/// Format of answers that come at once.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Format {
    /// One object; for several questions, `{"batch":[…]}`.
    #[default]
    Json,
    /// Columns as an Arrow IPC stream; Gaussians only. `Accept: application/vnd.apache.arrow.stream` has the same
    /// effect.
    #[cfg(feature = "arrow")]
    Arrow,
    /// The Gaussians of all answers as a PLY of points.
    Ply,
}

impl Format {
    pub fn media_type(self) -> &'static str {
        match self {
            Self::Json => "application/json",
            #[cfg(feature = "arrow")]
            Self::Arrow => "application/vnd.apache.arrow.stream",
            // PLY has no registered type.
            Self::Ply => "application/octet-stream",
        }
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
        }
    }
}
