//! Candidates for the things of a phrase: objects, or clusters where no object reaches the threshold.

use glam::DVec3;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::Serialize;
use slag_common::manifest::Manifest;

use super::geometry::Solid;
use super::phrase::is_anything;
use crate::query::cluster::Cluster;
use crate::query::objects::{self, FoundObject, ScoredObjects};
use crate::query::request::QueryRequest;
use crate::query::scale::Scale;
use crate::query::scene::{Scene, alignment, default_voxel};
use crate::score::{ObjectScores, Question, Region};

/// Most candidates per thing, best first.
const MAX_CANDIDATES: usize = 256;

/// Metres by which a piece may stick out of its thing.
const PIECE_SLACK_M: f64 = 0.1;
/// Candidates below this share of the best score are not compared: a doubtful large thing must not beat a sure one.
pub(super) const SURE: f64 = 0.65;
/// Distance, metres, up to which things of the same words are pieces of one.
const TOUCHES_M: f64 = 0.05;
/// As [`TOUCHES_M`], for a thing above another, such as the back of a chair above its seat.
const ABOVE_M: f64 = 0.25;
/// Two stacked objects are separate things if the smaller has more than this share of the larger one's volume.
const STACKED: f64 = 0.5;
/// Largest share of the lower one's height that they have in common.
const STACKED_HEIGHT: f64 = 0.25;
/// Default voxels in a metre of a metric scene; in others this many stand for a metre.
const VOXELS_PER_METRE: f64 = 4.0;

/// A candidate for a thing. Pieces of better candidates of the same words are excluded: neither counted nor compared.
pub struct Candidate<'a> {
    pub of: CandidateOf<'a>,
    pub id: String,
    /// With its pieces.
    pub solid: Solid,
    pub score: f32,
    /// 0: an unrelated thing's score; 1: the best score on board.
    pub confidence: f64,
    /// Whether it has enough Gaussians in the region.
    pub is_inside: bool,
    /// Volume of the piece that stands for it.
    largest: f64,
}

#[derive(Clone)]
pub enum CandidateOf<'a> {
    Object(FoundObject<'a>),
    Cluster(Cluster),
}

impl<'a> Candidate<'a> {
    /// Joins a piece to it. The largest piece stands for the whole, because the best may be a chair's leg.
    fn join(&mut self, piece: Candidate<'a>) {
        self.solid = self.solid.joined(&piece.solid);
        self.is_inside |= piece.is_inside;
        if piece.largest > self.largest {
            (self.of, self.id, self.score) = (piece.of, piece.id, piece.score);
            self.largest = piece.largest;
        }
    }

    /// Whether two objects are a crate on a crate, not a back on its seat.
    fn stands_on(&self, other: &Self) -> bool {
        let are_objects = matches!((&self.of, &other.of), (CandidateOf::Object(_), CandidateOf::Object(_)));
        let lower = self.solid.height().min(other.solid.height());
        let are_alike = self.largest.min(other.largest) > STACKED * self.largest.max(other.largest);
        are_objects && are_alike && self.solid.shared_height(&other.solid) < STACKED_HEIGHT * lower
    }

    pub fn position_in_world(&self) -> DVec3 {
        match &self.of {
            CandidateOf::Object(found) => found.record.position(),
            CandidateOf::Cluster(cluster) => cluster.extent.position_in_world,
        }
    }
}

/// The clusters of a thing and their threshold.
pub struct ClustersOfThing {
    pub clusters: Vec<Cluster>,
    pub threshold: f32,
    /// Score of an unrelated thing.
    pub base: f32,
}

/// What was found for one thing of a phrase.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
#[schemars(rename = "Part")]
pub struct Found {
    /// The thing.
    pub thing: String,
    /// Objects on board that reach the threshold; where none does, groups of Gaussians.
    pub n_found: usize,
    /// Score at or above which they count.
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
        let of = of.map(|((thing, question), scored)| match is_anything(thing) {
            true => every_object(scene, thing, scored.scores.len(), request),
            false => candidates(scene, thing, question, scored, request),
        });
        Self { of: of.collect() }
    }

    /// Numbers of the named things that no object answers.
    pub fn open(&self) -> Vec<usize> {
        let is_open = |(found, of): &(Found, Vec<_>)| of.is_empty() && !is_anything(&found.thing);
        (0..self.of.len()).filter(|at| is_open(&self.of[*at])).collect()
    }

    /// Makes clusters the candidates of a thing, by its number.
    pub fn set_clusters(&mut self, at: usize, found: ClustersOfThing, scene: &Scene<'_>, region: &Region) {
        let ClustersOfThing { mut clusters, threshold, base } = found;
        let (part, candidates) = &mut self.of[at];
        clusters.sort_by(|a, b| b.score.total_cmp(&a.score).then(a.first.cmp(&b.first)));
        let Some(best) = clusters.first().map(|best| best.score) else { return };
        (part.n_found, part.threshold, part.best_score) = (clusters.len(), threshold, Some(best));
        clusters.truncate(MAX_CANDIDATES);
        let candidate = |cluster: Cluster| {
            let solid = Solid::of(&cluster.oriented_box, &cluster.extent.box_in_world);
            Candidate {
                id: cluster.public_id(),
                solid,
                score: cluster.score,
                confidence: confidence(cluster.score, best, base),
                is_inside: region.contains(cluster.extent.position_in_world),
                largest: solid.volume(),
                of: CandidateOf::Cluster(cluster),
            }
        };
        *candidates = whole(clusters.into_iter().map(candidate), metre(scene.manifest));
    }

    pub fn found(&self) -> Vec<Found> {
        self.of.iter().map(|(found, _)| found.clone()).collect()
    }

    /// Returns the candidates of a thing; none for one that was not asked for.
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
    let (scale, calibration) = (Scale::of(question), objects::calibration(&scene.objects));
    let (threshold, _) = scale.threshold(request, scene.manifest, calibration);
    let everywhere = Region::default();
    let min_count = request.min_count;
    let objects = ScoredObjects { scene, scores: &scored.scores, region: &everywhere, min_count };
    let mut found = objects.reaching(scale.to_score(threshold));
    let n_found = found.len();
    found.sort_by(|a, b| b.score.total_cmp(&a.score).then(a.record.id.cmp(&b.record.id)));
    found.truncate(MAX_CANDIDATES);
    let best_score = objects::best(&scored.scores).map(|best| scale.shown(scored.scores[best]));
    let base = scale.base(calibration);
    let candidate = |found: FoundObject<'a>| {
        let score = scale.shown(found.score);
        let confidence = confidence(score, best_score.unwrap_or(base), base);
        candidate(scene, found, (score, confidence), request)
    };
    let candidates: Vec<Candidate<'a>> = found.into_par_iter().map(candidate).collect();
    let candidates = whole(candidates, metre(scene.manifest));
    (Found { thing: thing.to_owned(), n_found, threshold, best_score }, candidates)
}

/// The candidates for "thing": all objects, each surely one, and none a piece of another.
fn every_object<'a>(
    scene: &Scene<'a>,
    thing: &str,
    n_objects: usize,
    request: &QueryRequest,
) -> (Found, Vec<Candidate<'a>>) {
    let everywhere = Region::default();
    let scores = vec![1.0; n_objects];
    let objects = ScoredObjects { scene, scores: &scores, region: &everywhere, min_count: request.min_count };
    let found = objects.reaching(0.0);
    let n_found = found.len();
    let candidates =
        found.into_par_iter().map(|found| candidate(scene, found, (1.0, 1.0), request)).collect();
    (Found { thing: thing.to_owned(), n_found, threshold: 0.0, best_score: None }, candidates)
}

fn candidate<'a>(
    scene: &Scene<'a>,
    found: FoundObject<'a>,
    (score, confidence): (f32, f64),
    request: &QueryRequest,
) -> Candidate<'a> {
    let oriented = objects::oriented_box(scene, &found, &Region::default(), alignment(scene.manifest));
    let solid = Solid::of(&oriented, &found.record.bounds());
    Candidate {
        solid,
        largest: solid.volume(),
        score,
        confidence,
        is_inside: objects::in_region(scene, found.object, &request.region, request.min_count),
        id: found.public_id(),
        of: CandidateOf::Object(found),
    }
}

/// Returns the confidence of a score: 0 at `base`, 1 at the best.
fn confidence(score: f32, best: f32, base: f32) -> f64 {
    let margin = f64::from(best - base).max(f64::MIN_POSITIVE);
    (f64::from(score - base) / margin).clamp(0.0, 1.0)
}

/// Merges candidates, best first, into better ones that contain, touch or lie close above or below them, because
/// masks split some things and relations are of whole ones.
fn whole<'a>(candidates: impl IntoIterator<Item = Candidate<'a>>, metre: f64) -> Vec<Candidate<'a>> {
    let mut things: Vec<Candidate<'a>> = Vec::new();
    for piece in candidates {
        let is_inside = |of: &Candidate<'_>| piece.solid.is_piece_of(&of.solid, PIECE_SLACK_M * metre);
        if things.iter().any(is_inside) {
            continue;
        }
        let touches = |of: &Candidate<'_>| {
            let is_close = piece.solid.horizontal_gap(&of.solid) <= TOUCHES_M * metre
                && -piece.solid.shared_height(&of.solid) <= ABOVE_M * metre;
            is_close && !piece.stands_on(of) && piece.confidence >= SURE * of.confidence
        };
        let Some(first) = things.iter().position(touches) else {
            things.push(piece);
            continue;
        };
        let others: Vec<Candidate<'a>> = things.extract_if(first + 1.., |of| touches(of)).collect();
        for piece in std::iter::once(piece).chain(others) {
            things[first].join(piece);
        }
    }
    things
}

/// Returns a metre in world units, or its substitute in a scene that is not metric.
pub fn metre(manifest: &Manifest) -> f64 {
    if manifest.metric { 1.0 } else { VOXELS_PER_METRE * default_voxel(manifest) }
}
