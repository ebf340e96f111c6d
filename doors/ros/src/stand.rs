//! Places to stand: request to the robot, and its answer as messages.

use slag_robot::api::goal::GoalReply;
use slag_robot::{Robot, xyz};

use crate::answers;
use crate::args::Args;
use crate::geometry::{Pose, Quaternion};
use crate::ground;
use crate::messages::{OccupancyGrid, PoseStamped, StandReply};

impl Args {
    fn parameters(&self, place: Option<[f64; 3]>) -> Vec<(&'static str, String)> {
        let near = place.map(|place| ("near", xyz(place)));
        let own = [("radius_m", self.robot_radius), ("sensor_height_m", self.sensor_height)];
        own.map(|(name, value)| (name, value.to_string())).into_iter().chain(near).collect()
    }

    /// `place`: the robot's position, if known.
    pub fn stand(&self, robot: &Robot, text: &str, place: Option<[f64; 3]>) -> Result<GoalReply, String> {
        let mut parameters = self.parameters(place);
        parameters.extend([
            ("text", text.to_owned()),
            ("reach_m", self.reach.to_string()),
            ("limit", "1".into()),
        ]);
        robot.goal(&parameters).map_err(|e| e.to_string())
    }

    /// Requests the ground around the robot; `None` if it reaches none.
    pub fn ground(&self, robot: &Robot, place: Option<[f64; 3]>) -> Result<Option<OccupancyGrid>, String> {
        let floor = robot.floor(&self.parameters(place)).map_err(|e| e.to_string())?;
        Ok(ground::grid(answers::header(&self.scene_frame), &floor, self.robot_radius))
    }
}

pub fn reply(frame: &str, found: Result<GoalReply, String>) -> StandReply {
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
