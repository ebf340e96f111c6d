//! What `where_am_i` takes and gives.

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use rmcp::schemars::{self, JsonSchema};
use serde::{Deserialize, Serialize};
use slag_robot::api::locate::{self, Answer};
use slag_robot::{Robot, xyz};

/// A photo, and what is known about its camera.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Seen {
    /// A JPEG or PNG file in base64.
    #[schemars(length(min = 1, max = 4_000_000))]
    pub photo_base64: String,
    /// Focal length of its camera, pixels of the photo.
    #[schemars(range(min = 1.0))]
    pub focal_px: f64,
    /// Direction of gravity in the camera's frame (x right, y down, z forward).
    pub gravity: Option<[f64; 3]>,
    /// Where the camera may be, [x, y, z] in the world frame; with `sigma`.
    pub near: Option<[f64; 3]>,
    /// Standard deviation of `near`, world units.
    pub sigma: Option<f64>,
}

/// Where the camera is.
#[derive(Debug, Serialize, JsonSchema)]
pub struct Places {
    /// "found": the one pose. "unsure": poses of which none is certain, best first. "lost": none.
    pub state: &'static str,
    /// Why it is unsure or lost.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// Poses of the camera.
    pub poses: Vec<Pose>,
}

/// Pose of a camera.
#[derive(Debug, Serialize, JsonSchema)]
pub struct Pose {
    /// The camera, world frame.
    pub position_in_world: [f64; 3],
    /// Largest standard deviation of the position along the world's axes, world units.
    pub position_sigma: f64,
    /// Where it looks: radians from the world's x axis towards y.
    pub heading_rad: f64,
    /// Latitude and longitude (WGS 84), where the scene is geo-referenced.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lat_lon_deg: Option<[f64; 2]>,
}

impl Seen {
    pub fn locate(&self, robot: &Robot) -> Result<Places, String> {
        let photo = BASE64_STANDARD.decode(&self.photo_base64);
        let photo =
            photo.map_err(|error| format!("photo_base64: {error}; give a JPEG or PNG file in base64"))?;
        let parameters = [
            Some(("focal_px", self.focal_px.to_string())),
            self.gravity.map(|gravity| ("gravity", xyz(gravity))),
            self.near.map(|near| ("near", xyz(near))),
            self.sigma.map(|sigma| ("sigma", sigma.to_string())),
        ];
        let parameters: Vec<(&str, String)> = parameters.into_iter().flatten().collect();
        robot.locate(&parameters, &photo).map(Places::from).map_err(|error| error.to_string())
    }
}

impl From<Answer> for Places {
    fn from(of: Answer) -> Self {
        let (state, reason, poses) = match of {
            Answer::Found(pose) => ("found", None, vec![pose]),
            Answer::Unsure { reason, candidates } => ("unsure", Some(reason), candidates),
            Answer::Lost { reason } => ("lost", Some(reason), Vec::new()),
        };
        Self { state, reason, poses: poses.into_iter().map(Pose::from).collect() }
    }
}

impl From<locate::Pose> for Pose {
    fn from(of: locate::Pose) -> Self {
        let [x, y, z, w] = of.rotation_xyzw;
        Self {
            position_in_world: of.position_in_world,
            position_sigma: of.position_sigma(),
            heading_rad: (2.0 * (x * y + w * z)).atan2(1.0 - 2.0 * (y * y + z * z)),
            lat_lon_deg: of.geographic.map(|place| [place.latitude_deg, place.longitude_deg]),
        }
    }
}
