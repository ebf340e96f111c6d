//! Request and reply of `where_am_i`.

use base64::engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig};
use base64::{Engine, alphabet};
use rmcp::schemars::{self, JsonSchema};
use serde::{Deserialize, Serialize};
use slag_robot::api::locate::{self, Answer};
use slag_robot::{Robot, xyz};

/// Longest photo, characters in base64: a file of 6 MB.
pub const MAX_PHOTO_CHARS: usize = 8_000_000;
/// Longest message over HTTP. The tool reports photos beyond their own limit.
pub const MAX_MESSAGE_BYTES: usize = 2 * MAX_PHOTO_CHARS;
/// With or without padding.
const BASE64: GeneralPurpose = GeneralPurpose::new(
    &alphabet::STANDARD,
    GeneralPurposeConfig::new().with_decode_padding_mode(DecodePaddingMode::Indifferent),
);

/// A photo, and what is known about its camera.
#[derive(Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Seen {
    /// A JPEG, PNG or WebP file in base64.
    #[schemars(length(min = 1, max = MAX_PHOTO_CHARS))]
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
        let photo = decoded(&self.photo_base64)?;
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

/// Decodes base64, also as a `data:` URL, in lines, or in the URL alphabet.
fn decoded(text: &str) -> Result<Vec<u8>, String> {
    if text.len() > MAX_PHOTO_CHARS {
        return Err(format!(
            "photo_base64: longer than {MAX_PHOTO_CHARS} characters, the limit; give a smaller photo"
        ));
    }
    let of_url = text.trim_start().strip_prefix("data:").and_then(|url| url.split_once(','));
    let data = of_url.map_or(text, |(_, data)| data);
    let standard = |byte| match byte {
        b'-' => b'+',
        b'_' => b'/',
        byte => byte,
    };
    let data: Vec<u8> = data.bytes().filter(|byte| !byte.is_ascii_whitespace()).map(standard).collect();
    let photo = BASE64.decode(data);
    photo.map_err(|error| format!("photo_base64: {error}; give a JPEG, PNG or WebP file in base64"))
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_comes_in_many_forms() {
        let file = [0xFB, 0xEF, 0xBE, 0xFF, 7];
        for text in [
            "++++/wc=",
            "++++/wc",
            "----_wc=",
            "++++\r\n/wc=\n",
            "data:image/png;base64,++++/wc=",
            " data:;base64,----_wc",
        ] {
            assert_eq!(decoded(text).expect(text), file, "{text}");
        }
        for (text, expected) in [("no base64!", "give a JPEG"), ("++++/w=c", "give a JPEG")] {
            let error = decoded(text).expect_err(text);
            assert!(error.contains(expected), "{error}");
        }
        assert!(decoded(&"A".repeat(MAX_PHOTO_CHARS)).is_ok());
        let error = decoded(&"A".repeat(MAX_PHOTO_CHARS + 1)).expect_err("too long");
        assert!(error.contains("8000000 characters"), "{error}");
    }
}
