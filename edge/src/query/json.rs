//! A reply as JSON, in pieces of limited size however long the answer.

use std::io;

use super::answers::Found;
use super::reply::Reply;

/// A piece ends with the first answer past this size.
const JSON_PIECE_BYTES: usize = 64 << 10;
/// Capacity reserved for that last answer.
const ANSWER_BYTES: usize = 1 << 10;

pub struct Pieces {
    reply: Reply,
    /// The next item: an index into a question's answers.
    question: usize,
    item: usize,
    is_closed: bool,
}

impl Iterator for Pieces {
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

impl Pieces {
    pub fn new(reply: Reply) -> Self {
        Self { reply, question: 0, item: 0, is_closed: false }
    }

    fn fill(&mut self, piece: &mut Vec<u8>) -> io::Result<()> {
        let is_batch = self.reply.outcomes.len() != 1;
        while !self.is_closed && piece.len() < JSON_PIECE_BYTES {
            let Some(answers) = self.reply.answers().nth(self.question) else {
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
