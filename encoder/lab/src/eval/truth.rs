//! A scene's labels: the thing of each Gaussian, and the things on the held-out test views.
//!
//! ```text
//! DIR/gt/instances.json           things: id, category, aabb_min, aabb_max; "background": floors and walls
//! DIR/gt/gaussian_instance.npy    u16 [N]: the id of each Gaussian's thing
//! DIR/gt/test_masks/NAME.png      ids at each pixel of the test view NAME
//! DIR/test/transforms.json        the test views' poses
//! ```

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use glam::DVec3;
use serde::Deserialize;
use slag_common::View;
use slag_common::poses::{self, PoseError};

/// Error in the labels.
#[derive(Debug, thiserror::Error)]
pub enum TruthError {
    /// A file could not be read.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// The list of things is malformed.
    #[error("{}: {source}; expected instances and background, each with id and category", path.display())]
    Instances {
        /// The file.
        path: PathBuf,
        /// Line, column and reason.
        source: serde_json::Error,
    },
    /// The Gaussians' ids are malformed.
    #[error("{}: {reason}; expected u16 ids of shape [{n_gaussians}], one per Gaussian of the splat", path.display())]
    Ids {
        /// The file.
        path: PathBuf,
        /// The problem.
        reason: String,
        /// Gaussians in the splat.
        n_gaussians: usize,
    },
    /// The test views' poses cannot be read.
    #[error(transparent)]
    Poses(#[from] PoseError),
    /// A test view's mask is malformed.
    #[error("{}: {reason}; expected an id at each pixel of the view", path.display())]
    Mask {
        /// The file.
        path: PathBuf,
        /// The problem.
        reason: String,
    },
}

/// A thing.
#[derive(Clone, Debug, Deserialize)]
pub struct Thing {
    /// Its id.
    pub id: u16,
    /// Its category.
    pub category: String,
    /// Smallest corner of the box around it, metres.
    #[serde(default)]
    pub aabb_min: Option<DVec3>,
    /// Largest corner.
    #[serde(default)]
    pub aabb_max: Option<DVec3>,
    /// Its synonyms.
    #[serde(default)]
    pub words: Vec<String>,
}

/// The labels of a scene.
#[derive(Clone, Debug)]
pub struct Truth {
    /// The things, without floors and walls.
    pub things: Vec<Thing>,
    /// Floors, walls and other background.
    pub background: Vec<Thing>,
    /// `[N]`: the id of each Gaussian's thing; an id without a thing where there is none.
    pub id_of_gaussian: Vec<u16>,
    /// Held-out test views with their ids.
    pub views: Vec<LabelledView>,
}

/// A view with the id of the thing at each pixel.
#[derive(Clone, Debug)]
pub struct LabelledView {
    /// The view.
    pub view: View,
    /// Ids, row-major.
    pub ids: Vec<u16>,
}

#[derive(Deserialize)]
struct Instances {
    instances: Vec<Thing>,
    #[serde(default)]
    background: Vec<Thing>,
}

impl Truth {
    /// Reads the labels of a scene with `n_gaussians` Gaussians.
    ///
    /// # Errors
    /// [`TruthError`].
    pub fn read(dir: &Path, n_gaussians: usize) -> Result<Self, TruthError> {
        let path = dir.join("gt/instances.json");
        let Instances { instances, background } = serde_json::from_slice(&fs_err::read(&path)?)
            .map_err(|source| TruthError::Instances { path, source })?;
        let path = dir.join("gt/gaussian_instance.npy");
        let wrong = |reason: String| TruthError::Ids { path: path.clone(), reason, n_gaussians };
        let bytes = fs_err::read(&path)?;
        let npy = npyz::NpyFile::new(&bytes[..]).map_err(|e| wrong(e.to_string()))?;
        if npy.shape() != [n_gaussians as u64] {
            return Err(wrong(format!("shape {:?}", npy.shape())));
        }
        let id_of_gaussian: Vec<u16> = npy.into_vec().map_err(|e| wrong(e.to_string()))?;
        let poses = dir.join("test/transforms.json");
        let views = if poses.is_file() { poses::read(&poses, None)?.views } else { Vec::new() };
        let views = views.into_iter().map(|view| LabelledView::read(dir, view)).collect::<Result<_, _>>()?;
        Ok(Self { things: instances, background, id_of_gaussian, views })
    }

    /// Returns the categories with the ids of their things, those with most Gaussians first.
    pub fn categories(&self) -> Vec<(String, Vec<u16>)> {
        let mut n_of_id: BTreeMap<u16, usize> = BTreeMap::new();
        self.id_of_gaussian.iter().for_each(|id| *n_of_id.entry(*id).or_default() += 1);
        let mut ids: BTreeMap<&str, Vec<u16>> = BTreeMap::new();
        self.things.iter().for_each(|thing| ids.entry(&thing.category).or_default().push(thing.id));
        let size = |ids: &[u16]| ids.iter().filter_map(|id| n_of_id.get(id)).sum::<usize>();
        let mut categories: Vec<_> = ids.into_iter().map(|(word, ids)| (word.to_owned(), ids)).collect();
        categories.sort_by_key(|(word, ids)| (std::cmp::Reverse(size(ids)), word.clone()));
        categories
    }
}

impl LabelledView {
    fn read(dir: &Path, view: View) -> Result<Self, TruthError> {
        let name = Path::new(&view.name).file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let path = dir.join("gt/test_masks").join(format!("{name}.png"));
        let wrong = |reason: String| TruthError::Mask { path: path.clone(), reason };
        let bytes = fs_err::read(&path)?;
        let mask = image::load_from_memory(&bytes).map_err(|e| wrong(e.to_string()))?;
        let size = [view.intrinsics.width_px, view.intrinsics.height_px];
        if [mask.width(), mask.height()] != size {
            return Err(wrong(format!("{}x{} pixels of a view of {size:?}", mask.width(), mask.height())));
        }
        let ids = match mask {
            image::DynamicImage::ImageLuma8(ids) => ids.as_raw().iter().map(|id| u16::from(*id)).collect(),
            image::DynamicImage::ImageLuma16(ids) => ids.into_raw(),
            other => return Err(wrong(format!("{:?} pixels", other.color()))),
        };
        Ok(Self { view, ids })
    }
}
