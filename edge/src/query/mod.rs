//! From a question to ranked answers.

mod answers;
mod arrow;
pub mod cluster;
mod engine;
mod oriented;
mod reply;
mod request;
mod threshold;

use glam::DVec3;
use slag_common::manifest::Manifest;
use slag_common::shard::ShardView;

pub use answers::{Answers, ClusterAnswer, Clustering, Found, GaussianAnswer, Reason, ReasonKind, ScoreKind};
pub use engine::{Engine, QueryError, ShardStatus, Status};
pub use oriented::{Alignment, OrientedBox};
pub use reply::{Format, Reply};
pub use request::{
    CANONICAL_NEGATIVES, DEFAULT_LIMIT, DEFAULT_MIN_COUNT, Level, MAX_CLUSTERS, MAX_GAUSSIANS, MAX_NEGATIVES,
    MAX_TEXTS, Negatives, QueryRequest, RequestError, parse_box, parse_point,
};
pub use threshold::{RELEVANCY_THRESHOLD, ThresholdSource, calibrated_threshold};

use crate::score::{
    Question, RELEVANCY_STEEPNESS, ScoreError, Scratch, Search, relevancy, score_of_relevancy,
};
use cluster::{Cluster, Grouping, cluster};

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
    let searches = Search::batch(scratch, scene.shards, questions, request.region(), request.precision)?;
    let asked = request.texts.iter().zip(questions).zip(&searches);
    Ok(asked.map(|((text, question), search)| answer_one(scene, text, question, search, request)).collect())
}

fn answer_one(
    scene: &Scene<'_>,
    text: &str,
    question: &Question,
    search: &Search<'_>,
    request: &QueryRequest,
) -> Answers {
    let manifest = scene.manifest;
    let scale = Scale::of(question);
    let (threshold, threshold_source) = scale.threshold(request, manifest);
    let score_threshold = scale.to_score(threshold);
    let limit = request.limit.unwrap_or(DEFAULT_LIMIT);
    let mut clustering = None;
    let n_matching;
    let found = match request.level {
        Level::Clusters => {
            let mut matches = search.matching(score_threshold);
            matches.runs.iter_mut().for_each(|run| run.score = scale.shown(run.score));
            n_matching = matches.n_gaussians;
            let voxel = request.voxel.unwrap_or_else(|| default_voxel(manifest));
            let grouping =
                Grouping { voxel, min_count: request.min_count, threshold, alignment: alignment(manifest) };
            let grouped = cluster(scene.shards, &matches.runs, &grouping);
            clustering = Some(Clustering {
                voxel: grouped.voxel,
                min_count: request.min_count,
                n_clusters: grouped.clusters.len() as u64,
                n_small_clusters: grouped.n_small,
                n_gaussians_in_small_clusters: grouped.n_gaussians_in_small,
            });
            Found::Clusters(rank(grouped.clusters, threshold, voxel, limit, request.near, manifest))
        }
        Level::Gaussians => {
            let mut hits = search.best(limit, score_threshold, request.near);
            // Where all are listed, nobody need count them again.
            let is_whole = hits.len() < limit;
            n_matching =
                if is_whole { hits.len() as u64 } else { search.matching(score_threshold).n_gaussians };
            hits.iter_mut().for_each(|hit| hit.score = scale.shown(hit.score));
            Found::Gaussians(hits)
        }
    };
    let reason = found.is_empty().then(|| reason(search, scale, request, threshold, n_matching));
    // Gaussians of exact shards are listed with their own scores, clusters with their rows'.
    let score_error_bound = scale.error_bound(match (search.is_exact(), request.level) {
        (true, Level::Gaussians) => question.rounding_bound(),
        _ => search.score_error_bound(),
    });
    Answers {
        text: text.to_owned(),
        negatives: request.negatives.phrases().into_iter().map(str::to_owned).collect(),
        level: request.level,
        scene: manifest.scene.clone(),
        generation: manifest.generation,
        unit: if manifest.metric { "m" } else { "world" },
        score_kind: scale.0,
        threshold,
        threshold_source,
        n_searched: search.searched().map(|shard| shard.n_with_evidence() as u64).sum(),
        n_matching,
        is_exact: search.is_exact(),
        score_error_bound,
        score_error_p999: search.measured_errors().map(|errors| {
            // With negatives a score is the difference of two.
            let n_products = if question.negatives.is_empty() { 1.0 } else { 2.0 };
            scale.error_bound(n_products * errors.p999)
        }),
        area_fetched: area_fetched(scene.fetched, request),
        clustering,
        reason,
        answers: found,
    }
}

/// How scores are shown: as they are, or as relevancies.
#[derive(Clone, Copy)]
struct Scale(ScoreKind);

impl Scale {
    fn of(question: &Question) -> Self {
        Self(if question.negatives.is_empty() { ScoreKind::Cosine } else { ScoreKind::Relevancy })
    }

    fn threshold(self, request: &QueryRequest, manifest: &Manifest) -> (f32, ThresholdSource) {
        match (request.threshold, self.0) {
            (Some(threshold), _) => (threshold, ThresholdSource::Request),
            (None, ScoreKind::Relevancy) => (RELEVANCY_THRESHOLD, ThresholdSource::Relevancy),
            (None, ScoreKind::Cosine) => {
                calibrated_threshold(manifest.encoder.default_threshold, manifest.encoder.calibration)
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

fn rank(
    clusters: Vec<Cluster>,
    threshold: f32,
    voxel: f64,
    limit: usize,
    near: Option<DVec3>,
    manifest: &Manifest,
) -> Vec<ClusterAnswer> {
    let half = VOXELS_TO_HALF_RELEVANCE * voxel;
    let mut ranked: Vec<(f32, Option<f64>, Cluster)> = clusters
        .into_iter()
        .map(|cluster| {
            let distance = near.map(|near| near.distance(cluster.position_in_world));
            (relevance(cluster.score, threshold, cluster.n_gaussians, distance, half), distance, cluster)
        })
        .collect();
    ranked.sort_by(|(a_relevance, a_distance, a), (b_relevance, b_distance, b)| {
        let nearer = a_distance.unwrap_or(0.0).total_cmp(&b_distance.unwrap_or(0.0));
        b_relevance.total_cmp(a_relevance).then(nearer).then(a.first.cmp(&b.first))
    });
    ranked.truncate(limit);
    let answers = ranked.into_iter().enumerate().map(|(at, (relevance, distance, cluster))| ClusterAnswer {
        rank: at + 1,
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
        relevance,
        distance,
    });
    answers.collect()
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
