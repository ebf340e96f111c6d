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

use std::path::{Path, PathBuf};

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

/// The error for a folder that is no unpacked SOG, with the splat that a training run left in it.
fn no_splat(folder: &Path) -> SplatError {
    let entries = |folder: &Path| {
        let entries = fs_err::read_dir(folder).into_iter().flatten().flatten();
        entries.map(|entry| entry.path()).collect::<Vec<_>>()
    };
    let is_splat = |path: &PathBuf| path.is_file() && path.extension().is_some_and(|e| e == "ply");
    // 3DGS writes point_cloud/iteration_N/point_cloud.ply, gsplat ply/NAME.ply; the longest training is the largest N.
    let beside = entries(folder).into_iter().chain(entries(&folder.join("ply")));
    let trained = entries(&folder.join("point_cloud")).into_iter().map(|run| run.join("point_cloud.ply"));
    let number = |path: &PathBuf| {
        let digits: String = path.to_string_lossy().chars().filter(char::is_ascii_digit).collect();
        (digits.len(), digits)
    };
    let advice = match beside.chain(trained).filter(is_splat).max_by_key(number) {
        Some(found) => format!("give {}", found.display()),
        None => "give the splat's file".to_owned(),
    };
    SplatError::at(folder, "folder", format_args!("it is no unpacked SOG, which has a meta.json; {advice}"))
}

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
        let meta = path.join("meta.json");
        return if meta.is_file() { sog::read_folder(&meta, *options) } else { Err(no_splat(path)) };
    }
    let mut input = Input::open(path)?;
    if let Some(stranger) = files::stand_in(input.peek(64)?) {
        return Err(SplatError::at(path, "byte 0", stranger));
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
