//! The objects that may be meant by the words of a phrase.

use rayon::prelude::*;
use schemars::JsonSchema;
use serde::Serialize;
use slag_common::manifest::Manifest;

use super::geometry::Solid;
use crate::query::objects::{self, FoundObject};
use crate::query::request::QueryRequest;
use crate::query::scale::Scale;
use crate::query::scene::{Scene, alignment, default_voxel};
use crate::score::{ObjectScores, Question, Region};

/// Most objects that are weighed for a thing, best first.
const MAX_CANDIDATES: usize = 256;

/// Metres by which a piece may stick out of the thing that it is a piece of.
const PIECE_SLACK_M: f64 = 0.1;
/// Default voxels in a metre of a metric scene; in others as many stand for a metre.
const VOXELS_PER_METRE: f64 = 4.0;

/// An object that may be meant. Objects that lie inside a better one of the same words are pieces of it, and are
/// left out: they must not be counted, or compared with it.
pub struct Candidate<'a> {
    pub found: FoundObject<'a>,
    pub solid: Solid,
    pub score: f32,
    /// From 0, the score of what has nothing to do with the words, to 1, the best score on board.
    pub confidence: f64,
    /// Whether it has enough Gaussians in the region asked for.
    pub is_inside: bool,
}

/// What was found for one thing of a phrase.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
#[schemars(rename = "Part")]
pub struct Found {
    /// The thing.
    pub thing: String,
    /// Objects on board that reach the threshold.
    pub n_found: usize,
    /// Score at or above which an object counts.
    pub threshold: f32,
    /// Best score on board.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub best_score: Option<f32>,
}

pub struct Things<'a> {
    of: Vec<(Found, Vec<Candidate<'a>>)>,
}

impl<'a> Things<'a> {
    /// Finds the candidates of things, each with its question and the objects' scores.
    pub fn find(
        scene: &Scene<'a>,
        things: &[&str],
        questions: &[Question],
        scored: &[ObjectScores],
        request: &QueryRequest,
    ) -> Self {
        let of = things.iter().zip(questions).zip(scored);
        let of = of.map(|((thing, question), scored)| candidates(scene, thing, question, scored, request));
        Self { of: of.collect() }
    }

    pub fn found(&self) -> Vec<Found> {
        self.of.iter().map(|(found, _)| found.clone()).collect()
    }

    /// Returns the candidates of a thing, none for a thing that was not asked for.
    pub(in crate::query) fn of(&self, thing: &str) -> &[Candidate<'a>] {
        let of = self.of.iter().find(|(found, _)| found.thing == thing);
        of.map_or(&[], |(_, candidates)| candidates)
    }
}

fn candidates<'a>(
    scene: &Scene<'a>,
    thing: &str,
    question: &Question,
    scored: &ObjectScores,
    request: &QueryRequest,
) -> (Found, Vec<Candidate<'a>>) {
    let (scale, calibration) = (Scale::of(question), objects::calibration(scene.objects));
    let (threshold, _) = scale.threshold(request, scene.manifest, calibration);
    let everywhere = Region::default();
    let mut found =
        objects::matching(scene, &scored.scores, scale.to_score(threshold), &everywhere, request.min_count);
    let n_found = found.len();
    found.sort_by(|a, b| b.score.total_cmp(&a.score).then(a.record.id.cmp(&b.record.id)));
    found.truncate(MAX_CANDIDATES);
    let best_score = objects::best(&scored.scores).map(|best| scale.shown(scored.scores[best]));
    let base = scale.base(calibration);
    let margin = f64::from(best_score.unwrap_or(base) - base).max(f64::MIN_POSITIVE);
    let (region, alignment) = (&request.region, alignment(scene.manifest));
    let candidate = |found: FoundObject<'a>| {
        let oriented = objects::oriented_box(scene, &found, &everywhere, alignment);
        let score = scale.shown(found.score);
        Candidate {
            solid: Solid::of(&oriented, &found.record.bounds()),
            score,
            confidence: (f64::from(score - base) / margin).clamp(0.0, 1.0),
            is_inside: objects::in_region(scene, found.object, region, request.min_count),
            found,
        }
    };
    let candidates: Vec<Candidate<'a>> = found.into_par_iter().map(candidate).collect();
    let metre = metre(scene.manifest);
    let mut whole: Vec<Candidate<'a>> = Vec::new();
    for candidate in candidates {
        let is_piece = |of: &Candidate<'_>| candidate.solid.is_piece_of(&of.solid, PIECE_SLACK_M * metre);
        if !whole.iter().any(is_piece) {
            whole.push(candidate);
        }
    }
    (Found { thing: thing.to_owned(), n_found, threshold, best_score }, whole)
}

/// Returns a metre in world units; in a scene that is not metric, what stands for one.
pub fn metre(manifest: &Manifest) -> f64 {
    if manifest.metric { 1.0 } else { VOXELS_PER_METRE * default_voxel(manifest) }
}
