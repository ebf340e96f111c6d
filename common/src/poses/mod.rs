//! Posed views from a COLMAP model, a nerfstudio `transforms.json` or a ScanNet scene folder.
//!
//! All give [`View`](crate::View)s in OpenCV camera axes; the world frame stays the file's own.

mod checks;
mod colmap;
mod error;
mod every;
mod paths;
mod scannet;
mod splat_frame;
mod transforms;
mod view_set;

use std::path::Path;

pub use error::PoseError;
pub use splat_frame::{FRAME_FILE, Origin, SplatFrame, SplatFromPoses};
pub use view_set::{AppliedTransform, PoseSource, ViewSet};

use crate::files;

/// Reads the posed views at `path`.
///
/// `path` is the folder of a COLMAP model (or one of its files, or a folder with `sparse/0`, `0` or `sparse`; of
/// several numbered models the one with the most images), a nerfstudio `transforms.json` (or its folder), or a scene
/// folder as exported by ScanNet's SensReader (`color/`, `pose/`, `intrinsic/`). COLMAP takes precedence over
/// `transforms.json`, that over ScanNet, and binary over text, which is rounded.
///
/// `images_dir`: by default `images/` beside COLMAP's `sparse/` (or beside or in the model's folder), the paths in a
/// `transforms.json`, or ScanNet's `color/`. Images need not exist, except ScanNet's: only they tell their size.
pub fn read(path: &Path, images_dir: Option<&Path>) -> Result<ViewSet, PoseError> {
    let about = files::metadata(path)?;
    let json = path.join("transforms.json");
    let not_found = || {
        if !about.is_dir() && !about.is_file() {
            return Err(PoseError::of(path, "it is neither a file nor a folder; copy the poses into one"));
        }
        if json.symlink_metadata().is_ok() {
            return Err(PoseError::of(
                &json,
                "it is a folder, a pipe or a link to nothing; put a file there",
            ));
        }
        let train = path.join("transforms_train.json");
        let advice = match train.is_file() {
            true => format!("give {}", train.display()),
            false => "give the folder of a COLMAP model, a transforms.json or a ScanNet scene".to_owned(),
        };
        let fault = "no poses found: it has no cameras and images (.bin or .txt), directly or in sparse/0 or sparse, no \
                     transforms.json and no pose/";
        Err(PoseError::of(path, format_args!("{fault}; {advice}")))
    };
    if about.is_file() {
        return match path.extension().and_then(|e| e.to_str()) {
            Some("json") => transforms::read(path, images_dir),
            Some("bin") => colmap::read(paths::parent(path)?.as_path(), PoseSource::ColmapBinary, images_dir),
            Some("txt") => colmap::read(paths::parent(path)?.as_path(), PoseSource::ColmapText, images_dir),
            _ => not_found(),
        };
    }
    let other = |read: &Path, not: &Path| {
        format!("read {}; {} is ignored: name it to read it", read.display(), not.display())
    };
    let numbered = colmap::largest_model;
    let model_dirs =
        [Some(path.to_owned()), numbered(&path.join("sparse")), numbered(path), Some(path.join("sparse"))];
    for model_dir in model_dirs.into_iter().flatten() {
        for (source, extension) in [(PoseSource::ColmapBinary, "bin"), (PoseSource::ColmapText, "txt")] {
            let has = |stem: &str| model_dir.join(stem).with_extension(extension).is_file();
            if has("cameras") && has("images") {
                let mut set = colmap::read(&model_dir, source, images_dir)?;
                set.notes.extend(json.is_file().then(|| other(&model_dir, &json)));
                return Ok(set);
            }
        }
    }
    if json.is_file() {
        let mut set = transforms::read(&json, images_dir)?;
        let model = path.join("colmap/sparse/0");
        set.notes.extend(model.is_dir().then(|| other(&json, &model)));
        Ok(set)
    } else if path.join(scannet::POSES).is_dir() {
        scannet::read(path, images_dir)
    } else {
        not_found()
    }
}
