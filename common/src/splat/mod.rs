//! Splat files: every format is read into [`Gaussians`], decoded and in the frame of the PLY.
//!
//! | format | recognised by | module |
//! |---|---|---|
//! | PLY (3DGS, gsplat, nerfstudio, brush), binary or ASCII | `ply` | [`ply`] |
//! | compressed PLY (PlayCanvas) | `ply` with packed properties | `compressed_ply` |
//! | SPZ 2 and 3 (gzip), 4 (Zstandard) | `1f 8b 08`, `NGSP` | `spz` |
//! | SOG 1 and 2, bundle or folder with `meta.json` | `PK`, `.json`, a folder | `sog` |
//! | .splat (antimatter15), 32 bytes a Gaussian | `.splat` | `dot_splat` |
//!
//! A file is read front to back straight into the columns: memory stays at the decoded size plus
//! one buffer (SOG: plus one or two images). No count in a file is believed before it was compared
//! with the bytes that are there.

use std::error::Error;
use std::fmt::{self, Display};
use std::io;
use std::path::{Path, PathBuf};

use crate::Gaussians;

mod compressed_ply;
mod dot_splat;
mod input;
pub mod ply;
mod ply_container;
mod sog;
mod spz;

use input::Input;

/// What to read of a splat file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ReadOptions {
    /// Whether to read the spherical harmonics above degree 0. Without, the result has degree 0 and
    /// the coefficients are never held in memory.
    pub with_sh_rest: bool,
}

impl ReadOptions {
    /// Returns the degree to keep of a file that has `degree`.
    fn kept_degree(self, degree: u8) -> u8 {
        if self.with_sh_rest { degree.min(MAX_SH_DEGREE) } else { 0 }
    }
}

/// The highest degree of spherical harmonics that [`Gaussians`] holds.
const MAX_SH_DEGREE: u8 = 3;

/// Why a splat file could not be read.
#[derive(Debug, thiserror::Error)]
pub enum SplatError {
    /// A file cannot be opened, read or written; the message of `source` names it.
    #[error("{source}; check the path and its permissions")]
    Io {
        /// The failed call.
        #[from]
        source: io::Error,
    },
    /// The content is not what the format prescribes.
    #[error("{}: {place}: expected {expected}, found {found}; {advice}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Where in it.
        place: Place,
        /// What should stand there.
        expected: String,
        /// What stands there.
        found: String,
        /// What to do.
        advice: &'static str,
    },
    /// Compressed content cannot be unpacked.
    #[error("{}: {place}: {what} cannot be unpacked: {source}; copy or export the file again", path.display())]
    Undecodable {
        /// The file.
        path: PathBuf,
        /// Where in it.
        place: Place,
        /// What is compressed.
        what: &'static str,
        /// What the decompressor says.
        source: Box<dyn Error + Send + Sync>,
    },
    /// The format is known, but not read here.
    #[error("{}: {format} is not supported; {advice}", path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// The format or feature.
        format: String,
        /// What to do.
        advice: &'static str,
    },
}

/// A place in a splat file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Place {
    /// An offset in the file, bytes.
    Byte(u64),
    /// An offset in the decompressed content, bytes.
    DecompressedByte(u64),
    /// A line, from 1.
    Line(u64),
    /// A part of a bundle or folder, by name.
    Part(String),
}

impl Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Byte(offset) => write!(f, "byte {offset}"),
            Self::DecompressedByte(offset) => write!(f, "byte {offset} of the decompressed data"),
            Self::Line(line) => write!(f, "line {line}"),
            Self::Part(name) => write!(f, "{name}"),
        }
    }
}

/// Advice where the content contradicts itself or the format.
const COPY_AGAIN: &str = "the file is damaged or cut short: copy or export it again";

impl SplatError {
    /// Returns a [`SplatError::Malformed`] that advises to copy or export the file again.
    fn malformed(path: &Path, place: Place, expected: impl Display, found: impl Display) -> Self {
        Self::Malformed {
            path: path.into(),
            place,
            expected: expected.to_string(),
            found: found.to_string(),
            advice: COPY_AGAIN,
        }
    }

    /// Returns a [`SplatError::Undecodable`].
    fn undecodable(
        path: &Path,
        place: Place,
        what: &'static str,
        source: impl Into<Box<dyn Error + Send + Sync>>,
    ) -> Self {
        Self::Undecodable { path: path.into(), place, what, source: source.into() }
    }
}

/// Reads a splat file of any supported format; for SOG, `path` may be the bundle, its unpacked
/// folder or the `meta.json` in it.
///
/// Rows that cannot be drawn are kept, so that indices stay those of the file; see
/// [`Gaussians::is_usable`].
///
/// # Errors
/// [`SplatError`], naming the file, where it is wrong, and what to do.
pub fn read(path: &Path, options: &ReadOptions) -> Result<Gaussians, SplatError> {
    if fs_err::metadata(path)?.is_dir() {
        return sog::read_folder(&path.join("meta.json"), *options);
    }
    let mut input = Input::open(path)?;
    let start = input.peek(4)?.to_vec();
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
    match (start.as_slice(), extension.as_str()) {
        ([b'p', b'l', b'y', b'\n' | b'\r'], _) => ply::read(input, *options),
        ([0x1f, 0x8b, 0x08, _], _) | (b"NGSP", _) => spz::read(input, *options),
        (b"PK\x03\x04", _) => sog::read_bundle(path, *options),
        (_, "splat") => dot_splat::read(input),
        (_, "json") | ([b'{', ..], _) => sog::read_folder(path, *options),
        (_, "ksplat") => Err(SplatError::Unsupported {
            path: path.into(),
            format: ".ksplat".into(),
            advice: "convert it with `splat-transform FILE.ksplat FILE.ply` (npm @playcanvas/splat-transform)",
        }),
        _ => Err(SplatError::Malformed {
            path: path.into(),
            place: Place::Byte(0),
            expected: "a PLY, SPZ, SOG or .splat file".into(),
            found: format!("bytes {start:02x?}"),
            advice: "pass the Gaussian splat itself, or convert it to PLY",
        }),
    }
}

/// The most a file may grow on decoding, and what it may grow beyond that. Trained scenes take 8
/// bytes a Gaussian or more even as SPZ or SOG (measured: 14 and 25), and decode to 68 bytes, or 248
/// with all harmonics: a ratio of 31 at most. More means that a count is wrong.
const MAX_EXPANSION: u64 = 32;
const EXPANSION_FREE_BYTES: u64 = 32 << 20;

/// Returns `count` if a compressed file of `len_bytes` can plausibly hold so many Gaussians.
fn plausible_count(
    path: &Path,
    place: Place,
    count: u64,
    degree: u8,
    len_bytes: u64,
) -> Result<usize, SplatError> {
    let bytes_each = Gaussians::decoded_bytes(1, degree) as u64;
    let most = len_bytes.saturating_mul(MAX_EXPANSION).saturating_add(EXPANSION_FREE_BYTES) / bytes_each;
    usize::try_from(count).ok().filter(|_| count <= most).ok_or_else(|| {
        let expected = format_args!("at most {most} Gaussians in {len_bytes} bytes");
        SplatError::malformed(path, place, expected, count)
    })
}

/// Returns empty columns with room for `count` Gaussians.
fn columns(count: usize, degree: u8) -> Gaussians {
    Gaussians {
        means_in_world: Vec::with_capacity(count),
        rotations_wxyz: Vec::with_capacity(count),
        scales: Vec::with_capacity(count),
        opacities: Vec::with_capacity(count),
        sh_dc: Vec::with_capacity(count),
        sh_rest: Vec::with_capacity(count * 3 * Gaussians::sh_rest_per_channel(degree)),
        sh_degree: degree,
    }
}

/// Returns the quaternion scaled to unit length; one without length or not finite comes back as zero
/// or NaN, which [`Gaussians::is_usable`] tells.
fn unit_rotation(wxyz: [f64; 4]) -> [f32; 4] {
    let norm = wxyz.iter().map(|q| q * q).sum::<f64>().sqrt();
    if norm == 0.0 { [0.0; 4] } else { wxyz.map(|q| (q / norm) as f32) }
}

/// Returns the opacity of a logit.
fn sigmoid(logit: f64) -> f32 {
    (1.0 / (1.0 + (-logit).exp())) as f32
}

/// Returns the quaternion `wxyz` of which all but the component `largest` are given, in order; that
/// one is positive and follows from unit length.
fn with_largest(largest: usize, others: [f64; 3]) -> [f64; 4] {
    let rest = (1.0 - others.iter().map(|q| q * q).sum::<f64>()).max(0.0).sqrt();
    let mut others = others.into_iter();
    std::array::from_fn(|i| if i == largest { rest } else { others.next().unwrap_or(0.0) })
}

/// Returns the coefficient of degree 0 of a colour, 0..=1: the inverse of [`Gaussians::rgb_dc`].
fn dc_of_colour(colour: f64) -> f32 {
    ((colour - 0.5) / f64::from(crate::gaussians::SH_C0)) as f32
}
