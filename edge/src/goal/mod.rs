//! Places to stand: reachable poses near a thing that see it. Definitions: `docs/numerics.md`.
//!
//! | step | result | file |
//! |---|---|---|
//! | space | the blocks around the robot, in columns | `space.rs` |
//! | ground | the lowest surface with headroom, in each column of voxels | `ground.rs` |
//! | clearance | distance of each place to what the robot must not touch | `clearance.rs` |
//! | paths | length of the way from the robot | `paths.rs` |
//! | sight | what a sensor sees of the thing | `sight.rs` |
//! | choose | candidates, their costs, the best | `choose.rs` |

mod choose;
mod clearance;
mod find;
mod ground;
mod map;
mod paths;
pub mod request;
mod sight;
mod space;
mod surroundings;

#[cfg(test)]
mod tests;

pub use find::find;
pub use map::{FloorMap, floor_map};
pub use request::{GoalRequest, GoalTarget, Robot, Stand};
