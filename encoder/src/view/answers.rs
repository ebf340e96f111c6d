//! Answers of `GET /v1/query` as the page reads them: the things that match, best first. A part of the robot's
//! reply.

use std::collections::BTreeSet;

use serde_json::{Value, json};
use slag_common::manifest::{Calibration, CellRecord, Manifest};
use slag_common::objects::{ObjectRecord, public_id};
use slag_models::names::{Confidence, Naming, Spread};

use super::error::ViewError;
use super::shards::{combined, smallest_shard};
use crate::store::{StoreReader, StoredShard};

/// Spreads above the mean from which a score is an answer, as on robots.
const SPREADS_ABOVE_MEAN: f32 = 3.0;
/// Relevancy from which a question with negatives is answered, as on robots.
const RELEVANCY_THRESHOLD: f32 = 0.5;

/// Things that are scored in a shard.
struct ThingsHere {
    shard: StoredShard,
    /// Indices among the shard's objects.
    numbers: Vec<usize>,
    /// Whether a shard of the cell may have their pictures.
    have_thumbnails: bool,
}

/// A generation's things, each scored in the first shard that has it.
#[derive(Default)]
pub(crate) struct Things {
    shards: Vec<ThingsHere>,
    calibration: Option<Calibration>,
    ids: BTreeSet<u64>,
}

impl Things {
    /// Finds a store's things in the smallest shard of each cell. `look` gets these shards, too.
    pub(crate) fn open(reader: &StoreReader, mut look: impl FnMut(&StoredShard)) -> Result<Self, ViewError> {
        let mut things = Self::default();
        for cell in &reader.manifest().cells {
            if let Some(shard) = smallest_shard(reader, cell)? {
                look(&shard);
                things.add(cell, shard);
            }
        }
        Ok(things)
    }

    fn add(&mut self, cell: &CellRecord, shard: StoredShard) {
        let Some(objects) = shard.objects() else { return };
        let have_thumbnails = objects.thumbnails.is_some() || cell.shards.len() > 1;
        let (score_mean, score_spread) = (objects.header.score_mean, objects.header.score_spread);
        self.calibration.get_or_insert(Calibration { score_mean, score_spread });
        let is_first = |at: &usize| self.ids.insert(objects.records[*at].id);
        let numbers: Vec<usize> = (0..objects.records.len()).filter(is_first).collect();
        if !numbers.is_empty() {
            self.shards.push(ThingsHere { shard, numbers, have_thumbnails });
        }
    }

    /// Cell whose shard scores a thing.
    pub(super) fn cell_of(&self, id: u64) -> Option<u32> {
        let is_here = |of: &&ThingsHere| {
            let records = of.shard.objects().map_or(&[][..], |objects| objects.records);
            of.numbers.iter().any(|at| records[*at].id == id)
        };
        self.shards.iter().find(is_here).map(|of| of.shard.layout.header.cell_id)
    }

    /// Score from which a thing answers a question, with or without negatives.
    pub(crate) fn threshold(&self, manifest: &Manifest, has_negatives: bool) -> f32 {
        let encoder = &manifest.encoder;
        match self.calibration.filter(|_| encoder.calibration.is_some()) {
            _ if has_negatives => RELEVANCY_THRESHOLD,
            Some(of) => of.score_mean + SPREADS_ABOVE_MEAN * of.score_spread,
            None => encoder.default_threshold,
        }
    }

    /// Best name of each thing, with its confidence. `words`: with their vectors.
    pub(super) fn best_names<'a>(
        &self,
        manifest: &Manifest,
        words: &[(&'a str, &[f32])],
    ) -> Vec<(&'a str, f32)> {
        let mut of_things: Vec<Vec<f32>> = Vec::new();
        for ThingsHere { shard, numbers, .. } in &self.shards {
            let Some(objects) = shard.objects() else { continue };
            let view = shard.view();
            let of_words: Vec<Vec<f32>> =
                words.iter().map(|(_, vector)| view.object_scores(&objects, vector)).collect();
            of_things.extend(numbers.iter().map(|at| of_words.iter().map(|scores| scores[*at]).collect()));
        }
        let mut spread = Spread::default();
        of_things.iter().for_each(|scores| spread.add(scores));
        let confidence = Confidence::new(&manifest.encoder.name, spread);
        let best = |scores: &Vec<f32>| {
            let mut naming = Naming::default();
            (0..).zip(scores).for_each(|(word, score)| naming.add(word, *score, &confidence));
            naming.names(&confidence).next()
        };
        of_things.iter().filter_map(best).map(|(word, of)| (words[word as usize].0, of)).collect()
    }

    /// Answers the first of `vectors` against the others, its negatives.
    pub(super) fn answers(
        &self,
        manifest: &Manifest,
        text: &str,
        vectors: &[Vec<f32>],
        limit: usize,
    ) -> Value {
        let [plain, threshold] = [false, vectors.len() > 1].map(|with| self.threshold(manifest, with));
        let found = self.matching(vectors, (plain, threshold), limit);
        let answers: Vec<Value> =
            found.iter().zip(1..).map(|(found, rank)| found.answer(manifest, rank)).collect();
        let none = answers.is_empty().then(|| {
            let (kind, detail) = match self.shards.is_empty() {
                true => {
                    ("no-objects", "The store has no objects; the Gaussians that match are lit.".to_owned())
                }
                false => ("below-threshold", format!("No object reaches {threshold:.3}.")),
            };
            json!({ "kind": kind, "detail": detail, "thing": text })
        });
        json!({ "results": [{
            "question": { "text": text }, "understood": null, "kind": "objects", "threshold": threshold,
            "none": none, "answers": answers,
        }] })
    }

    /// Things at or above a threshold, best first; negatives score at least `least`, so that they add no answer.
    pub(crate) fn matching(
        &self,
        vectors: &[Vec<f32>],
        (least, threshold): (f32, f32),
        limit: usize,
    ) -> Vec<Found> {
        let mut found: Vec<Found> = Vec::new();
        for ThingsHere { shard, numbers, have_thumbnails } in &self.shards {
            let Some(objects) = shard.objects() else { continue };
            let view = shard.view();
            let scores =
                combined(vectors.iter().map(|vector| view.object_scores(&objects, vector)).collect(), least);
            let matching = numbers.iter().filter(|at| scores[**at] >= threshold);
            found.extend(matching.map(|at| {
                let record = objects.records[*at];
                let photo = objects.photo(&record).to_owned();
                Found { score: scores[*at], record, photo, has_thumbnail: *have_thumbnails }
            }));
        }
        found.sort_by(|a, b| b.score.total_cmp(&a.score).then(a.record.id.cmp(&b.record.id)));
        found.truncate(limit);
        found
    }
}

pub(crate) struct Found {
    pub(crate) score: f32,
    pub(crate) record: ObjectRecord,
    pub(crate) photo: String,
    has_thumbnail: bool,
}

impl Found {
    /// As the page reads it.
    pub(crate) fn answer(&self, manifest: &Manifest, rank: usize) -> Value {
        let Self { score, record, photo, has_thumbnail } = self;
        let (position, bounds) = (record.position(), record.bounds());
        let mut answer = json!({
            "rank": rank, "id": public_id(record.id), "frame": "world", "generation": manifest.generation,
            "position_in_world": position, "box_min_in_world": bounds.min, "box_max_in_world": bounds.max,
            "score": score, "n_gaussians": record.n_gaussians,
            "evidence": { "photo": photo, "box_px": record.photo_box_px, "has_thumbnail": has_thumbnail },
        });
        if let Some(geo) = manifest.geo_reference {
            answer["geographic"] = json!(geo.geographic_from_world(position));
        }
        answer
    }
}
