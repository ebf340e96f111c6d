//! The frame of the splat against that of the poses: which file says so.

use std::collections::BTreeMap;
use std::fmt;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde::de::IgnoredAny;
use slag_common::frames::{GeoReference, Geographic};
use slag_common::poses::{AppliedTransform, FRAME_FILE, PoseError, PoseSource, SplatFrame, SplatFromPoses};
use slag_common::{Gaussians, Similarity, files};

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum FrameChoice {
    /// By `dataparser_transforms.json` beside the splat, if there is one.
    #[default]
    Auto,
    /// Nowhere: splat and poses have one frame.
    None,
    File(PathBuf),
}

/// What a splat file has in place of logarithms of scales and logits of opacities.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Activated {
    pub scales: bool,
    pub opacities: bool,
}

impl Activated {
    /// Restores the file's values in a splat that was decoded as usual.
    pub(crate) fn undo(self, scene: &mut Gaussians) {
        if self != Self::default() {
            scene.deactivate(self.scales, self.opacities);
        }
    }
}

#[derive(Clone, Debug, PartialEq)]
pub struct FoundFrame {
    pub path: PathBuf,
    pub stated: SplatFromPoses,
}

/// Finds the file with the frame of the splat at `scene`; `source` and `applied` are those of the poses.
pub(crate) fn find_frame(
    scene: &Path,
    choice: &FrameChoice,
    source: PoseSource,
    applied: Option<AppliedTransform>,
) -> Result<Option<FoundFrame>, PoseError> {
    let path = match choice {
        FrameChoice::None => return Ok(None),
        FrameChoice::File(path) => path.clone(),
        FrameChoice::Auto => {
            let beside = scene.with_file_name(FRAME_FILE);
            if !beside.is_file() {
                return Ok(None);
            }
            beside
        }
    };
    let stated = SplatFrame::read(&path)?.splat_from_poses(source, applied);
    Ok(Some(FoundFrame { path, stated }))
}

impl FoundFrame {
    pub fn splat_from_poses(&self) -> Similarity {
        self.stated.similarity
    }
}

/// Moves the splat at `path` into the poses' world if a file states its frame, and then drops harmonics above degree 0.
/// `source` and `applied` are those of the poses.
pub fn to_poses(
    scene: &mut Gaussians,
    path: &Path,
    choice: &FrameChoice,
    source: PoseSource,
    applied: Option<AppliedTransform>,
) -> Result<(), PoseError> {
    if let Some(frame) = find_frame(path, choice, source, applied)? {
        tracing::info!("{frame}; the splat is brought into the world of the poses");
        frame.stated.similarity.inverse().transform_gaussians(scene);
    }
    Ok(())
}

impl fmt::Display for FoundFrame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let SplatFromPoses { similarity, begins_at } = self.stated;
        write!(
            f,
            "{}: the splat's world is that of the poses times {:.6}, rotated by {:.2} degrees and moved; the transform \
             begins at {begins_at}",
            self.path.display(),
            similarity.scale,
            similarity.rotation.angle_between(Similarity::IDENTITY.rotation).to_degrees(),
        )
    }
}

#[derive(Debug, thiserror::Error)]
pub enum GeoError {
    #[error("{0}; check that the file exists and may be read")]
    Io(#[from] io::Error),
    #[error("{}: {problem}", path.display())]
    File { path: PathBuf, problem: String },
}

// A list may have GeoJSON's order.
slag_common::named_members!(GeoFile, Origin);

#[derive(Deserialize)]
#[serde(remote = "Self")]
struct GeoFile {
    origin: Origin,
    #[serde(flatten)]
    other: BTreeMap<String, IgnoredAny>,
}

#[derive(Deserialize)]
#[serde(remote = "Self")]
struct Origin {
    lat: f64,
    lon: f64,
    alt: f64,
    #[serde(flatten)]
    other: BTreeMap<String, IgnoredAny>,
}

const MAX_BYTES: u64 = 1 << 20;

/// Reads `{"origin": {"lat": degrees, "lon": degrees, "alt": metres}}`; warns of other members.
pub fn read_geo_reference(path: &Path) -> Result<GeoReference, GeoError> {
    let mut bytes = Vec::new();
    files::open(path)?.take(MAX_BYTES).read_to_end(&mut bytes)?;
    let wrong = |problem: String| GeoError::File { path: path.to_owned(), problem };
    let text = files::text_of(&bytes).map_err(|error| wrong(error.to_string()))?;
    let expected = r#"expected {"origin": {"lat": DEGREES, "lon": DEGREES, "alt": METRES}}"#;
    let malformed = |error: serde_json::Error| wrong(format!("{error}; {expected}"));
    let GeoFile { origin, other } = serde_json::from_str(text).map_err(malformed)?;
    if let Some(name) = other.keys().chain(origin.other.keys()).next() {
        tracing::warn!(
            "{}: member {name:?} is not read; x is east, y north, z up, in metres",
            path.display()
        );
    }
    let range = |field: &'static str, value: f64, min: f64, max: f64| match (min..=max).contains(&value) {
        true => Ok(value),
        false => Err(wrong(format!(
            "origin.{field} = {value} is outside {min}..={max}; write degrees and metres of WGS 84"
        ))),
    };
    // Heights range from the deepest trench to the edge of space.
    let latitude_deg = range("lat", origin.lat, -90.0, 90.0)?;
    let longitude_deg = range("lon", origin.lon, -180.0, 180.0)?;
    let origin =
        Geographic { latitude_deg, longitude_deg, height_m: range("alt", origin.alt, -12e3, 100e3)? };
    Ok(GeoReference { origin })
}
