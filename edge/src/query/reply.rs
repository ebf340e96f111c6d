//! Answers on their way out, piece by piece: no piece is large, however long the answer.

use std::io;
use std::sync::Arc;

use glam::DVec3;

use super::{Answers, Found, GaussianAnswer};
use crate::store::Snapshot;

/// Pieces of JSON are cut at the first answer past this.
const JSON_PIECE_BYTES: usize = 64 << 10;
/// Room for the answer that passes it.
const ANSWER_BYTES: usize = 1 << 10;

/// How a reply is written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Format {
    /// One object; of several questions, `{"batch":[…]}` of theirs.
    #[default]
    Json,
    /// Columns as an Arrow IPC stream; of Gaussians only.
    Arrow,
}

impl Format {
    /// Returns its media type.
    pub fn media_type(self) -> &'static str {
        match self {
            Self::Json => "application/json",
            Self::Arrow => "application/vnd.apache.arrow.stream",
        }
    }
}

impl std::str::FromStr for Format {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "json" => Ok(Self::Json),
            "arrow" if cfg!(feature = "arrow") => Ok(Self::Arrow),
            _ if cfg!(feature = "arrow") => Err("json or arrow".into()),
            _ => Err("json (this program is built without Arrow)".into()),
        }
    }
}

/// The answers to a request, and the generation that they name Gaussians of.
pub struct Reply {
    pub(super) snapshot: Arc<Snapshot>,
    pub(super) near: Option<DVec3>,
    /// One to each text, in their order.
    pub answers: Vec<Answers>,
}

impl Reply {
    /// Returns an answer's Gaussians, described; none of an answer of clusters.
    pub fn gaussians(&self, answers: &Answers) -> Vec<GaussianAnswer> {
        let Found::Gaussians(hits) = &answers.answers else { return Vec::new() };
        hits.iter().enumerate().map(|(at, hit)| self.gaussian(at, hit)).collect()
    }

    fn gaussian(&self, at: usize, hit: &crate::score::Hit) -> GaussianAnswer {
        GaussianAnswer::new(at, hit, &self.snapshot.shards[hit.shard as usize].view(), self.near)
    }

    /// Returns the pieces of the reply in a format, none longer than a fraction of a megabyte; each is made
    /// when it is asked for.
    ///
    /// # Errors
    /// A piece is an error where it cannot be written.
    pub fn pieces(self, format: Format) -> Box<dyn Iterator<Item = io::Result<Vec<u8>>> + Send> {
        match format {
            Format::Json => Box::new(JsonPieces { reply: self, question: 0, item: 0, is_closed: false }),
            #[cfg(feature = "arrow")]
            Format::Arrow => Box::new(super::arrow::Pieces::new(self)),
            #[cfg(not(feature = "arrow"))]
            Format::Arrow => Box::new(std::iter::once(Err(io::Error::other("built without Arrow")))),
        }
    }
}

/// The pieces of a reply as JSON.
struct JsonPieces {
    reply: Reply,
    /// What comes next: an item of a question's answers.
    question: usize,
    item: usize,
    is_closed: bool,
}

impl Iterator for JsonPieces {
    type Item = io::Result<Vec<u8>>;

    fn next(&mut self) -> Option<Self::Item> {
        let mut piece = Vec::with_capacity(JSON_PIECE_BYTES + ANSWER_BYTES);
        match self.fill(&mut piece) {
            Ok(()) if piece.is_empty() => None,
            Ok(()) => Some(Ok(piece)),
            Err(error) => {
                self.is_closed = true;
                Some(Err(error))
            }
        }
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
                // The list comes last and is written empty: it is opened again.
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
