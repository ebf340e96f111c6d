//! From a question to ranked answers.

pub mod cluster;
mod engine;
mod request;

use glam::DVec3;
use serde::Serialize;
use slag_common::frames::Geographic;
use slag_common::manifest::Manifest;
use slag_common::shard::ShardView;

pub use engine::{Engine, QueryError, ShardStatus, Status};
pub use request::{
    DEFAULT_LIMIT, DEFAULT_MIN_COUNT, Level, MAX_LIMIT, QueryRequest, RequestError, parse_point,
};

use crate::score::{Precision, Question, Region, ScoreError, Search, rounding_bound};
use cluster::{Cluster, cluster};

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

/// Answers to one question.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Answers {
    /// The question.
    pub text: String,
    /// What the answers are made of.
    pub level: Level,
    /// Name of the scene.
    pub scene: String,
    /// Generation of the scene.
    pub generation: u64,
    /// Unit of every position and length: `m`, or `world` where the model is not metric.
    pub unit: &'static str,
    /// Cosine from which a Gaussian matches.
    pub threshold: f32,
    /// Gaussians with an embedding in the shards that were searched.
    pub n_searched: u64,
    /// Gaussians that match.
    pub n_matching: u64,
    /// Whether exactly the Gaussians that reach the threshold match; else a Gaussian whose score lies
    /// within `score_error_bound` of the threshold may be on the wrong side.
    pub exact: bool,
    /// No score is off by more.
    pub score_error_bound: f32,
    /// Whether all of the ball asked for was fetched; absent without `radius`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub area_fetched: Option<bool>,
    /// How matches were grouped; absent at level `gaussians`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub clustering: Option<Clustering>,
    /// The answers, best first.
    pub answers: Found,
    /// Why there is none; absent if there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<Reason>,
}

/// Answers of either level.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Found {
    /// Clusters.
    Clusters(Vec<ClusterAnswer>),
    /// Gaussians.
    Gaussians(Vec<GaussianAnswer>),
}

impl Found {
    /// Whether there is no answer.
    pub fn is_empty(&self) -> bool {
        match self {
            Self::Clusters(answers) => answers.is_empty(),
            Self::Gaussians(answers) => answers.is_empty(),
        }
    }
}

/// How matches were grouped.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Clustering {
    /// Edge of the voxels.
    pub voxel: f64,
    /// Members that a cluster needs.
    pub min_count: u64,
    /// Clusters with enough members; those past the limit included.
    pub n_clusters: u64,
    /// Clusters with too few.
    pub n_small_clusters: u64,
    /// Gaussians in those.
    pub n_gaussians_in_small_clusters: u64,
}

/// A group of matching Gaussians: an object, or what touches it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ClusterAnswer {
    /// Place in the list, from 1.
    pub rank: usize,
    /// Cell and index of its first Gaussian; keeps its meaning within a generation.
    pub id: String,
    /// Mean of its Gaussians inside the box.
    pub position_in_world: DVec3,
    /// The same on the earth, where the scene is geo-referenced.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub geographic: Option<Geographic>,
    /// Smallest corner of its box: 2nd percentile along each axis, so that floaters do not count.
    pub box_min_in_world: DVec3,
    /// Largest corner: 98th percentile.
    pub box_max_in_world: DVec3,
    /// Edges of the box.
    pub size: DVec3,
    /// Mean score of its Gaussians.
    pub score: f32,
    /// Best score of its Gaussians.
    pub best_score: f32,
    /// Its Gaussians.
    pub n_gaussians: u64,
    /// What the list is ranked by, see [`relevance`].
    pub relevance: f32,
    /// Distance of the position from `near`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub distance: Option<f64>,
}

/// A matching Gaussian.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GaussianAnswer {
    /// Place in the list, from 1.
    pub rank: usize,
    /// Its cell.
    pub cell_id: u32,
    /// Its index in the cell's shard.
    pub index: u32,
    /// Its index in the input splat file, where the profile keeps it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub input_index: Option<u32>,
    /// Its mean.
    pub position_in_world: DVec3,
    /// Its score.
    pub score: f32,
    /// Distance from `near`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub distance: Option<f64>,
}

/// Why there is no answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum ReasonKind {
    /// No Gaussian reaches the threshold.
    BelowThreshold,
    /// Gaussians match, but no cluster has enough of them.
    ClustersTooSmall,
    /// No Gaussian with an embedding lies in the part of space asked for.
    NothingThere,
}

/// Why there is no answer, and what came nearest.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Reason {
    /// Kind.
    pub kind: ReasonKind,
    /// For people.
    pub detail: String,
    /// Best score of a Gaussian.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub best_score: Option<f32>,
    /// Where that Gaussian lies.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub best_position_in_world: Option<DVec3>,
}

/// Answers a checked request about a scene. `query`: the text's vector, `[dim]`, unit length.
///
/// Same scene, vector and request: same answers, for any number of threads.
/// # Errors
/// [`ScoreError`].
pub fn answer(scene: &Scene<'_>, query: &[f32], request: &QueryRequest) -> Result<Answers, ScoreError> {
    let manifest = scene.manifest;
    let threshold = request.threshold.unwrap_or(manifest.encoder.default_threshold);
    let limit = request.limit.unwrap_or(DEFAULT_LIMIT);
    let question = Question::new(query);
    let region = Region { ball: request.ball(), bounds: None };
    let search = Search::new(scene.shards, &question, region, Precision::Exact)?;
    let matches = search.matching(threshold);
    let exact = search.is_exact();
    let mut clustering = None;
    let found = match request.level {
        Level::Clusters => {
            let voxel = request.voxel.unwrap_or_else(|| default_voxel(manifest));
            let grouped = cluster(scene.shards, &matches.runs, voxel, request.min_count);
            clustering = Some(Clustering {
                voxel: grouped.voxel,
                min_count: request.min_count,
                n_clusters: grouped.clusters.len() as u64,
                n_small_clusters: grouped.n_small,
                n_gaussians_in_small_clusters: grouped.n_gaussians_in_small,
            });
            Found::Clusters(rank(grouped.clusters, threshold, voxel, limit, request.near, manifest))
        }
        Level::Gaussians => Found::Gaussians(gaussians(scene, &search, limit, threshold, request.near)),
    };
    let reason = found.is_empty().then(|| reason(&search, request, threshold, matches.n_gaussians));
    // Gaussians of exact shards are listed with their own scores, clusters with their rows'.
    let score_error_bound = match (exact, request.level) {
        (true, Level::Gaussians) => rounding_bound(query.len()),
        _ => search.score_error_bound(),
    };
    let (centre, radius) = scene.fetched;
    Ok(Answers {
        text: request.text.clone(),
        level: request.level,
        scene: manifest.scene.clone(),
        generation: manifest.generation,
        unit: if manifest.metric { "m" } else { "world" },
        threshold,
        n_searched: search.searched().map(|shard| shard.n_with_evidence() as u64).sum(),
        n_matching: matches.n_gaussians,
        exact,
        score_error_bound,
        area_fetched: request
            .ball()
            .map(|ball| ball.centre_in_world.distance(centre) + ball.radius <= radius),
        clustering,
        answers: found,
        reason,
    })
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
        score: cluster.score,
        best_score: cluster.best_score,
        n_gaussians: cluster.n_gaussians,
        relevance,
        distance,
    });
    answers.collect()
}

fn gaussians(
    scene: &Scene<'_>,
    search: &Search<'_>,
    limit: usize,
    threshold: f32,
    near: Option<DVec3>,
) -> Vec<GaussianAnswer> {
    let hits = search.best(limit, threshold, near).into_iter().enumerate();
    let answers = hits.map(|(at, hit)| {
        let shard = &scene.shards[hit.shard as usize];
        let position_in_world = shard.position_in_world(hit.index as usize);
        GaussianAnswer {
            rank: at + 1,
            cell_id: shard.header.cell_id,
            index: hit.index,
            input_index: shard.exact.map(|exact| exact.input_indices[hit.index as usize]),
            position_in_world,
            score: hit.score,
            distance: near.map(|near| near.distance(position_in_world)),
        }
    });
    answers.collect()
}

fn reason(search: &Search<'_>, request: &QueryRequest, threshold: f32, n_matching: u64) -> Reason {
    let place = match request.ball() {
        Some(ball) => format!(" within {} of {}", ball.radius, ball.centre_in_world),
        None => String::new(),
    };
    let best = search
        .best(1, f32::NEG_INFINITY, request.near)
        .first()
        .map(|hit| (hit.score, search.shards()[hit.shard as usize].position_in_world(hit.index as usize)));
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
        Some(best) => {
            let n: usize = search.searched().map(ShardView::n_with_evidence).sum();
            let (score, at) = best;
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
