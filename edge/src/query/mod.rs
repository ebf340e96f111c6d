//! From a question to ranked answers.

mod answer;
mod answers;
#[cfg(feature = "arrow")]
mod arrow;
pub mod cluster;
mod engine;
mod extent;
mod format;
mod json;
mod objects;
mod oriented;
mod ply;
mod rank;
mod reason;
mod reply;
mod request;
mod scale;
mod scene;
mod status;
mod threshold;

pub use answer::answer;
pub use answers::{
    Answers, ClusterAnswer, Clustering, Evidence, Found, GaussianAnswer, Reason, ReasonKind, ScoreKind,
};
pub use engine::{Engine, QueryError};
pub use format::Format;
pub use oriented::{Alignment, OrientedBox};
pub use rank::relevance;
pub use reply::Reply;
pub use request::{
    AnswerKind, CANONICAL_NEGATIVES, DEFAULT_LIMIT, DEFAULT_MIN_COUNT, MAX_CLUSTERS, MAX_GAUSSIANS,
    MAX_NEGATIVES, MAX_TEXTS, Negatives, QueryRequest, RequestError, parse_box, parse_point,
};
pub use scene::{Scene, default_voxel};
pub use status::{ShardStatus, Status};
pub use threshold::{RELEVANCY_THRESHOLD, ThresholdSource, calibrated_threshold};

#[cfg(test)]
mod tests;
