//! An encode on many machines: a bucket keeps everything that is made, workers take views and cells, a coordinator plans,
//! waits and publishes. A queue only hands out work: what the bucket has is done.
//!
//! | key in the bucket | content |
//! |---|---|
//! | `inputs/HASH` | scene, photos and mask files, by the BLAKE3 of their content |
//! | `jobs/N/plan.json` | the plan of run N: settings and views; the highest N counts |
//! | `jobs/N/cells.json` | the cells of run N, once all views are brought together |
//! | `jobs/N/failed/VIEW.json` | views that are left out, and why |
//! | `jobs/N/pulse` | the coordinator's last sign of life |
//! | `jobs/N/end.json` | how run N ended: published, or superseded by the next. The first one to put it decides |
//! | `views/IDENTITY` | a view's contributions: it is done when this is there |
//! | `merged/HASH` | what all views together say about every cell |
//! | `cells/IDENTITY/CELL.json` | the record of a cell, whose shards are in `objects/`: it is done when this is there |
//! | `objects/HASH` | shards and fields |
//!
//! All but `end.json` and `pulse` are named by what they are made of, and put on condition that they are not there: work that is done twice, by a worker
//! that was thought dead, changes nothing, and a run takes up what earlier ones left.
//!
//! | file | job |
//! |---|---|
//! | [`coordinator`] | the executor of `encode --blobs` |
//! | [`worker`] | `worker`: prepares a run, and does its views and cells |
//! | `share`, `queue` | which views and cells a worker takes: its share, or what JetStream hands out |
//! | `run`, `pulse` | the runs in a bucket, their fence, and whether their coordinator lives |
//! | `documents`, `view_object`, `scene_object`, `merged` | what lies in the bucket |
//! | `run_folder` | a worker's folder for photos in work |
//! | `inputs` | photos and masks on their way to and from the bucket |

mod cells;
pub mod coordinator;
mod dispatch;
mod documents;
mod error;
mod inputs;
mod merged;
mod prepared;
mod pulse;
mod queue;
mod run;
mod run_folder;
mod scene_object;
mod share;
mod view_object;
mod views;
pub mod worker;

pub use coordinator::Coordinator;
pub use error::{FleetError, QueueError};
pub use queue::QueueSettings;
pub use worker::{Dispatch, WorkReport, WorkerSettings, work};
