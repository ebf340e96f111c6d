//! Answers made of objects: what the masks of several views agree on, scored as a whole.
//!
//! An object that reaches into several cells is in the shards of all: it is scored once, and its Gaussians are those
//! on board that lie in the region asked for.

use std::collections::BTreeMap;

use glam::DVec3;
use slag_common::manifest::Calibration;
use slag_common::objects::{ObjectRecord, Objects};
use slag_common::shard::ShardView;

use super::oriented::{Alignment, OrientedBox};
use crate::score::{Question, Region};

/// As [`super::cluster`] trims its boxes.
const TRIMMED: f64 = 0.02;

/// An object, some of it on board.
pub struct FoundObject<'a> {
    /// What its shards say of it.
    pub record: &'a ObjectRecord,
    /// The photo that shows it best.
    pub photo: &'a str,
    /// Its score with the question.
    pub score: f32,
    /// Where it is on board: shards, and its number in each.
    parts: Vec<(usize, usize)>,
}

/// An object's Gaussians on board, in the region asked for.
pub struct Members {
    /// How many.
    pub n_gaussians: u64,
    /// A box around them.
    pub oriented_box: OrientedBox,
}

/// Returns whether there is any object on board.
pub fn are_there(objects: &[Option<Objects<'_>>]) -> bool {
    objects.iter().flatten().any(|objects| !objects.records.is_empty())
}

/// Returns how a bank of texts scores over the objects of the scene.
pub fn calibration(objects: &[Option<Objects<'_>>]) -> Option<Calibration> {
    let header = objects.iter().flatten().next()?.header;
    Some(Calibration { score_mean: header.score_mean, score_spread: header.score_spread })
}

/// Returns the objects on board, best first. A score is `s(q)`, or `s(q) - max_j s(n_j)` with negatives, s being
/// [`slag_common::objects::object_score`].
pub fn scored<'a>(
    shards: &[ShardView<'_>],
    objects: &[Option<Objects<'a>>],
    question: &Question,
) -> Vec<FoundObject<'a>> {
    let mut found: BTreeMap<u64, FoundObject<'a>> = BTreeMap::new();
    for (shard, objects) in objects.iter().enumerate().filter_map(|(i, o)| Some((i, o.as_ref()?))) {
        let mut scores = objects.scores(&shards[shard], &question.vector);
        let negatives = question.negatives.iter().map(|negative| objects.scores(&shards[shard], negative));
        let likest = negatives.reduce(|a, b| a.iter().zip(b).map(|(a, b)| a.max(b)).collect());
        scores.iter_mut().zip(likest.into_iter().flatten()).for_each(|(score, likest)| *score -= likest);
        for (number, (record, score)) in objects.records.iter().zip(scores).enumerate() {
            let new = || FoundObject { record, photo: objects.photo(record), score, parts: Vec::new() };
            found.entry(record.id).or_insert_with(new).parts.push((shard, number));
        }
    }
    let mut found: Vec<_> = found.into_values().collect();
    found.sort_by(|a, b| b.score.total_cmp(&a.score).then(a.record.id.cmp(&b.record.id)));
    found
}

/// Returns the bound on the error of an object's score with one vector.
pub fn score_error_bound(objects: &[Option<Objects<'_>>]) -> f32 {
    objects.iter().flatten().map(|objects| objects.header.score_error_bound).fold(0.0, f32::max)
}

impl FoundObject<'_> {
    /// Returns its Gaussians; `None` if none on board lies in the region.
    pub fn members(
        &self,
        shards: &[ShardView<'_>],
        objects: &[Option<Objects<'_>>],
        region: &Region,
        alignment: Alignment,
    ) -> Option<Members> {
        let mut points: Vec<DVec3> = Vec::new();
        for (shard, number) in &self.parts {
            let runs = objects[*shard].iter().flat_map(Objects::runs);
            let of_object = runs.filter(|(_, object)| *object == Some(*number));
            let places =
                of_object.flat_map(|(run, _)| run.map(|i| shards[*shard].position_in_world(i as usize)));
            points.extend(places.filter(|point| region.contains(*point)));
        }
        let bounds = self.record.bounds();
        let in_box = |p: &DVec3| p.cmpge(bounds.min).all() && p.cmple(bounds.max).all();
        let n_gaussians = points.len() as u64;
        (n_gaussians > 0).then(|| Members {
            n_gaussians,
            oriented_box: OrientedBox::around(&points, in_box, alignment, TRIMMED),
        })
    }
}
