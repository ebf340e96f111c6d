//! A client of the robot's HTTP interface: `slag-edge serve` under `/v1` (docs/api.md).

mod client;
mod error;
mod reply;

pub use client::{Robot, RobotArgs, xyz};
pub use error::RobotError;
pub use reply::{Answer, Nothing, PointAnswer, Reply, Results, Witness};
pub use slag_api as api;
pub use slag_common::objects::parse_public_id;
pub use slag_common::{durable, note};
