//! From a question to ranked answers.

mod answers;
#[cfg(feature = "arrow")]
mod arrow;
pub mod cluster;
mod engine;
mod objects;
mod oriented;
mod reply;
mod request;
mod threshold;

use glam::DVec3;
use rayon::prelude::*;
use slag_common::manifest::{Calibration, Manifest};
use slag_common::objects::Objects;
use slag_common::shard::ShardView;

pub use answers::{
    Answers, ClusterAnswer, Clustering, Evidence, Found, GaussianAnswer, Reason, ReasonKind, ScoreKind,
};
pub use engine::{Engine, QueryError, ShardStatus, Status};
pub use oriented::{Alignment, OrientedBox};
pub use reply::{Format, Reply};
pub use request::{
    AnswerKind, CANONICAL_NEGATIVES, DEFAULT_LIMIT, DEFAULT_MIN_COUNT, MAX_CLUSTERS, MAX_GAUSSIANS,
    MAX_NEGATIVES, MAX_TEXTS, Negatives, QueryRequest, RequestError, parse_box, parse_point,
};
pub use threshold::{RELEVANCY_THRESHOLD, ThresholdSource, calibrated_threshold};

use crate::score::{
    ObjectScores, Question, RELEVANCY_STEEPNESS, Region, ScoreError, Scratch, Search, relevancy,
    score_objects, score_of_relevancy,
};
use crate::store::objects::ObjectIndex;
use cluster::{Cluster, Grouping, cluster};
use objects::FoundObject;

/// Edge of the voxels in a metric scene, metres: parts of one piece of furniture are nearer to each
/// other than two such edges, two pieces of furniture mostly are not.
const METRIC_VOXEL_M: f64 = 0.25;
/// In a scene without metres, voxels to the middle edge of the median cell.
const VOXELS_PER_CELL: f64 = 64.0;
/// Distance, in voxels, at which a cluster's relevance is halved (10 m in a metric scene).
const VOXELS_TO_HALF_RELEVANCE: f64 = 40.0;

/// What a query runs on.
pub struct Scene<'a> {
    /// The shards on board.
    pub shards: &'a [ShardView<'a>],
    /// The objects of each, where it has them.
    pub objects: &'a [Option<Objects<'a>>],
    /// Which of those are the same.
    pub index: &'a ObjectIndex,
    /// Their manifest.
    pub manifest: &'a Manifest,
    /// The part of space that was fetched: centre and radius.
    pub fetched: (DVec3, f64),
}

/// Answers a checked request about a scene: one answer to each question, in their order. `questions`: the
/// vectors of the request's texts, each with those of its negatives.
///
/// Same scene, vectors and request: same answers, for any number of threads, asked alone or together. `scratch`:
/// memory that earlier answers used, or new.
/// # Errors
/// [`ScoreError`].
pub fn answer(
    scratch: &mut Scratch,
    scene: &Scene<'_>,
    questions: &[Question],
    request: &QueryRequest,
) -> Result<Vec<Answers>, ScoreError> {
    let asked = request.texts.iter().map(String::as_str).zip(questions);
    let kind = request.kind.unwrap_or(if scene.index.is_empty() {
        AnswerKind::Clusters
    } else {
        AnswerKind::Objects
    });
    if kind == AnswerKind::Objects {
        let scored = score_objects(scene.shards, scene.objects, scene.index, questions)?;
        let answer = |((text, question), scored)| answer_objects(scene, text, question, scored, request);
        return Ok(asked.zip(&scored).map(answer).collect());
    }
    let searches = Search::batch(scratch, scene.shards, questions, request.region(), request.precision)?;
    let answer =
        |((text, question), search)| answer_gaussians(scene, (text, kind), question, search, request);
    Ok(asked.zip(&searches).map(answer).collect())
}

/// Answers a question by the objects that match; no row of Gaussians is scored.
fn answer_objects(
    scene: &Scene<'_>,
    text: &str,
    question: &Question,
    scored: &ObjectScores,
    request: &QueryRequest,
) -> Answers {
    let (manifest, scale, region) = (scene.manifest, Scale::of(question), request.region());
    let said = scale.threshold(request, manifest, objects::calibration(scene.objects));
    let of_score = scale.to_score(said.0);
    let found = objects::matching(scene, &scored.scores, of_score, &region, request.min_count);
    let n_matching = found.iter().map(|object| object.n_gaussians).sum();
    let standing =
        |object: &FoundObject<'_>| (scale.shown(object.score), object.n_gaussians, object.record.position());
    let ranked = rank(found, said.0, manifest, request, standing);
    // Of those that are told alone.
    let described = ranked.into_par_iter().map(|ranked| object_answer(scene, ranked, scale, &region));
    let found = Found::Clusters(described.collect());
    let best = objects::best(&scored.scores);
    let best = best.map(|best| (scale.shown(scored.scores[best]), objects::record(scene, best).position()));
    let searched = scene.shards.iter().filter(|shard| region.touches(&shard.position_box()));
    Answers {
        n_searched: searched.map(|shard| shard.n_with_evidence() as u64).sum(),
        n_matching,
        score_error_bound: scale.error_bound(scored.error_bound),
        reason: found.is_empty().then(|| reason_of_objects(request, said.0, best)),
        answers: found,
        ..nothing(scene, (text, AnswerKind::Objects), scale, said, request)
    }
}

/// Answers a question by the Gaussians that match, or by clusters of them.
fn answer_gaussians(
    scene: &Scene<'_>,
    (text, kind): (&str, AnswerKind),
    question: &Question,
    search: &Search<'_>,
    request: &QueryRequest,
) -> Answers {
    let manifest = scene.manifest;
    let scale = Scale::of(question);
    let (threshold, threshold_source) = scale.threshold(request, manifest, manifest.encoder.calibration);
    let score_threshold = scale.to_score(threshold);
    let mut clustering = None;
    let n_matching;
    let found = if kind == AnswerKind::Gaussians {
        let limit = request.limit.unwrap_or(DEFAULT_LIMIT);
        let mut hits = search.best(limit, score_threshold, request.near);
        // Where all are listed, nobody need count them again.
        let is_whole = hits.len() < limit;
        n_matching = if is_whole { hits.len() as u64 } else { search.matching(score_threshold).n_gaussians };
        hits.iter_mut().for_each(|hit| hit.score = scale.shown(hit.score));
        Found::Gaussians(hits)
    } else {
        let mut matches = search.matching(score_threshold);
        matches.runs.iter_mut().for_each(|run| run.score = scale.shown(run.score));
        n_matching = matches.n_gaussians;
        let voxel = request.voxel.unwrap_or_else(|| default_voxel(manifest));
        let (min_count, alignment) = (request.min_count, alignment(manifest));
        let grouped =
            cluster(scene.shards, &matches.runs, &Grouping { voxel, min_count, threshold, alignment });
        clustering = Some(Clustering {
            voxel: grouped.voxel,
            min_count,
            n_clusters: grouped.clusters.len() as u64,
            n_small_clusters: grouped.n_small,
            n_gaussians_in_small_clusters: grouped.n_gaussians_in_small,
        });
        let standing = |of: &Cluster| (of.score, of.n_gaussians, of.position_in_world);
        let ranked = rank(grouped.clusters, threshold, manifest, request, standing);
        Found::Clusters(ranked.into_iter().map(|ranked| cluster_answer(ranked, manifest)).collect())
    };
    // Gaussians of exact shards are listed with their own scores, clusters with their rows'.
    let score_error_bound = scale.error_bound(match (search.is_exact(), kind) {
        (true, AnswerKind::Gaussians) => question.rounding_bound(),
        _ => search.score_error_bound(),
    });
    // With negatives a score is the difference of two.
    let n_products = if question.negatives.is_empty() { 1.0 } else { 2.0 };
    let measured = search.measured_errors();
    Answers {
        n_searched: search.searched().map(|shard| shard.n_with_evidence() as u64).sum(),
        n_matching,
        is_exact: search.is_exact(),
        score_error_bound,
        score_error_p999: measured.map(|errors| scale.error_bound(n_products * errors.p999)),
        clustering,
        reason: found.is_empty().then(|| reason(search, scale, request, threshold, n_matching)),
        answers: found,
        ..nothing(scene, (text, kind), scale, (threshold, threshold_source), request)
    }
}

/// Returns an answer of nothing, with what an answer says of its question and its scene.
fn nothing(
    scene: &Scene<'_>,
    (text, kind): (&str, AnswerKind),
    scale: Scale,
    (threshold, threshold_source): (f32, ThresholdSource),
    request: &QueryRequest,
) -> Answers {
    let manifest = scene.manifest;
    Answers {
        text: text.to_owned(),
        negatives: request.negatives.phrases().into_iter().map(str::to_owned).collect(),
        kind,
        scene: manifest.scene.clone(),
        generation: manifest.generation,
        unit: if manifest.metric { "m" } else { "world" },
        score_kind: scale.0,
        threshold,
        threshold_source,
        n_searched: 0,
        n_matching: 0,
        is_exact: false,
        score_error_bound: 0.0,
        score_error_p999: None,
        area_fetched: area_fetched(scene.fetched, request),
        clustering: None,
        reason: None,
        answers: Found::Clusters(Vec::new()),
    }
}

/// How scores are shown: as they are, or as relevancies.
#[derive(Clone, Copy)]
struct Scale(ScoreKind);

impl Scale {
    fn of(question: &Question) -> Self {
        Self(if question.negatives.is_empty() { ScoreKind::Cosine } else { ScoreKind::Relevancy })
    }

    /// Returns the threshold, and where it comes from. `calibration`: how texts score over what is scored.
    fn threshold(
        self,
        request: &QueryRequest,
        manifest: &Manifest,
        calibration: Option<Calibration>,
    ) -> (f32, ThresholdSource) {
        match (request.threshold, self.0) {
            (Some(threshold), _) => (threshold, ThresholdSource::Request),
            (None, ScoreKind::Relevancy) => (RELEVANCY_THRESHOLD, ThresholdSource::Relevancy),
            (None, ScoreKind::Cosine) => {
                // A model that states its threshold is taken at its word: a cosine is a cosine.
                let scene = manifest.encoder.calibration.and(calibration);
                calibrated_threshold(manifest.encoder.default_threshold, scene)
            }
        }
    }

    fn shown(self, score: f32) -> f32 {
        match self.0 {
            ScoreKind::Cosine => score,
            ScoreKind::Relevancy => relevancy(score),
        }
    }

    fn to_score(self, shown: f32) -> f32 {
        match self.0 {
            ScoreKind::Cosine => shown,
            ScoreKind::Relevancy => score_of_relevancy(shown),
        }
    }

    fn error_bound(self, of_score: f32) -> f32 {
        match self.0 {
            ScoreKind::Cosine => of_score,
            // A sigmoid is nowhere steeper than a quarter of its steepness at 0.
            ScoreKind::Relevancy => (of_score * RELEVANCY_STEEPNESS / 4.0 + f32::EPSILON).min(1.0),
        }
    }
}

/// Returns whether the region asked for was fetched: surely where the ball or the box was, since only
/// what lies in both was asked for.
fn area_fetched((centre, radius): (DVec3, f64), request: &QueryRequest) -> Option<bool> {
    let region = request.region();
    let ball = region.ball.map(|ball| ball.centre_in_world.distance(centre) + ball.radius <= radius);
    let bounds = region.bounds.map(|b| (b.min - centre).abs().max((b.max - centre).abs()).length() <= radius);
    ball.into_iter().chain(bounds).reduce(|a, b| a || b)
}

/// Returns how boxes may be turned: a metric or geo-referenced world has z up (`frames.rs`).
fn alignment(manifest: &Manifest) -> Alignment {
    let z_is_up = manifest.metric || manifest.geo_reference.is_some();
    if z_is_up { Alignment::Gravity } else { Alignment::Principal }
}

/// Returns the edge of the voxels where a request states none: 0.25 m in a metric scene, else a 64th
/// of the median cell's middle edge (sky and ground make the longest and shortest edges meaningless).
pub fn default_voxel(manifest: &Manifest) -> f64 {
    if manifest.metric {
        return METRIC_VOXEL_M;
    }
    let middle = |size: DVec3| size.x.max(size.y).min(size.x.max(size.z)).min(size.y.max(size.z));
    let mut edges: Vec<f64> = manifest.cells.iter().map(|cell| middle(cell.bounds.size())).collect();
    edges.sort_by(f64::total_cmp);
    let voxel = edges.get(edges.len() / 2).map_or(0.0, |edge| edge / VOXELS_PER_CELL);
    if voxel > 0.0 && voxel.is_finite() { voxel } else { 1.0 }
}

/// Returns what clusters are ranked by: `(score - threshold) * ln(1 + n) / (1 + distance / half)`.
///
/// The score's margin, weighted by the evidence (more Gaussians, but with diminishing effect), halved
/// at a distance of `half` (40 voxels). In f32, so that the last bits of a machine's logarithm do not
/// show.
pub fn relevance(score: f32, threshold: f32, n_gaussians: u64, distance: Option<f64>, half: f64) -> f32 {
    let margin = f64::from((score - threshold).max(0.0));
    (margin * (1.0 + n_gaussians as f64).ln() / (1.0 + distance.unwrap_or(0.0) / half)) as f32
}

/// What was found, and where it stands among the answers.
struct Ranked<T> {
    found: T,
    rank: usize,
    relevance: f32,
    distance: Option<f64>,
}

/// Ranks what was found in a fixed order, in which equals stay, and keeps as many as are asked for. `standing`: score as it is
/// shown, Gaussians, and place.
fn rank<T>(
    found: Vec<T>,
    threshold: f32,
    manifest: &Manifest,
    request: &QueryRequest,
    standing: impl Fn(&T) -> (f32, u64, DVec3),
) -> Vec<Ranked<T>> {
    let half = VOXELS_TO_HALF_RELEVANCE * request.voxel.unwrap_or_else(|| default_voxel(manifest));
    let weighed = found.into_iter().map(|found| {
        let (score, n_gaussians, at) = standing(&found);
        let distance = request.near.map(|near| near.distance(at));
        let relevance = relevance(score, threshold, n_gaussians, distance, half);
        Ranked { found, rank: 0, relevance, distance }
    });
    let mut ranked: Vec<Ranked<T>> = weighed.collect();
    ranked.sort_by(|a, b| {
        let nearer = a.distance.unwrap_or(0.0).total_cmp(&b.distance.unwrap_or(0.0));
        b.relevance.total_cmp(&a.relevance).then(nearer)
    });
    ranked.truncate(request.limit.unwrap_or(DEFAULT_LIMIT));
    ranked.iter_mut().zip(1..).for_each(|(ranked, rank)| ranked.rank = rank);
    ranked
}

/// Describes a cluster.
fn cluster_answer(ranked: Ranked<Cluster>, manifest: &Manifest) -> ClusterAnswer {
    let Ranked { found: cluster, rank, relevance, distance } = ranked;
    ClusterAnswer {
        rank,
        id: format!("{}-{}", cluster.first.0, cluster.first.1),
        position_in_world: cluster.position_in_world,
        geographic: manifest.geo_reference.map(|geo| geo.geographic_from_world(cluster.position_in_world)),
        box_min_in_world: cluster.box_in_world.min,
        box_max_in_world: cluster.box_in_world.max,
        size: cluster.box_in_world.size(),
        oriented_box: cluster.oriented_box,
        score: cluster.score,
        best_score: cluster.best_score,
        n_gaussians: cluster.n_gaussians,
        n_gaussians_in_scene: None,
        evidence: None,
        relevance,
        distance,
    }
}

/// Describes an object likewise.
fn object_answer(
    scene: &Scene<'_>,
    ranked: Ranked<FoundObject<'_>>,
    scale: Scale,
    region: &Region,
) -> ClusterAnswer {
    let Ranked { found: FoundObject { object, record, score, n_gaussians }, rank, relevance, distance } =
        ranked;
    let (manifest, position) = (scene.manifest, record.position());
    let (bounds, score) = (record.bounds(), scale.shown(score));
    ClusterAnswer {
        rank,
        id: format!("o{:016x}", record.id),
        position_in_world: position,
        geographic: manifest.geo_reference.map(|geo| geo.geographic_from_world(position)),
        box_min_in_world: bounds.min,
        box_max_in_world: bounds.max,
        size: bounds.size(),
        oriented_box: objects::oriented_box(scene, object, region, alignment(manifest)),
        score,
        best_score: score,
        n_gaussians,
        n_gaussians_in_scene: Some(u64::from(record.n_gaussians)),
        evidence: Some(Evidence {
            photo: objects::photo(scene, object).to_owned(),
            box_px: record.photo_box_px,
        }),
        relevance,
        distance,
    }
}

/// `best`: score and place of the best object on board.
fn reason_of_objects(request: &QueryRequest, threshold: f32, best: Option<(f32, DVec3)>) -> Reason {
    let place = request.region();
    let (kind, detail) = match best {
        None => (
            ReasonKind::NothingThere,
            "the shards on board have no objects; ask with kind=clusters, or encode with objects".to_owned(),
        ),
        Some((score, at)) if score < threshold => (
            ReasonKind::BelowThreshold,
            format!("no object reaches {threshold}; the best has {score:.3}, at {at:.2}"),
        ),
        Some(_) => (
            ReasonKind::NothingThere,
            format!(
                "no object that reaches {threshold} has {} Gaussians{place}; fetch that area, or ask elsewhere",
                request.min_count
            ),
        ),
    };
    Reason {
        kind,
        detail,
        best_score: best.map(|(score, _)| score),
        best_position_in_world: best.map(|(_, at)| at),
    }
}

fn reason(
    search: &Search<'_>,
    scale: Scale,
    request: &QueryRequest,
    threshold: f32,
    n_matching: u64,
) -> Reason {
    let place = request.region();
    let best = search.best(1, f32::NEG_INFINITY, request.near).first().map(|hit| {
        (scale.shown(hit.score), search.shards()[hit.shard as usize].position_in_world(hit.index as usize))
    });
    let (kind, detail) = match best {
        None => (
            ReasonKind::NothingThere,
            format!("no Gaussian with an embedding lies{place}; fetch that area, or ask elsewhere"),
        ),
        Some(_) if n_matching > 0 => (
            ReasonKind::ClustersTooSmall,
            format!(
                "{n_matching} Gaussians{place} reach {threshold}, but no group of them has {}; ask with a smaller min_count or a larger voxel",
                request.min_count
            ),
        ),
        Some((score, at)) => {
            let n: usize = search.searched().map(ShardView::n_with_evidence).sum();
            (
                ReasonKind::BelowThreshold,
                format!(
                    "no Gaussian of the {n} searched{place} reaches {threshold}; the best has {score:.3}, at {at:.2}"
                ),
            )
        }
    };
    Reason {
        kind,
        detail,
        best_score: best.map(|(score, _)| score),
        best_position_in_world: best.map(|(_, at)| at),
    }
}

#[cfg(test)]
mod tests;
