//! Places to stand: what the robot is asked, and its answer as messages.

use slag_robot::{Goals, Robot};

use crate::answers;
use crate::geometry::{Pose, Quaternion};
use crate::ground;
use crate::messages::{OccupancyGrid, PoseStamped, StandReply};

/// The robot's size and reach.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Body {
    /// Radius, seen from above, metres.
    pub radius_m: f64,
    /// Height of its sensor above the ground, metres.
    pub sensor_height_m: f64,
    /// How close its middle must come to a thing's surface, metres.
    pub reach_m: f64,
}

impl Body {
    fn parameters(&self, place: Option<[f64; 3]>) -> Vec<(&'static str, String)> {
        let near = place.map(|[x, y, z]| ("near", format!("{x},{y},{z}")));
        let own = [("radius_m", self.radius_m), ("sensor_height_m", self.sensor_height_m)];
        own.map(|(name, value)| (name, value.to_string())).into_iter().chain(near).collect()
    }

    /// Asks for places to stand near a thing; `place`: where the robot is, if that is known.
    pub fn stand(&self, robot: &Robot, text: &str, place: Option<[f64; 3]>) -> Result<Goals, String> {
        let mut parameters = self.parameters(place);
        parameters.extend([
            ("text", text.to_owned()),
            ("reach_m", self.reach_m.to_string()),
            ("limit", "1".into()),
        ]);
        robot.goal(&parameters).map_err(|e| e.to_string())
    }

    /// Asks for the ground around the robot; `None` if it reaches none.
    pub fn ground(
        &self,
        robot: &Robot,
        frame: &str,
        place: Option<[f64; 3]>,
    ) -> Result<Option<OccupancyGrid>, String> {
        let floor = robot.floor(&self.parameters(place)).map_err(|e| e.to_string())?;
        Ok(ground::grid(answers::header(frame), &floor, self.radius_m))
    }
}

pub fn reply(frame: &str, found: Result<Goals, String>) -> StandReply {
    let header = answers::header(frame);
    let none = Pose { position: [0.0; 3].into(), orientation: Quaternion::IDENTITY };
    let mut reply = StandReply {
        success: false,
        message: String::new(),
        pose: PoseStamped { header: header.clone(), pose: none },
        clearance_m: 0.0,
        visible_share: 0.0,
        way_m: 0.0,
    };
    match found {
        Err(message) => reply.message = message,
        Ok(goals) => match (goals.goals.first(), goals.none) {
            (Some(best), _) => {
                reply.success = true;
                reply.pose = answers::goal_pose(&header, best);
                (reply.clearance_m, reply.visible_share, reply.way_m) =
                    (best.clearance_m, best.visible_share, best.path_m);
            }
            (None, none) => {
                reply.message = none.map_or_else(|| "the robot gave no reason".into(), |none| none.detail);
            }
        },
    }
    reply
}
