//! Errors of the pose readers, and the places they name.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use crate::files::NotUtf8;

#[derive(Debug, thiserror::Error)]
pub enum PoseError {
    #[error("{0}; check that the file exists and is readable")]
    Io(io::Error),
    #[error(
        "{}: no poses found: it has no cameras and images (.bin or .txt), directly or in sparse/0 or sparse, no \
         transforms.json and no pose/; give the folder of a COLMAP model, a transforms.json or a ScanNet scene",
        path.display()
    )]
    NotFound { path: PathBuf },
    #[error("{}: {place}: {problem}", path.display())]
    Invalid { path: PathBuf, place: Place, problem: PoseProblem },
    #[error("{}: {cause}; export the file again with nerfstudio", path.display())]
    Json { path: PathBuf, cause: serde_json::Error },
    #[error("{}: {cause}; expected nerfstudio's transform (3 x 4) and scale; remove the file, or name another with \
             --splat-frame", path.display())]
    Frame { path: PathBuf, cause: serde_json::Error },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    File,
    /// A line, counted from 1.
    Line(u64),
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

#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PoseProblem {
    #[error("expected {expected}, found {found:?}; export the poses again")]
    Expected { expected: &'static str, found: String },
    #[error("{0}")]
    NotUtf8(NotUtf8),
    #[error("the file ends before {expected}; copy or export it again")]
    Truncated { expected: &'static str },
    #[error("{model} has {expected} parameters, found {found}; export the cameras again")]
    LensParameters { model: String, expected: usize, found: usize },
    #[error("{what}; give the COLMAP model that the splat was trained from, or a transforms.json")]
    OtherKind { what: &'static str },
    #[error(
        "{image:?}: the matrix mirrors (its determinant is -1): the export has left-handed axes; negate one axis of the \
             world, or export with right-handed axes"
    )]
    Mirrored { image: String },
    #[error(
        "camera {camera_id}: model {model} is not supported; run COLMAP's image_undistorter and use its output"
    )]
    UnsupportedModel { camera_id: u32, model: String },
    #[error("lens model {model} is not supported; undistort the images or export with OPENCV")]
    UnsupportedLens { model: String },
    #[error(
        "image {image:?} uses camera {camera_id}, which is not in the cameras file; export both files together"
    )]
    UnknownCamera { image: String, camera_id: u32 },
    #[error(
        "{image:?}: not a rotation (off by {deviation:.3e}); export the poses again, without scale or shear"
    )]
    NotARotation { image: String, deviation: f64 },
    #[error("{field} is {value}, expected {expected}; export the poses again")]
    BadIntrinsics { field: &'static str, value: f64, expected: &'static str },
    #[error(
        "image {image:?}: {field} is missing, both in the frame and at the top of the file; add it to one of them"
    )]
    MissingIntrinsics { image: String, field: &'static str },
    #[error(
        "image {image:?}: its size is unknown: neither the frame nor the top of the file has w and h, and {} cannot be read; \
         add them, or give the photos' folder with --images",
        photo.display()
    )]
    NoSize { image: String, photo: PathBuf },
    #[error("two images have the name {image:?}; remove or rename one of them")]
    DuplicateImage { image: String },
    #[error("two cameras have the id {camera_id}; remove one of them")]
    DuplicateCamera { camera_id: u32 },
    #[error(
        "the principal point ({}, {}) px is far from the middle of images of {} x {} px; the intrinsics belong to \
         another image size: export the images in the size of the intrinsics",
        centre_px[0], centre_px[1], size_px[0], size_px[1]
    )]
    OtherImageSize { centre_px: [f64; 2], size_px: [u32; 2] },
    #[error(
        "no image of the {n_poses} posed frames can be read in {}, and their size is stated nowhere else; \
         give their folder with --images", folder.display()
    )]
    NoImageSize { n_poses: usize, folder: PathBuf },
    #[error("the file has {bytes} bytes, at most {most} were expected; check that it is {expected}")]
    TooLarge { bytes: u64, most: u64, expected: &'static str },
    #[error("image name {image:?} is not a relative path inside the image folder; correct it")]
    UnsafeName { image: String },
    #[error("the file has no posed images; check that the reconstruction succeeded")]
    NoViews,
}

impl From<io::Error> for PoseError {
    fn from(cause: io::Error) -> Self {
        Self::Io(cause)
    }
}

impl PoseProblem {
    /// Returns the problem of a pose, for a sentence that names its frame.
    pub(super) fn of_pose(&self) -> String {
        match self {
            Self::NotARotation { deviation, .. } => format!("its rotation is off by {deviation:.3e}"),
            Self::Mirrored { .. } => "its matrix mirrors".to_owned(),
            Self::Expected { expected, found } => format!("expected {expected}, found {found:?}"),
            Self::NoSize { photo, .. } => {
                format!("the file does not state its size, and the photo {} cannot be read", photo.display())
            }
            other => other.to_string(),
        }
    }

    pub(super) fn at(self, path: &Path, place: Place) -> PoseError {
        PoseError::Invalid { path: path.to_owned(), place, problem: self }
    }
}
