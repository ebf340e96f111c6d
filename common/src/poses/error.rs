//! Errors of the pose readers, and the places they name.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

/// Why poses could not be read.
#[derive(Debug, thiserror::Error)]
pub enum PoseError {
    /// A file cannot be read. The message quotes the error, path included, so it is not a `source` as well.
    #[error("{0}; check that the file exists and is readable")]
    Io(io::Error),
    /// There is no pose file at the path.
    #[error(
        "{}: no poses found: it has no cameras and images (.bin or .txt), directly or in sparse/0 or sparse, no \
         transforms.json and no pose/; give the folder of a COLMAP model, a transforms.json or a ScanNet scene",
        path.display()
    )]
    NotFound {
        /// The path that was given.
        path: PathBuf,
    },
    /// The content of a file is invalid.
    #[error("{}: {place}: {problem}", path.display())]
    Invalid {
        /// The file.
        path: PathBuf,
        /// The place in the file.
        place: Place,
        /// The fault.
        problem: PoseProblem,
    },
    /// A JSON file does not have the structure of a `transforms.json`.
    #[error("{}: {cause}; export the file again with nerfstudio", path.display())]
    Json {
        /// The file.
        path: PathBuf,
        /// Line, column and reason. The message quotes them, so this is not a `source` as well.
        cause: serde_json::Error,
    },
    /// A JSON file does not have the structure of a `dataparser_transforms.json`.
    #[error("{}: {cause}; expected nerfstudio's transform (3 x 4) and scale; remove the file, or name another with \
             --splat-frame", path.display())]
    Frame {
        /// The file.
        path: PathBuf,
        /// Line, column and reason. The message quotes them, so this is not a `source` as well.
        cause: serde_json::Error,
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

/// The fault of a pose file.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PoseProblem {
    /// A value has the wrong type or is out of range.
    #[error("expected {expected}, found {found:?}; export the poses again")]
    Expected {
        /// The value expected.
        expected: &'static str,
        /// The value found.
        found: String,
    },
    /// The file ends within a record.
    #[error("the file ends before {expected}; copy or export it again")]
    Truncated {
        /// The value expected.
        expected: &'static str,
    },
    /// A lens model of COLMAP that is not supported.
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
        "image {image:?} uses camera {camera_id}, which is not in the cameras file; export both files together"
    )]
    UnknownCamera {
        /// The image.
        image: String,
        /// The camera it names.
        camera_id: u32,
    },
    /// A matrix or quaternion is not a rotation.
    #[error(
        "{image:?}: not a rotation (off by {deviation:.3e}); export the poses again, without scale or shear"
    )]
    NotARotation {
        /// The image.
        image: String,
        /// Largest deviation from unit length or orthonormality.
        deviation: f64,
    },
    /// An intrinsic is out of range.
    #[error("{field} is {value}, expected {expected}; export the poses again")]
    BadIntrinsics {
        /// The quantity.
        field: &'static str,
        /// Its value.
        value: f64,
        /// Its valid range.
        expected: &'static str,
    },
    /// Intrinsics are missing.
    #[error(
        "image {image:?}: {field} is missing, both in the frame and at the top of the file; add it to one of them"
    )]
    MissingIntrinsics {
        /// The image.
        image: String,
        /// The missing key.
        field: &'static str,
    },
    /// Two images have the same name.
    #[error("two images have the name {image:?}; remove or rename one of them")]
    DuplicateImage {
        /// The image.
        image: String,
    },
    /// Two cameras have the same id.
    #[error("two cameras have the id {camera_id}; remove one of them")]
    DuplicateCamera {
        /// The camera.
        camera_id: u32,
    },
    /// The principal point lies far from the middle of the image.
    #[error(
        "the principal point ({}, {}) px is far from the middle of images of {} x {} px; the intrinsics belong to \
         another image size: export the images in the size of the intrinsics",
        centre_px[0], centre_px[1], size_px[0], size_px[1]
    )]
    OtherImageSize {
        /// The principal point.
        centre_px: [f64; 2],
        /// Width and height of the images.
        size_px: [u32; 2],
    },
    /// The size of the images is stated nowhere.
    #[error(
        "no image of the {n_poses} posed frames can be read in {}, and their size is stated nowhere else; \
         give their folder with --images", folder.display()
    )]
    NoImageSize {
        /// Frames with a pose.
        n_poses: usize,
        /// The folder of the images.
        folder: PathBuf,
    },
    /// A file is larger than its content can be.
    #[error("the file has {bytes} bytes, at most {most} were expected; check that it is {expected}")]
    TooLarge {
        /// Its size.
        bytes: u64,
        /// The largest size accepted.
        most: u64,
        /// What the file should be.
        expected: &'static str,
    },
    /// An image name is empty or leads out of the image folder.
    #[error("image name {image:?} is not a relative path inside the image folder; correct it")]
    UnsafeName {
        /// The name.
        image: String,
    },
    /// The file has no views.
    #[error("the file has no posed images; check that the reconstruction succeeded")]
    NoViews,
}

impl From<io::Error> for PoseError {
    fn from(cause: io::Error) -> Self {
        Self::Io(cause)
    }
}

impl PoseProblem {
    pub(super) fn at(self, path: &Path, place: Place) -> PoseError {
        PoseError::Invalid { path: path.to_owned(), place, problem: self }
    }
}
