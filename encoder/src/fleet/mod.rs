//! The views of an encode on many machines: a bucket keeps everything that is made, workers do views, a
//! coordinator plans, waits, makes the cells and publishes. A queue only hands out work: a view that the bucket
//! has is done.
//!
//! | key in the bucket | content |
//! |---|---|
//! | `inputs/HASH` | scene, photos and mask files, by the BLAKE3 of their content |
//! | `jobs/N/plan.json` | the plan of run N: settings and views; the highest N counts |
//! | `jobs/N/failed/VIEW.json` | views that are left out, and why |
//! | `jobs/N/heartbeat` | changes for as long as the coordinator lives |
//! | `jobs/N/done` | there once all views are: workers may go |
//! | `jobs/N/end.json` | how run N ended: published, or superseded by the next. The first one to put it decides |
//! | `views/IDENTITY` | a view's contributions: it is done when this is there |
//!
//! Inputs and views are named by content and put only if absent: work that is done twice, by a worker that was thought
//! dead, changes nothing, and a run reuses the results of earlier ones.

pub(crate) mod coordinator;
mod dispatch;
mod documents;
mod heartbeat;
mod objects;
mod prepared;
mod queue;
mod run;
mod views;
pub(crate) mod worker;

use crate::blobs::Bucket;
use crate::encode::EncodeError;

pub(crate) use coordinator::Coordinator;
pub(crate) use queue::{QueueSettings, parse_period};
pub(crate) use worker::{Dispatch, WorkerSettings, work};

fn damaged(bucket: &Bucket, key: &str, problem: impl std::fmt::Display) -> EncodeError {
    EncodeError::Failed(format!("{}/{key}: {problem}; delete it, and it is made again", bucket.url))
}
