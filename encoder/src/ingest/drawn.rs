//! Poses files whose images are drawings of the splat.

use std::path::Path;

use serde::Deserialize;

#[derive(Deserialize)]
struct Drawn {
    drawn_from: String,
}

/// Returns the splat from which the images of a poses file were drawn; `None` where they are photos. Only
/// transforms.json says so, of `plan` and `draw`.
pub fn drawn_from(poses: &Path) -> Option<String> {
    let inside = poses.join("transforms.json");
    let path = if poses.is_dir() { &inside } else { poses };
    let is_json = path.extension().is_some_and(|extension| extension == "json");
    let text = is_json.then(|| fs_err::read(path).ok())??;
    // What is malformed is told by the reader of poses.
    serde_json::from_slice::<Drawn>(&text).ok().map(|drawn| drawn.drawn_from)
}
