//! Folders with a scene: `scene.ply` or `point_cloud.ply`, poses, photos, and labels in `gt/` where there are any.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};

#[derive(Clone, Debug)]
pub(crate) struct SceneFiles {
    pub(crate) name: String,
    pub(crate) dir: PathBuf,
    pub(crate) splat: PathBuf,
    pub(crate) poses: PathBuf,
    /// `None`: the photos are beside the poses.
    pub(crate) images: Option<PathBuf>,
    /// One picture of ids per photo.
    pub(crate) true_masks: Option<PathBuf>,
}

impl SceneFiles {
    pub(crate) fn find(dir: &Path) -> Result<Self> {
        let first = |names: &[&str]| {
            let found = names.iter().map(|name| dir.join(name)).find(|path| path.exists());
            let expected = || {
                format!(
                    "{}: no {}; expected a scene as `generate scene` writes it",
                    dir.display(),
                    names.join(" or ")
                )
            };
            found.with_context(expected)
        };
        let optional = |name: &str| Some(dir.join(name)).filter(|path| path.is_dir());
        let path = dir.canonicalize().with_context(|| dir.display().to_string())?;
        Ok(Self {
            name: path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
            dir: dir.to_owned(),
            splat: first(&["scene.ply", "point_cloud.ply", "point_cloud.spz"])?,
            poses: first(&["transforms.json", "sparse/0"])?,
            images: optional("images"),
            true_masks: optional("gt/masks"),
        })
    }

    /// Fails unless names differ, because they name files.
    pub(crate) fn find_all(dirs: &[PathBuf]) -> Result<Vec<Self>> {
        let all = dirs.iter().map(|dir| Self::find(dir)).collect::<Result<Vec<_>>>()?;
        for (at, scene) in all.iter().enumerate() {
            if all[..at].iter().any(|other| other.name == scene.name) {
                bail!("two scenes are called {}; rename one of their folders", scene.name);
            }
        }
        Ok(all)
    }
}
