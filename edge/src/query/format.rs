//! Formats of a reply.

use std::io;
use std::sync::Arc;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::answers::{Found, Reply};
use super::ply;

#[cfg(feature = "arrow")]
use super::arrow;

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
    /// Returns the reply in pieces of at most a fraction of a megabyte, each made on demand. As a PLY, clusters and
    /// objects need [`QueryRequest::members`](super::QueryRequest::members).
    pub fn pieces(self: Arc<Self>, format: Format) -> Box<dyn Iterator<Item = io::Result<Vec<u8>>> + Send> {
        match format {
            Format::Json => Box::new(JsonPieces { reply: self, question: 0, item: 0, is_closed: false }),
            Format::Ply => Box::new(ply::Pieces::new(self)),
            #[cfg(feature = "arrow")]
            Format::Arrow => Box::new(arrow::Pieces::new(self)),
        }
    }
}

/// A piece ends with the first answer past this size.
const JSON_PIECE_BYTES: usize = 64 << 10;

struct JsonPieces {
    reply: Arc<Reply>,
    /// The next item: an index into a question's answers.
    question: usize,
    item: usize,
    is_closed: bool,
}

impl Iterator for JsonPieces {
    type Item = io::Result<Vec<u8>>;

    fn next(&mut self) -> Option<Self::Item> {
        let mut piece = Vec::new();
        let filled = self.fill(&mut piece);
        self.is_closed |= filled.is_err();
        (filled.is_err() || !piece.is_empty()).then(|| filled.map(|()| piece))
    }
}

impl JsonPieces {
    fn fill(&mut self, piece: &mut Vec<u8>) -> io::Result<()> {
        let is_batch = self.reply.answers.len() != 1;
        while !self.is_closed && piece.len() < JSON_PIECE_BYTES {
            let Some(answers) = self.reply.answers.get(self.question) else {
                self.is_closed = true;
                if is_batch {
                    piece.extend(b"]}");
                }
                break;
            };
            if self.item == 0 {
                if is_batch {
                    piece.extend(if self.question == 0 { &b"{\"batch\":["[..] } else { b"," });
                }
                serde_json::to_writer(&mut *piece, answers)?;
                // The list is the last field and was written empty: reopen it.
                piece.truncate(piece.len() - b"]}".len());
            }
            if self.item == answers.answers.len() {
                piece.extend(b"]}");
                (self.question, self.item) = (self.question + 1, 0);
                continue;
            }
            if self.item > 0 {
                piece.push(b',');
            }
            match &answers.answers {
                Found::Clusters(clusters) => serde_json::to_writer(&mut *piece, &clusters[self.item])?,
                Found::Gaussians(hits) => {
                    let answer = self.reply.gaussian(self.item, &hits[self.item]);
                    serde_json::to_writer(&mut *piece, &answer)?;
                }
            }
            self.item += 1;
        }
        Ok(())
    }
}
