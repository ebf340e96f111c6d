//! What a page needs to draw the Gaussians on board, and to colour them by a question: two binary messages, little-endian.

use slag_common::shard::ShardView;

use super::engine::{Engine, QueryError};
use super::request::{Negatives, QueryRequest};
use crate::score::{Budget, Precision, Question, Region, Run, ScoreError, Scratch, Search, relevancy};

/// First bytes of a message of scores.
pub const SCORES_MAGIC: [u8; 8] = *b"SLAGVSC1";
/// First bytes of a message of positions.
pub const POSITIONS_MAGIC: [u8; 8] = *b"SLAGVPO1";
/// Below every cosine, and below every difference of two cosines.
const BELOW_ALL: f32 = -4.0;
/// Levels of scores; level 0 is a Gaussian without a score.
const N_LEVELS: f32 = 255.0;

impl Engine {
    /// Returns the score of every Gaussian on board as one byte, in order of the shards.
    ///
    /// The message is [`SCORES_MAGIC`], the generation (u64), the least and the largest score (f32 each), the number of
    /// cells (u32), 4 zero bytes; for each cell its id and its number of Gaussians (u32 each); then a byte for each
    /// Gaussian. Byte 0: no view shows the Gaussian. Byte `b > 0`: its centroid's score is
    /// `least + (b - 1) / 254 * (largest - least)`, within half a level. With negatives, scores are relevancies.
    ///
    /// # Errors
    /// [`QueryError`].
    pub fn view_scores(
        &self,
        text: &str,
        negatives: Negatives,
        budget: &Budget,
    ) -> Result<Vec<u8>, QueryError> {
        let request = QueryRequest { negatives, ..QueryRequest::new(text) };
        request.check()?;
        let snapshot = self.snapshot()?;
        self.check_encoder(&snapshot)?;
        let question =
            Question { vector: self.encode_text(text)?, negatives: self.encode_negatives(&request)? };
        let generation = snapshot.manifest.generation;
        let message = self.on_scene(&snapshot, budget, |scratch, scene| {
            scores_message(scratch, scene.shards, &question, generation)
        });
        Ok(message?)
    }

    /// Returns the positions of a cell's Gaussians, or nothing if the cell is not on board.
    ///
    /// The message is [`POSITIONS_MAGIC`], the generation (u64), the cell's id and its number of Gaussians (u32 each), the
    /// cell's origin in the world (three f64), and for each Gaussian its mean less the origin (three f32).
    ///
    /// # Errors
    /// [`QueryError`].
    pub fn view_positions(&self, cell_id: u32, budget: &Budget) -> Result<Option<Vec<u8>>, QueryError> {
        let snapshot = self.snapshot()?;
        let mut views = snapshot.shards.iter().map(|shard| shard.view());
        let Some(shard) = views.find(|shard| shard.header.cell_id == cell_id) else {
            return Ok(None);
        };
        let n_gaussians = shard.header.n_gaussians as usize;
        budget.take(n_gaussians * 3 * size_of::<f32>());
        budget.check().map_err(ScoreError::from)?;
        Ok(Some(positions_message(&shard, snapshot.manifest.generation)))
    }
}

fn scores_message(
    scratch: &mut Scratch,
    shards: &[ShardView<'_>],
    question: &Question,
    generation: u64,
) -> Result<Vec<u8>, ScoreError> {
    let budget = scratch.budget().clone();
    let n_gaussians: usize = shards.iter().map(|shard| shard.header.n_gaussians as usize).sum();
    budget.take(n_gaussians);
    let search = Search::reusing(scratch, shards, question, Region::default(), Precision::Centroids)?;
    let mut runs = search.matching(BELOW_ALL).runs;
    // A search that runs out of its budget stops early.
    budget.check()?;
    if !question.negatives.is_empty() {
        runs.iter_mut().for_each(|run| run.score = relevancy(run.score));
    }
    let least = runs.iter().map(|run| run.score).reduce(f32::min).unwrap_or(0.0);
    let largest = runs.iter().map(|run| run.score).reduce(f32::max).unwrap_or(0.0);
    let mut message = SCORES_MAGIC.to_vec();
    message.extend(generation.to_le_bytes());
    message.extend(least.to_le_bytes());
    message.extend(largest.to_le_bytes());
    message.extend((shards.len() as u32).to_le_bytes());
    message.extend([0; 4]);
    let mut first_of_shard = Vec::with_capacity(shards.len());
    let mut first = 0;
    for shard in shards {
        message.extend(shard.header.cell_id.to_le_bytes());
        message.extend(shard.header.n_gaussians.to_le_bytes());
        first_of_shard.push(first);
        first += shard.header.n_gaussians as usize;
    }
    let head = message.len();
    message.resize(head + n_gaussians, 0);
    let levels = &mut message[head..];
    for Run { shard, start, end, score } in runs {
        let first = first_of_shard[shard as usize];
        levels[first + start as usize..first + end as usize].fill(level(score, least, largest));
    }
    Ok(message)
}

/// Returns the byte of a score: 1 for the least, 255 for the largest.
fn level(score: f32, least: f32, largest: f32) -> u8 {
    if largest <= least {
        return N_LEVELS as u8;
    }
    (1.0 + (score - least) / (largest - least) * (N_LEVELS - 1.0)).round() as u8
}

fn positions_message(shard: &ShardView<'_>, generation: u64) -> Vec<u8> {
    let header = &shard.header;
    let mut message = POSITIONS_MAGIC.to_vec();
    message.extend(generation.to_le_bytes());
    message.extend(header.cell_id.to_le_bytes());
    message.extend(header.n_gaussians.to_le_bytes());
    header.origin_in_world.iter().for_each(|axis| message.extend(axis.to_le_bytes()));
    for index in 0..header.n_gaussians as usize {
        let offset = shard.position_in_world(index) - glam::DVec3::from_array(header.origin_in_world);
        offset.as_vec3().to_array().iter().for_each(|axis| message.extend(axis.to_le_bytes()));
    }
    message
}
