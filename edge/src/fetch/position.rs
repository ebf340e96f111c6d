//! Positions of a robot, and their text forms.

use std::str::FromStr;

use glam::{DVec2, DVec3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use slag_common::frames::{Aabb, Geographic};
use slag_common::manifest::Manifest;

use crate::score::MAX_COORDINATE;

pub const MAX_TEXT_BYTES: usize = 256;

/// Position of a robot.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
#[schemars(rename = "KnownPosition")]
pub enum Position {
    /// In the world frame.
    World(#[schemars(with = "[f64; 3]")] DVec3),
    /// Geographic; needs a geo-referenced scene.
    Geographic {
        /// Latitude, degrees, north positive (WGS 84).
        latitude_deg: f64,
        /// Longitude, degrees, east positive.
        longitude_deg: f64,
        /// Height in metres, in the datum of the scene's origin; absent: the scene's own height there.
        height_m: Option<f64>,
    },
}

#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{found:?} is not a position; expected `x y z`, `lat,lon[,height]`, {{\"x\":..,\"y\":..,\"z\":..}} or {{\"lat\":..,\"lon\":..,\"height\":..}}"
)]
pub struct NotAPosition {
    /// The text, cut to 80 characters.
    pub found: String,
}

/// In the world frame, or on the earth in degrees and metres.
#[derive(Deserialize, JsonSchema)]
#[serde(untagged, deny_unknown_fields)]
#[schemars(rename = "Position")]
pub enum Spoken {
    /// In the world frame.
    World {
        /// Along x.
        x: f64,
        /// Along y.
        y: f64,
        /// Along z.
        z: f64,
    },
    /// On the earth, WGS 84.
    Geographic {
        /// Latitude, north positive.
        #[schemars(range(min = -90, max = 90))]
        lat: f64,
        /// Longitude, east positive.
        #[schemars(range(min = -180, max = 180))]
        lon: f64,
        /// Height in metres; the scene's own height there if absent.
        height: Option<f64>,
    },
}

impl FromStr for Position {
    type Err = NotAPosition;

    /// Parses `x y z` (world frame), `lat,lon[,height]` (degrees, metres), or either as a JSON object. Checks ranges.
    fn from_str(text: &str) -> Result<Self, NotAPosition> {
        let refuse = || NotAPosition { found: text.trim().chars().take(80).collect() };
        if text.len() > MAX_TEXT_BYTES {
            return Err(refuse());
        }
        let text = text.trim();
        let spoken = if text.starts_with('{') {
            serde_json::from_str(text).map_err(|_| refuse())?
        } else {
            let is_geographic = text.contains(',');
            let parts: Vec<&str> = match is_geographic {
                true => text.split(',').collect(),
                false => text.split_whitespace().collect(),
            };
            let numbers: Option<Vec<f64>> = parts.iter().map(|part| part.trim().parse().ok()).collect();
            match (is_geographic, numbers.as_deref()) {
                (false, Some([x, y, z])) => Spoken::World { x: *x, y: *y, z: *z },
                (true, Some([lat, lon])) => Spoken::Geographic { lat: *lat, lon: *lon, height: None },
                (true, Some([lat, lon, height])) => {
                    Spoken::Geographic { lat: *lat, lon: *lon, height: Some(*height) }
                }
                _ => return Err(refuse()),
            }
        };
        let position = match spoken {
            Spoken::World { x, y, z } => Self::World(DVec3::new(x, y, z)),
            Spoken::Geographic { lat, lon, height } => {
                Self::Geographic { latitude_deg: lat, longitude_deg: lon, height_m: height }
            }
        };
        position.check().map(|()| position).map_err(|_| refuse())
    }
}

impl Position {
    /// Converts the position to the world frame.
    ///
    /// A geographic position without a height gets that of the nearest cell's centre, by horizontal distance to its
    /// box, then to its centre, then by id, so it gets the cells around it wherever the scene's zero height lies.
    pub fn in_world(self, manifest: &Manifest) -> Result<DVec3, PlanError> {
        self.check()?;
        match self {
            Self::World(position) => Ok(position),
            Self::Geographic { latitude_deg, longitude_deg, height_m } => {
                let Some(geo) = manifest.geo_reference else {
                    let (scene, advice) = (&manifest.scene, "--at X,Y,Z, or `x y z` on a line");
                    let what = format!("scene {scene:?} has no geo-reference");
                    return Err(PlanError(format!("{what}; give the position in its world frame: {advice}")));
                };
                let at = |height_m| {
                    geo.world_from_geographic(Geographic { latitude_deg, longitude_deg, height_m })
                };
                let at_origin_height = at(geo.origin.height_m);
                Ok(match height_m {
                    Some(height_m) => at(height_m),
                    None => at_origin_height.with_z(scene_height(manifest, at_origin_height)),
                })
            }
        }
    }

    fn check(&self) -> Result<(), PlanError> {
        let world = |name, value| (name, value, MAX_COORDINATE, "within ±1e9");
        let numbers = match *self {
            Self::World(DVec3 { x, y, z }) => [world("x", x), world("y", y), world("z", z)],
            Self::Geographic { latitude_deg, longitude_deg, height_m } => [
                ("latitude", latitude_deg, 90.0, "within -90..90 degrees"),
                ("longitude", longitude_deg, 180.0, "within -180..180 degrees"),
                ("height", height_m.unwrap_or(0.0), MAX_COORDINATE, "within ±1e9 metres"),
            ],
        };
        let is_out = |value: f64, limit: f64| value.is_nan() || value.abs() > limit;
        match numbers.into_iter().find(|(_, value, limit, _)| is_out(*value, *limit)) {
            Some((name, value, _, expected)) => Err(PlanError::number(name, value, expected)),
            None => Ok(()),
        }
    }
}

/// Returns the z of the centre of the horizontally nearest cell, or of the point if there is no cell.
fn scene_height(manifest: &Manifest, point: DVec3) -> f64 {
    let rank = |bounds: &Aabb| {
        let flat = Aabb { min: bounds.min.with_z(0.0), max: bounds.max.with_z(0.0) };
        let to_centre = DVec2::new(point.x, point.y).distance(flat.centre().truncate());
        (flat.distance_to(point.with_z(0.0)), to_centre)
    };
    let nearest = manifest.cells.iter().map(|cell| &cell.bounds).min_by(|a, b| {
        let ((a_box, a_centre), (b_box, b_centre)) = (rank(a), rank(b));
        a_box.total_cmp(&b_box).then(a_centre.total_cmp(&b_centre))
    });
    nearest.map_or(point.z, |bounds| bounds.centre().z)
}

/// Why a request cannot be met: what was found, what was expected, and what to do.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct PlanError(pub(super) String);

impl PlanError {
    pub(super) fn number(name: &str, value: f64, expected: &str) -> Self {
        Self(format!("{name} is {value}, expected {expected}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn positions_are_read_in_every_form_or_refused() {
        let world = Position::World(DVec3::new(1.0, -2.5, 30.0));
        for text in ["1 -2.5 3e1", "  1\t-2.5 30\n", r#"{"x":1,"y":-2.5,"z":30}"#] {
            assert_eq!(text.parse(), Ok(world), "{text}");
        }
        let earth = |height_m| Position::Geographic { latitude_deg: 46.8, longitude_deg: -92.0, height_m };
        assert_eq!("46.8,-92".parse(), Ok(earth(None)));
        assert_eq!("46.8, -92, 150".parse(), Ok(earth(Some(150.0))));
        assert_eq!(r#"{"lat":46.8,"lon":-92.0}"#.parse(), Ok(earth(None)));
        assert_eq!(r#"{"lat":46.8,"lon":-92,"height":150}"#.parse(), Ok(earth(Some(150.0))));
        let long = format!("{} 1 1", "1".repeat(300));
        let bad = r#"; 1 2; 1 2 3 4; 1 2 x; NaN 0 0; inf 0 0; 91,0; 0,181; 0,0,NaN; 1,2,3,4; ,; {}; {"x":1,"y":2};
            {"x":1,"y":2,"z":3,"w":4}; {"lat":91,"lon":0}; 46.8,-92,1e10; {"lat":46.8,"lon":-92,"height":1e300}; {"x":"#;
        for bad in bad.split(';').chain([&*long]) {
            assert!(bad.parse::<Position>().is_err(), "{bad}");
        }
        assert!(long.parse::<Position>().expect_err("too long").found.len() <= 80);
    }
}
