//! Splat files: every format is decoded into [`Gaussians`] in the frame of the PLY.
//!
//! | format | recognised by | module |
//! |---|---|---|
//! | PLY (3DGS, gsplat, nerfstudio, brush), binary or ASCII | `ply` | [`ply`] |
//! | compressed PLY (PlayCanvas) | `ply` with packed properties | [`ply`] |
//! | SPZ 2 and 3 (gzip), 4 (Zstandard) | `1f 8b 08`, `NGSP` | `spz` |
//! | SOG 1 and 2, bundle or folder with `meta.json` | `PK`, `.json`, a folder | `sog` |
//! | .splat (antimatter15), 32 bytes a Gaussian | `.splat` | `dot_splat` |
//!
//! A file is read front to back into the columns, so memory is the decoded size plus one buffer (SOG: one or two
//! images). Counts in a file are compared with its length before memory is reserved.

use std::path::Path;

use crate::{Gaussians, files};

mod columns;
mod dot_splat;
mod error;
mod input;
pub mod ply;
mod sog;
mod spz;
mod values;

pub use columns::ReadOptions;
pub use error::SplatError;
use input::Input;

/// Reads a splat file of any supported format.
///
/// For SOG, `path` is the bundle, its unpacked folder, or the `meta.json` in that folder.
///
/// Rows that cannot be drawn are kept, so indices stay those of the file; see [`Gaussians::is_usable`].
///
/// # Errors
/// [`SplatError`], with the file, the place of the fault, and the remedy.
pub fn read(path: &Path, options: &ReadOptions) -> Result<Gaussians, SplatError> {
    if files::metadata(path)?.is_dir() {
        return sog::read_folder(&path.join("meta.json"), *options);
    }
    let mut input = Input::open(path)?;
    if let Some((format, advice)) = files::stand_in(input.peek(64)?) {
        return Err(SplatError::unsupported(path, format, advice));
    }
    let start = input.peek(4)?.to_vec();
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
    match (start.as_slice(), extension.as_str()) {
        ([b'p', b'l', b'y', b'\n' | b'\r'], _) => ply::read(input, *options),
        ([0x1f, 0x8b, 0x08, _], _) | (b"NGSP", _) => spz::read(input, *options),
        (b"PK\x03\x04", _) => sog::read_bundle(path, *options),
        (_, "splat") => dot_splat::read(input),
        (_, "json") | ([b'{', ..], _) => sog::read_folder(path, *options),
        (_, "ksplat") => Err(SplatError::unsupported(
            path,
            ".ksplat",
            "convert it with `splat-transform FILE.ksplat FILE.ply` (npm @playcanvas/splat-transform)",
        )),
        _ => {
            let fault = format!("expected a PLY, SPZ, SOG or .splat file, found bytes {start:02x?}");
            let advice = "give a Gaussian splat in one of these formats, or convert it to PLY";
            Err(SplatError::at(path, "byte 0", format_args!("{fault}; {advice}")))
        }
    }
}
