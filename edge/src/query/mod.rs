//! From a question to ranked answers.

mod answer;
mod answers;
mod area;
#[cfg(feature = "arrow")]
mod arrow;
mod ask;
mod changes;
pub mod cluster;
mod engine;
mod format;
mod inventory;
mod listing;
mod names;
mod objects;
mod oriented;
mod page;
mod ply;
mod reason;
pub mod relations;
mod request;
mod scale;
mod scene;
mod status;
mod view;

pub use answer::answer;
pub use answers::{
    Answers, AnswersOrBatch, ClusterAnswer, Clustering, Found, GaussianAnswer, Reply, Searched,
};
pub use area::{Area, AreaBall, AreaBox, Corner, LatLon, Point};
pub use ask::Ask;
pub use changes::{ChangesRequest, NO_SUCH_GENERATION};
pub use engine::{Engine, OnBoard, QueryError};
pub use format::Format;
pub(crate) use inventory::NAMES_WAIT;
pub use inventory::{OBJECT_ID, ObjectFilter, ObjectOrder};
pub use listing::ListFormat;
pub use page::Page;
pub use reason::{Reason, ReasonKind};
pub use request::{
    AnswerKind, Asked, CANONICAL_NEGATIVES, DEFAULT_LIMIT, DEFAULT_MIN_COUNT, LENGTHS, MAX_CLUSTERS,
    MAX_GAUSSIANS, MAX_NEGATIVES, MAX_PAGE, MAX_TEXTS, Negatives, QueryRequest, RequestError, Words,
    check_length, check_region, is_length, numbers, parse_box, parse_point,
};
pub use scale::{RELEVANCY_THRESHOLD, ScoreKind, ThresholdSource, calibrated_threshold};
pub use scene::{Scene, default_voxel, unit};
pub use status::{ShardStatus, Status, map_status};

#[cfg(test)]
mod tests;
