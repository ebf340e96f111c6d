//! The Gaussians of a reply as a PLY of points, in pieces of bounded size.

use std::io;
use std::sync::Arc;

use slag_common::splat::ply::{Point, PointProperties};

use super::answers::{Answers, Found, Reply};
use super::scene::unit;
use crate::score::Run;

/// A piece ends with the first point past this size.
const PIECE_BYTES: usize = 256 << 10;

/// The pieces of a reply as a PLY. Points are ordered by question, answer, and storage.
pub struct Pieces {
    reply: Arc<Reply>,
    properties: PointProperties,
    has_header: bool,
    at: Place,
}

#[derive(Clone, Copy, Default)]
struct Place {
    question: usize,
    answer: usize,
    /// Index of a run of the answer, and of a Gaussian in the run.
    run: usize,
    member: u32,
}

impl Pieces {
    pub fn new(reply: Arc<Reply>) -> Self {
        let properties = PointProperties {
            question: reply.answers.len() != 1,
            shard_index: true,
            input_index: reply.snapshot.shards.iter().all(|shard| shard.view().has_input_indices()),
        };
        Self { reply, properties, has_header: false, at: Place::default() }
    }

    fn header(&self) -> String {
        let (answers, manifest) = (self.reply.answers.iter(), self.reply.manifest());
        let (scene, generation, unit) = (&manifest.scene, manifest.generation, unit(manifest));
        let about = [format!("scene {scene}"), format!("generation {generation}"), format!("unit {unit}")];
        let texts = answers.clone().map(|answers| format!("text {}", answers.text));
        let comments: Vec<String> = texts.chain(about).collect();
        self.properties.header(answers.map(n_points).sum(), &comments)
    }

    /// Appends points to a piece until it is full or none is left.
    fn fill(&mut self, piece: &mut Vec<u8>) {
        let reply = &self.reply;
        let shards: Vec<_> = reply.snapshot.shards.iter().map(|shard| shard.view()).collect();
        while let Some(answers) = reply.answers.get(self.at.question) {
            let Some(run) = run(answers, self.at.answer, self.at.run) else {
                self.at = match self.at.answer + 1 < answers.answers.len() {
                    true => Place { answer: self.at.answer + 1, run: 0, member: 0, ..self.at },
                    false => Place { question: self.at.question + 1, ..Place::default() },
                };
                continue;
            };
            let shard = &shards[run.shard as usize];
            for index in run.start + self.at.member..run.end {
                if piece.len() >= PIECE_BYTES {
                    return;
                }
                let point = Point {
                    question: self.at.question as u32,
                    answer: self.at.answer as u32 + 1,
                    position_in_world: shard.position_in_world(index as usize),
                    score: run.score,
                    shard_index: (shard.header.cell_id, index),
                    input_index: shard.input_index(index as usize).unwrap_or_default(),
                };
                self.properties.put(&point, piece);
                self.at.member += 1;
            }
            self.at = Place { run: self.at.run + 1, member: 0, ..self.at };
        }
    }
}

impl Iterator for Pieces {
    type Item = io::Result<Vec<u8>>;

    fn next(&mut self) -> Option<Self::Item> {
        let mut piece = Vec::with_capacity(PIECE_BYTES + self.properties.point_bytes());
        if !std::mem::replace(&mut self.has_header, true) {
            piece.extend(self.header().bytes());
        }
        self.fill(&mut piece);
        (!piece.is_empty()).then_some(Ok(piece))
    }
}

/// Returns a run of an answer; a Gaussian has one run.
fn run(answers: &Answers, answer: usize, run: usize) -> Option<Run> {
    match &answers.answers {
        Found::Clusters(clusters) => clusters.get(answer)?.members.get(run).copied(),
        Found::Gaussians(hits) => {
            let hit = hits.get(answer).filter(|_| run == 0)?;
            Some(Run { shard: hit.shard, start: hit.index, end: hit.index + 1, score: hit.score })
        }
    }
}

fn n_points(answers: &Answers) -> u64 {
    match &answers.answers {
        Found::Clusters(clusters) => {
            let members = clusters.iter().flat_map(|cluster| &cluster.members);
            members.map(|run| u64::from(run.end - run.start)).sum()
        }
        Found::Gaussians(hits) => hits.len() as u64,
    }
}
