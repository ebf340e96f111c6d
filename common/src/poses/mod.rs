//! Posed views from a COLMAP model or a nerfstudio `transforms.json`.
//!
//! Both end as [`View`]s in OpenCV camera axes; the world frame stays the file's own.

mod colmap;
mod transforms;

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use glam::{DAffine3, DMat3, DQuat, DVec3};

use crate::camera::{Distortion, Intrinsics, View};

/// The largest image side accepted, pixels: the largest JPEG, and pixel indices fit 32 bits.
const MAX_SIDE_PX: u32 = 65_535;

/// The largest deviation of a rotation from unit length or orthonormality that counts as rounding
/// (a printout with 3 decimals stays below it).
const ROTATION_TOLERANCE: f64 = 5e-3;

/// The views of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewSet {
    /// Sorted by name; names are unique.
    pub views: Vec<View>,
    /// What they were read from.
    pub source: PoseSource,
}

/// The format that poses were read from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PoseSource {
    /// COLMAP `cameras.txt` and `images.txt`.
    ColmapText,
    /// COLMAP `cameras.bin` and `images.bin`.
    ColmapBinary,
    /// Nerfstudio `transforms.json`.
    Transforms,
}

/// Why poses could not be read.
#[derive(Debug, thiserror::Error)]
pub enum PoseError {
    /// A file could not be read; the message has its path.
    #[error("{0}; check that the file exists and may be read")]
    Io(#[from] io::Error),
    /// There is no pose file at the path.
    #[error(
        "{}: no poses here: looked for cameras and images (.bin or .txt) in it, in sparse/0 and in sparse, \
         and for transforms.json; give the folder of a COLMAP model or a transforms.json",
        path.display()
    )]
    NotFound {
        /// The path that was given.
        path: PathBuf,
    },
    /// A file says something that it must not say.
    #[error("{}: {place}: {problem}", path.display())]
    Invalid {
        /// The file.
        path: PathBuf,
        /// Where in the file.
        place: Place,
        /// What is wrong there.
        problem: PoseProblem,
    },
    /// A JSON file is not what nerfstudio writes.
    #[error("{}: {source}; write the file again", path.display())]
    Json {
        /// The file.
        path: PathBuf,
        /// Line, column and reason.
        #[source]
        source: serde_json::Error,
    },
}

/// A place in a pose file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// The whole file.
    File,
    /// A line, counted from 1.
    Line(u64),
    /// A byte offset.
    Byte(u64),
    /// An element of the array `frames`, counted from 0.
    Frame(usize),
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File => write!(f, "file"),
            Self::Line(line) => write!(f, "line {line}"),
            Self::Byte(offset) => write!(f, "byte {offset}"),
            Self::Frame(index) => write!(f, "frames[{index}]"),
        }
    }
}

/// What is wrong with a pose file.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PoseProblem {
    /// A value is of another kind or out of range.
    #[error("expected {expected}, found {found:?}; export the poses again")]
    Expected {
        /// What belongs there.
        expected: &'static str,
        /// What is there.
        found: String,
    },
    /// The file ends within a record.
    #[error("the file ends where {expected} should be; copy or export it again")]
    Truncated {
        /// What belongs there.
        expected: &'static str,
    },
    /// A lens model that is not supported.
    #[error(
        "camera {camera_id}: model {model} is not supported; run COLMAP's image_undistorter and use its output"
    )]
    UnsupportedModel {
        /// The camera.
        camera_id: u32,
        /// The model's name, or its number in a binary file.
        model: String,
    },
    /// A lens model of a transforms.json that is not supported.
    #[error("lens model {model} is not supported; undistort the images or export with OPENCV")]
    UnsupportedLens {
        /// The model's name.
        model: String,
    },
    /// An image names a camera that is not there.
    #[error(
        "image {image:?} has camera {camera_id}, which the cameras file lacks; export both files together"
    )]
    UnknownCamera {
        /// The image.
        image: String,
        /// The camera it names.
        camera_id: u32,
    },
    /// A rotation is none.
    #[error(
        "image {image:?}: not a rotation (off by {deviation:.3e}); export the poses again, without scale or shear"
    )]
    NotARotation {
        /// The image.
        image: String,
        /// Largest deviation from unit length or orthonormality.
        deviation: f64,
    },
    /// A camera cannot exist.
    #[error("{field} = {value} is no camera's; expected {expected}; export the poses again")]
    BadIntrinsics {
        /// The quantity.
        field: &'static str,
        /// Its value.
        value: f64,
        /// Its valid range.
        expected: &'static str,
    },
    /// Intrinsics are missing.
    #[error("image {image:?}: {field} is missing, for this frame and for the file; add it")]
    MissingIntrinsics {
        /// The image.
        image: String,
        /// The missing key.
        field: &'static str,
    },
    /// Two images have one name.
    #[error("image {image:?} occurs twice; keep one of them")]
    DuplicateImage {
        /// The image.
        image: String,
    },
    /// Two cameras have one id.
    #[error("camera {camera_id} occurs twice; keep one of them")]
    DuplicateCamera {
        /// The camera.
        camera_id: u32,
    },
    /// An image's name is empty or leaves the image folder.
    #[error("image name {image:?} is not a path inside the image folder; rename it")]
    UnsafeName {
        /// The name.
        image: String,
    },
    /// There is no view.
    #[error("no posed image in the file; check that the reconstruction succeeded")]
    NoViews,
}

impl PoseProblem {
    fn at(self, path: &Path, place: Place) -> PoseError {
        PoseError::Invalid { path: path.to_owned(), place, problem: self }
    }
}

/// Reads the posed views at `path`.
///
/// `path` is a COLMAP model folder (or one of its files, or a folder that holds `sparse/0` or
/// `sparse`), or a nerfstudio `transforms.json` (or the folder that holds it). Where several are
/// there, COLMAP goes before `transforms.json`, and binary before text, which is rounded.
///
/// `images_dir` is where the images lie; by default it is `images/` beside COLMAP's `sparse/` (or
/// next to the model), and the place that a `transforms.json` itself names. Images need not exist.
///
/// # Errors
/// [`PoseError`] names file and place of whatever is missing, damaged or not supported.
pub fn read(path: &Path, images_dir: Option<&Path>) -> Result<ViewSet, PoseError> {
    if fs_err::metadata(path)?.is_file() {
        return match path.extension().and_then(|e| e.to_str()) {
            Some("json") => transforms::read(path, images_dir),
            Some("bin") => colmap::read(parent(path)?.as_path(), PoseSource::ColmapBinary, images_dir),
            Some("txt") => colmap::read(parent(path)?.as_path(), PoseSource::ColmapText, images_dir),
            _ => Err(PoseError::NotFound { path: path.to_owned() }),
        };
    }
    for model_dir in [path.to_owned(), path.join("sparse/0"), path.join("sparse")] {
        for (source, extension) in [(PoseSource::ColmapBinary, "bin"), (PoseSource::ColmapText, "txt")] {
            let has = |stem: &str| model_dir.join(stem).with_extension(extension).is_file();
            if has("cameras") && has("images") {
                return colmap::read(&model_dir, source, images_dir);
            }
        }
    }
    let json = path.join("transforms.json");
    if json.is_file() {
        transforms::read(&json, images_dir)
    } else {
        Err(PoseError::NotFound { path: path.to_owned() })
    }
}

/// Returns the folder that holds `path`, also where the path as given does not name it.
fn parent(path: &Path) -> io::Result<PathBuf> {
    match path.parent() {
        Some(parent) if path.file_name().is_some() && parent != Path::new("") => Ok(parent.to_owned()),
        _ => Ok(fs_err::canonicalize(path)?.parent().map_or_else(|| PathBuf::from("/"), Path::to_owned)),
    }
}

/// Sorts views by name and refuses none at all or two of one name.
fn view_set(path: &Path, mut views: Vec<View>, source: PoseSource) -> Result<ViewSet, PoseError> {
    if views.is_empty() {
        return Err(PoseProblem::NoViews.at(path, Place::File));
    }
    views.sort_by(|a, b| a.name.cmp(&b.name));
    if let Some(pair) = views.windows(2).find(|pair| pair[0].name == pair[1].name) {
        return Err(PoseProblem::DuplicateImage { image: pair[0].name.clone() }.at(path, Place::File));
    }
    Ok(ViewSet { views, source })
}

/// Checks that a camera can exist: sizes within 1..=65,535, focal lengths positive, all finite.
fn check_intrinsics(
    [width_px, height_px]: [f64; 2],
    [focal_x_px, focal_y_px]: [f64; 2],
    [centre_x_px, centre_y_px]: [f64; 2],
    distortion: Distortion,
) -> Result<Intrinsics, PoseProblem> {
    let side = |field, value: f64| {
        if value.fract() == 0.0 && (1.0..=f64::from(MAX_SIDE_PX)).contains(&value) {
            Ok(value as u32)
        } else {
            Err(PoseProblem::BadIntrinsics { field, value, expected: "a whole number from 1 to 65535" })
        }
    };
    let focal = |field, value: f64| {
        if value.is_finite() && value > 0.0 {
            Ok(value)
        } else {
            Err(PoseProblem::BadIntrinsics { field, value, expected: "a positive number of pixels" })
        }
    };
    let finite = |field, value: f64| {
        if value.is_finite() {
            Ok(value)
        } else {
            Err(PoseProblem::BadIntrinsics { field, value, expected: "a finite number" })
        }
    };
    let coefficients: &[f64] = match &distortion {
        Distortion::None => &[],
        Distortion::Brown { k, p } => &[k[0], k[1], k[2], p[0], p[1]],
        Distortion::Fisheye { k } => k,
    };
    for value in coefficients {
        finite("distortion coefficient", *value)?;
    }
    // All zero is the ideal pinhole; a fisheye without coefficients is still equidistant.
    let distortion = match distortion {
        Distortion::Brown { k: [0.0, 0.0, 0.0], p: [0.0, 0.0] } => Distortion::None,
        other => other,
    };
    Ok(Intrinsics {
        width_px: side("width", width_px)?,
        height_px: side("height", height_px)?,
        focal_x_px: focal("focal length x", focal_x_px)?,
        focal_y_px: focal("focal length y", focal_y_px)?,
        centre_x_px: finite("principal point x", centre_x_px)?,
        centre_y_px: finite("principal point y", centre_y_px)?,
        distortion,
    })
}

/// Returns the transform of a quaternion (w, x, y, z) and a translation, the former normalised.
fn affine_from_wxyz(image: &str, wxyz: [f64; 4], translation: [f64; 3]) -> Result<DAffine3, PoseProblem> {
    let [w, x, y, z] = wxyz;
    let rotation = DQuat::from_xyzw(x, y, z, w);
    let deviation = (rotation.length() - 1.0).abs();
    if deviation.is_nan() || deviation > ROTATION_TOLERANCE {
        return Err(PoseProblem::NotARotation { image: image.to_owned(), deviation });
    }
    let translation = check_translation(translation)?;
    Ok(DAffine3::from_rotation_translation(rotation.normalize(), translation))
}

/// Returns the transform of a rotation matrix, made exactly orthonormal, and a translation.
fn affine_from_matrix(image: &str, rotation: DMat3, translation: [f64; 3]) -> Result<DAffine3, PoseProblem> {
    let gram = rotation.transpose() * rotation - DMat3::IDENTITY;
    let largest =
        gram.to_cols_array().iter().fold(0.0_f64, |m, v| if v.is_nan() { *v } else { m.max(v.abs()) });
    // A reflection is orthonormal as well: its determinant is -1, two away from a rotation's.
    let deviation =
        if largest <= ROTATION_TOLERANCE { (rotation.determinant() - 1.0).abs() } else { largest };
    if deviation.is_nan() || deviation > 2.0 * ROTATION_TOLERANCE {
        return Err(PoseProblem::NotARotation { image: image.to_owned(), deviation });
    }
    let translation = check_translation(translation)?;
    Ok(DAffine3::from_rotation_translation(DQuat::from_mat3(&rotation).normalize(), translation))
}

fn check_translation(translation: [f64; 3]) -> Result<DVec3, PoseProblem> {
    let vector = DVec3::from_array(translation);
    if vector.is_finite() {
        return Ok(vector);
    }
    Err(PoseProblem::Expected { expected: "a finite translation", found: format!("{translation:?}") })
}
