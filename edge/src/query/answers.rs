//! The contents of an answer.

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::DVec3;
use schemars::JsonSchema;
use serde::Serialize;
use serde::ser::{SerializeSeq, Serializer};
use slag_api::UNITS;
use slag_api::coverage::Coverage;
use slag_api::objects::{Evidence, OrientedBox};
use slag_common::frames::Geographic;
use slag_common::manifest::Manifest;
use slag_common::shard::ShardView;

use super::reason::Reason;
use super::relations::{self, Witness};
use super::request::{AnswerKind, QueryRequest};
use super::scale::{ScoreKind, ThresholdSource};
use crate::score::{Hit, Run};
use crate::store::Snapshot;

/// Answers to one question. `answers` is the last field written, so that long lists can be sent piece by piece.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Answers {
    /// The question.
    pub text: String,
    /// Kind of the answers.
    pub kind: AnswerKind,
    /// Name of the scene.
    pub scene: String,
    /// Generation of the scene.
    pub generation: u64,
    /// Unit of every position and length: `m`, or `world` if the scene is not metric.
    #[schemars(extend("enum" = UNITS))]
    pub unit: &'static str,
    #[serde(flatten)]
    pub searched: Searched,
    #[serde(flatten)]
    pub coverage: Coverage,
    /// What was asked in place of words that the model does not know.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub asked_as: BTreeMap<String, String>,
    /// Reason for an empty answer.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<Reason>,
    /// The answers, best first.
    // Serialised as an empty list, which `Reply::pieces` fills.
    #[serde(serialize_with = "empty_list")]
    #[schemars(with = "Vec<AnyAnswer>")]
    pub answers: Found,
    /// Of a phrase.
    #[serde(skip)]
    pub related: Option<Relations>,
}

/// The parts of a phrase, and how its answers are related.
#[derive(Clone, Debug, PartialEq)]
pub struct Relations {
    pub parts: Vec<relations::Found>,
    /// By answer: degree of the relation, and what it holds with.
    pub to: Vec<(f64, Vec<Witness>)>,
}

/// How a text or vector was searched for.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Searched {
    /// Negative prompts.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub negatives: Vec<String>,
    /// Meaning of scores.
    pub score_kind: ScoreKind,
    /// Score at or above which a Gaussian matches.
    pub threshold: f32,
    /// Source of the threshold.
    pub threshold_source: ThresholdSource,
    /// Gaussians with an embedding in the shards searched.
    pub n_searched: u64,
    /// Gaussians that match.
    pub n_matching: u64,
    /// Whether exactly the Gaussians at or above the threshold match. Otherwise a Gaussian with a score
    /// within `score_error_bound` of the threshold may be misplaced.
    pub is_exact: bool,
    /// Bound on the error of every score.
    pub score_error_bound: f32,
    /// For 95 of 100 questions, 99 of 100 scores of each shard err by no more: measured over texts that the
    /// codebook was not made for. With negatives, for 90 of 100. Absent if answers are exact or it was not
    /// measured.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub score_error_likely: Option<f32>,
    /// How matches were clustered; only for `kind=clusters`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub clustering: Option<Clustering>,
}

/// Answers to one text, or to several in their order: the schema of a reply, which is written piece by piece.
#[derive(JsonSchema)]
#[schemars(untagged)]
pub enum AnswersOrBatch {
    /// To one.
    Answers(Box<Answers>),
    /// To several.
    Batch {
        /// The answers to each.
        batch: Vec<Answers>,
    },
}

/// A cluster, an object or a Gaussian.
#[derive(JsonSchema)]
#[schemars(untagged)]
#[expect(dead_code, reason = "the schema of the answers' list, which is written piece by piece")]
enum AnyAnswer {
    Cluster(Box<ClusterAnswer>),
    Gaussian(GaussianAnswer),
}

#[derive(Clone, Debug, PartialEq)]
pub enum Found {
    Clusters(Vec<ClusterAnswer>),
    Gaussians(Vec<Hit>),
}

impl Found {
    pub fn len(&self) -> usize {
        match self {
            Self::Clusters(answers) => answers.len(),
            Self::Gaussians(hits) => hits.len(),
        }
    }

    pub fn len_bytes(&self) -> usize {
        match self {
            Self::Clusters(answers) => {
                let members: usize = answers.iter().map(|answer| size_of_val(&answer.members[..])).sum();
                size_of_val(&answers[..]) + members
            }
            Self::Gaussians(hits) => size_of_val(&hits[..]),
        }
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

fn empty_list<S: Serializer>(_: &Found, to: S) -> Result<S::Ok, S::Error> {
    to.serialize_seq(Some(0))?.end()
}

/// How matches were grouped.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Clustering {
    /// Edge of the voxels.
    pub voxel: f64,
    /// Members required of a cluster.
    pub min_count: u64,
    /// Clusters with enough members, including those beyond the limit.
    pub n_clusters: u64,
    /// Clusters with too few members.
    pub n_small_clusters: u64,
    /// Gaussians in clusters with too few members.
    pub n_gaussians_in_small_clusters: u64,
}

/// A cluster of matching Gaussians, or an object.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
#[schemars(rename = "Cluster")]
pub struct ClusterAnswer {
    /// Position in the list, from 1.
    pub rank: usize,
    /// For a cluster, the cell and index of its first Gaussian: valid within a generation. For an object, `o`
    /// and 16 hex digits: valid as long as its Gaussians stay the same.
    pub id: String,
    /// Mean of its Gaussians inside the box.
    #[schemars(with = "[f64; 3]")]
    pub position_in_world: DVec3,
    /// The same as latitude, longitude and height, if the scene is geo-referenced.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub geographic: Option<Geographic>,
    /// Smallest corner of its box: the 2nd percentile along each axis, so that floaters do not count.
    #[schemars(with = "[f64; 3]")]
    pub box_min_in_world: DVec3,
    /// Largest corner: 98th percentile.
    #[schemars(with = "[f64; 3]")]
    pub box_max_in_world: DVec3,
    /// Edges of the box.
    #[schemars(with = "[f64; 3]")]
    pub size: DVec3,
    /// Its box along axes of its own, upright if the world has a known up.
    pub oriented_box: OrientedBox,
    /// Mean score of its Gaussians; for an object, of its masks.
    pub score: f32,
    /// Best score of its Gaussians; for an object, its score.
    pub best_score: f32,
    /// Its Gaussians; for an object, those on board in the region asked for.
    pub n_gaussians: u64,
    /// For an object: its Gaussians in the whole scene.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub n_gaussians_in_scene: Option<u64>,
    /// For an object that the region asked for cuts: where the whole of it is. Everything else describes the part
    /// inside.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub whole: Option<Whole>,
    /// For an object: the photo that shows it best.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub evidence: Option<Evidence>,
    /// Key of the ranking: (score - base) / (1 + distance / 10 m), 0 below base; base is the mean score of
    /// unrelated texts for cosines, 0 for relevancies; without a metric scale 10 m is 40 default voxels.
    pub relevance: f32,
    /// Distance of the position from `near`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub distance: Option<f64>,
    /// Its Gaussians on board in the region asked for; only where the request asks for members.
    #[serde(skip)]
    pub members: Vec<Run>,
}

/// Where the whole of an object is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Whole {
    /// Mean of its Gaussians inside its box.
    #[schemars(with = "[f64; 3]")]
    pub position_in_world: DVec3,
    /// Smallest corner of its box.
    #[schemars(with = "[f64; 3]")]
    pub box_min_in_world: DVec3,
    /// Largest corner.
    #[schemars(with = "[f64; 3]")]
    pub box_max_in_world: DVec3,
}

/// A matching Gaussian.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
#[schemars(rename = "Gaussian")]
pub struct GaussianAnswer {
    /// Position in the list, from 1.
    pub rank: usize,
    /// Its cell.
    pub cell_id: u32,
    /// Its index in the cell's shard.
    pub index: u32,
    /// Its index in the input splat file, if the shard knows it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub input_index: Option<u32>,
    /// Its mean.
    #[schemars(with = "[f64; 3]")]
    pub position_in_world: DVec3,
    /// Its score.
    pub score: f32,
    /// Distance from `near`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub distance: Option<f64>,
}

/// The answers to a request and their generation.
pub struct Reply {
    pub(super) snapshot: Arc<Snapshot>,
    pub(super) request: QueryRequest,
    /// By question.
    pub answers: Vec<Answers>,
}

impl Reply {
    pub fn manifest(&self) -> &Manifest {
        &self.snapshot.manifest
    }

    pub fn gaussians(&self, answers: &Answers) -> Vec<GaussianAnswer> {
        let Found::Gaussians(hits) = &answers.answers else { return Vec::new() };
        hits.iter().enumerate().map(|(at, hit)| self.gaussian(at, hit)).collect()
    }

    /// Describes one Gaussian. `at`: its index in the list.
    pub(super) fn gaussian(&self, at: usize, hit: &Hit) -> GaussianAnswer {
        GaussianAnswer::new(at, hit, &self.snapshot.shards[hit.shard as usize].view(), self.request.near)
    }
}

impl GaussianAnswer {
    /// Describes a hit. `at`: its index in the list; `shard`: its shard.
    pub fn new(at: usize, hit: &Hit, shard: &ShardView<'_>, near: Option<DVec3>) -> Self {
        let position_in_world = shard.position_in_world(hit.index as usize);
        Self {
            rank: at + 1,
            cell_id: shard.header.cell_id,
            index: hit.index,
            input_index: shard.input_index(hit.index as usize),
            position_in_world,
            score: hit.score,
            distance: near.map(|near| near.distance(position_in_world)),
        }
    }
}
