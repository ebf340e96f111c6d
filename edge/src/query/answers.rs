//! What an answer says.

use glam::DVec3;
use serde::Serialize;
use serde::ser::{SerializeSeq, Serializer};
use slag_common::frames::Geographic;
use slag_common::shard::ShardView;

use super::oriented::OrientedBox;
use super::request::AnswerKind;
use super::threshold::ThresholdSource;
use crate::score::Hit;

/// What scores and thresholds are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum ScoreKind {
    /// `q · E_k`, -1..1.
    Cosine,
    /// `1 / (1 + exp(-10 (q · E_k - max_j n_j · E_k)))`, 0..1.
    Relevancy,
}

/// Answers to one question. `answers` comes last, so that long lists can be sent piece by piece.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Answers {
    /// The question.
    pub text: String,
    /// What its thing is told from.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub negatives: Vec<String>,
    /// What the answers are made of.
    pub kind: AnswerKind,
    /// Name of the scene.
    pub scene: String,
    /// Generation of the scene.
    pub generation: u64,
    /// Unit of every position and length: `m`, or `world` where the model is not metric.
    pub unit: &'static str,
    /// What scores are.
    pub score_kind: ScoreKind,
    /// Score from which a Gaussian matches.
    pub threshold: f32,
    /// Where the threshold comes from.
    pub threshold_source: ThresholdSource,
    /// Gaussians with an embedding in the shards that were searched.
    pub n_searched: u64,
    /// Gaussians that match.
    pub n_matching: u64,
    /// Whether exactly the Gaussians that reach the threshold match; else a Gaussian whose score lies
    /// within `score_error_bound` of the threshold may be on the wrong side.
    pub is_exact: bool,
    /// No score is off by more.
    pub score_error_bound: f32,
    /// Measured over a bank of texts, 999 of 1,000 scores are off by less; absent where answers are exact, and
    /// where it was not measured.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub score_error_p999: Option<f32>,
    /// Whether all of the region asked for was fetched; absent without `radius` and `box`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub area_fetched: Option<bool>,
    /// How matches were grouped; only at kind `clusters`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub clustering: Option<Clustering>,
    /// Why there is no answer; absent if there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<Reason>,
    /// The answers, best first. Written as an empty list: [`super::Reply::pieces`] fills it.
    #[serde(serialize_with = "empty_list")]
    pub answers: Found,
}

/// Answers of either kind.
#[derive(Clone, Debug, PartialEq)]
pub enum Found {
    /// Clusters.
    Clusters(Vec<ClusterAnswer>),
    /// Gaussians; [`GaussianAnswer::new`] says more of each.
    Gaussians(Vec<Hit>),
}

impl Found {
    /// Returns the number of answers.
    pub fn len(&self) -> usize {
        match self {
            Self::Clusters(answers) => answers.len(),
            Self::Gaussians(hits) => hits.len(),
        }
    }

    /// Whether there is no answer.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

fn empty_list<S: Serializer>(_: &Found, to: S) -> Result<S::Ok, S::Error> {
    to.serialize_seq(Some(0))?.end()
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

/// A group of matching Gaussians, or an object.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ClusterAnswer {
    /// Place in the list, from 1.
    pub rank: usize,
    /// Cell and index of its first Gaussian, which keeps its meaning within a generation; of an object `o` and 16 hex
    /// digits, which keep theirs as long as its Gaussians stay the same.
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
    /// Its box along axes of its own, upright where the world has a known up.
    pub oriented_box: OrientedBox,
    /// Mean score of its Gaussians; of an object that of its masks.
    pub score: f32,
    /// Best score of its Gaussians; of an object its score.
    pub best_score: f32,
    /// Its Gaussians; of an object those on board, in the region asked for.
    pub n_gaussians: u64,
    /// Of an object: its Gaussians in the whole scene.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub n_gaussians_in_scene: Option<u64>,
    /// Of an object: where to see it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub evidence: Option<Evidence>,
    /// What the list is ranked by, see [`super::relevance`].
    pub relevance: f32,
    /// Distance of the position from `near`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub distance: Option<f64>,
}

/// The photo that shows an object best.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Evidence {
    /// Name of its view.
    pub photo: String,
    /// Where the object lies in it, free of distortion: x0, y0, x1, y1, the latter exclusive.
    pub box_px: [u32; 4],
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

impl GaussianAnswer {
    /// Describes the hit at place `at` of the list, from 0. `shard`: the one that it names.
    pub fn new(at: usize, hit: &Hit, shard: &ShardView<'_>, near: Option<DVec3>) -> Self {
        let position_in_world = shard.position_in_world(hit.index as usize);
        Self {
            rank: at + 1,
            cell_id: shard.header.cell_id,
            index: hit.index,
            input_index: shard.exact.map(|exact| exact.input_indices[hit.index as usize]),
            position_in_world,
            score: hit.score,
            distance: near.map(|near| near.distance(position_in_world)),
        }
    }
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
