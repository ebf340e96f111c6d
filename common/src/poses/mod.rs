//! Posed views from a COLMAP model or a nerfstudio `transforms.json`.
//!
//! Both give [`View`](crate::View)s in OpenCV camera axes; the world frame stays the file's own.

mod checks;
mod colmap;
mod error;
mod paths;
mod transforms;
mod view_set;

use std::path::Path;

pub use error::{Place, PoseError, PoseProblem};
pub use view_set::{PoseSource, ViewSet};

/// Reads the posed views at `path`.
///
/// `path` is the folder of a COLMAP model (or one of its files, or a folder with `sparse/0` or `sparse`), or a nerfstudio
/// `transforms.json` (or its folder). COLMAP takes precedence over `transforms.json`, and binary over text, which is
/// rounded.
///
/// `images_dir` is the folder of the images. The default is `images/` beside COLMAP's `sparse/` (or beside or in the
/// model's folder), and the paths in a `transforms.json`. Images need not exist.
///
/// # Errors
/// [`PoseError`], with file and place, for data that is missing, damaged or not supported.
pub fn read(path: &Path, images_dir: Option<&Path>) -> Result<ViewSet, PoseError> {
    if fs_err::metadata(path)?.is_file() {
        return match path.extension().and_then(|e| e.to_str()) {
            Some("json") => transforms::read(path, images_dir),
            Some("bin") => colmap::read(paths::parent(path)?.as_path(), PoseSource::ColmapBinary, images_dir),
            Some("txt") => colmap::read(paths::parent(path)?.as_path(), PoseSource::ColmapText, images_dir),
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
