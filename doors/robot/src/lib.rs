//! The robot's HTTP interface as its clients see it: `slag-edge serve`, asked over `/v1` (docs/api.md).

mod args;
mod changes;
mod client;
mod error;
mod floor;
mod goal;
mod locate;
mod place;
mod reply;

pub use args::RobotArgs;
pub use changes::{Changed, Changes, Compared, Like, Miss, Moved};
pub use client::Robot;
pub use error::RobotError;
pub use floor::{Floor, Place as FloorPlace};
pub use goal::{Goal, GoalMiss, GoalThing, Goals};
pub use locate::{CameraPose, Whereabouts};
pub use place::{Box3, Cell, Name, OnBoard, OnBoardThing, Place};
pub use reply::{Answer, Geographic, Nothing, OrientedBox, PointAnswer, Reply, Results, Witness};
