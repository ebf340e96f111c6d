//! `GET /v1/view/scores`: the score of every Gaussian, a byte each.

use std::ops::Range;

const MAGIC: [u8; 4] = *b"SLGS";
const VERSION: u32 = 1;
/// Bytes before the table of cells.
const HEAD_BYTES: usize = 24;
const ROW_BYTES: usize = 8;
const LAST_LEVEL: f32 = 255.0;

/// A message of scores under construction: magic, version, least and largest score (f32 each), number of cells and
/// generation (u32 each); for each cell its id and number of Gaussians (u32 each); then a level for each Gaussian of
/// each cell. Level 0: in no view; level `b`: a score of `least + b / 255 * (largest - least)`.
pub struct ScoresMessage {
    bytes: Vec<u8>,
    starts: Vec<usize>,
    least: f32,
    largest: f32,
}

impl ScoresMessage {
    /// Starts the message of cells (ids and numbers of Gaussians), without any scores.
    pub fn new(generation: u64, [least, largest]: [f32; 2], cells: &[(u32, u32)]) -> Self {
        let n_gaussians: usize = cells.iter().map(|(_, n)| *n as usize).sum();
        let mut bytes = Vec::with_capacity(Self::len(cells.len(), n_gaussians));
        bytes.extend(MAGIC);
        bytes.extend(VERSION.to_le_bytes());
        bytes.extend(least.to_le_bytes());
        bytes.extend(largest.to_le_bytes());
        bytes.extend((cells.len() as u32).to_le_bytes());
        // The page only compares, and 2^32 generations take a while.
        bytes.extend((generation as u32).to_le_bytes());
        let mut starts = Vec::with_capacity(cells.len());
        let mut start = HEAD_BYTES + ROW_BYTES * cells.len();
        for (cell_id, n) in cells {
            bytes.extend(cell_id.to_le_bytes());
            bytes.extend(n.to_le_bytes());
            starts.push(start);
            start += *n as usize;
        }
        bytes.resize(start, 0);
        Self { bytes, starts, least, largest }
    }

    pub fn len(n_cells: usize, n_gaussians: usize) -> usize {
        HEAD_BYTES + ROW_BYTES * n_cells + n_gaussians
    }

    /// Sets the score of Gaussians of a cell (by its place in the table).
    ///
    /// # Panics
    /// If they are not the cell's.
    pub fn fill(&mut self, cell: usize, gaussians: Range<usize>, score: f32) {
        let level = self.level(score);
        let start = self.starts[cell];
        let end = self.starts.get(cell + 1).copied().unwrap_or(self.bytes.len());
        self.bytes[start..end][gaussians].fill(level);
    }

    /// NaN, a Gaussian without evidence, has level 0.
    fn level(&self, score: f32) -> u8 {
        if score.is_nan() {
            return 0;
        }
        let share = (score - self.least) / (self.largest - self.least).max(f32::MIN_POSITIVE);
        (share * LAST_LEVEL).round().clamp(1.0, LAST_LEVEL) as u8
    }

    pub fn into_bytes(self) -> Vec<u8> {
        self.bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_have_the_layout_of_the_documents() {
        let mut message = ScoresMessage::new(7, [-0.5, 0.5], &[(3, 4), (9, 2)]);
        message.fill(0, 1..3, 0.5);
        message.fill(0, 3..4, -0.5);
        message.fill(1, 0..1, 0.0);
        message.fill(1, 1..2, f32::NAN);
        let bytes = message.into_bytes();
        assert_eq!((&bytes[..4], bytes[16], bytes[20]), (b"SLGS".as_slice(), 2, 7));
        assert_eq!((bytes[24], bytes[28], bytes[32], bytes[36]), (3, 4, 9, 2));
        assert_eq!(bytes[40..], [0, 255, 255, 1, 128, 0]);
        assert_eq!(bytes.len(), ScoresMessage::len(2, 6));
    }

    #[test]
    fn scores_that_are_all_alike_have_a_level() {
        let mut message = ScoresMessage::new(1, [0.2, 0.2], &[(1, 1)]);
        message.fill(0, 0..1, 0.2);
        assert_eq!(message.into_bytes().last(), Some(&1));
    }
}
