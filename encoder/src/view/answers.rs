//! Answers of `GET /v1/query` as the page reads them: the things that match, best first. A part of the robot's
//! reply.

use std::collections::BTreeSet;

use serde_json::{Value, json};
use slag_common::manifest::{Calibration, Manifest};
use slag_common::objects::{ObjectRecord, public_id};
use slag_models::names::{Confidence, Naming, Spread};

use super::shards::combined;
use crate::store::StoredShard;

/// Spreads above the mean from which a score is an answer, as on robots.
const SPREADS_ABOVE_MEAN: f32 = 3.0;
/// Relevancy from which a question with negatives is answered, as on robots.
const RELEVANCY_THRESHOLD: f32 = 0.5;

/// The things of a generation: each is scored in the first shard that has it.
#[derive(Default)]
pub(super) struct Things {
    /// Shards, and which of their objects are scored there.
    shards: Vec<(StoredShard, Vec<usize>)>,
    calibration: Option<Calibration>,
    ids: BTreeSet<u64>,
}

impl Things {
    /// Adds the objects of the next cell's smallest shard.
    pub(super) fn add(&mut self, shard: StoredShard) {
        let Some(objects) = shard.objects() else { return };
        let (score_mean, score_spread) = (objects.header.score_mean, objects.header.score_spread);
        self.calibration.get_or_insert(Calibration { score_mean, score_spread });
        let is_first = |at: &usize| self.ids.insert(objects.records[*at].id);
        let here: Vec<usize> = (0..objects.records.len()).filter(is_first).collect();
        if !here.is_empty() {
            self.shards.push((shard, here));
        }
    }

    /// Returns the score from which a thing answers a question with negatives, or one without.
    fn threshold(&self, manifest: &Manifest, has_negatives: bool) -> f32 {
        let encoder = &manifest.encoder;
        match self.calibration.filter(|_| encoder.calibration.is_some()) {
            _ if has_negatives => RELEVANCY_THRESHOLD,
            Some(of) => of.score_mean + SPREADS_ABOVE_MEAN * of.score_spread,
            None => encoder.default_threshold,
        }
    }

    /// Returns the best name of each thing with its confidence. `words`: with their vectors.
    pub(super) fn best_names<'a>(
        &self,
        manifest: &Manifest,
        words: &[(&'a str, &[f32])],
    ) -> Vec<(&'a str, f32)> {
        let mut of_things: Vec<Vec<f32>> = Vec::new();
        for (shard, here) in &self.shards {
            let Some(objects) = shard.objects() else { continue };
            let view = shard.view();
            let of_words: Vec<Vec<f32>> =
                words.iter().map(|(_, vector)| view.object_scores(&objects, vector)).collect();
            of_things.extend(here.iter().map(|at| of_words.iter().map(|scores| scores[*at]).collect()));
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

    /// Answers a question, the first of `vectors`, against its negatives.
    pub(super) fn answers(
        &self,
        manifest: &Manifest,
        text: &str,
        vectors: &[Vec<f32>],
        limit: usize,
    ) -> Value {
        let threshold = self.threshold(manifest, vectors.len() > 1);
        let mut found: Vec<(f32, ObjectRecord, String)> = Vec::new();
        for (shard, here) in &self.shards {
            let Some(objects) = shard.objects() else { continue };
            let view = shard.view();
            let scores =
                combined(vectors.iter().map(|vector| view.object_scores(&objects, vector)).collect());
            let matching = here.iter().filter(|at| scores[**at] >= threshold);
            found.extend(matching.map(|at| {
                let record = objects.records[*at];
                (scores[*at], record, objects.photo(&record).to_owned())
            }));
        }
        found.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.id.cmp(&b.1.id)));
        found.truncate(limit);
        let answers = found.iter().zip(1..).map(|(found, rank)| answer(manifest, rank, found));
        let answers: Vec<Value> = answers.collect();
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
}

fn answer(manifest: &Manifest, rank: usize, (score, record, photo): &(f32, ObjectRecord, String)) -> Value {
    let (position, bounds) = (record.position(), record.bounds());
    let mut answer = json!({
        "rank": rank, "id": public_id(record.id), "frame": "world", "generation": manifest.generation,
        "position_in_world": position, "box_min_in_world": bounds.min, "box_max_in_world": bounds.max,
        "score": score, "n_gaussians": record.n_gaussians,
        "evidence": { "photo": photo, "box_px": record.photo_box_px },
    });
    if let Some(geo) = manifest.geo_reference {
        answer["geographic"] = json!(geo.geographic_from_world(position));
    }
    answer
}
