//! A scene's labels: the thing of each Gaussian.
//!
//! ```text
//! DIR/gt/instances.json           things: id, category, words; "background": floors and walls
//! DIR/gt/gaussian_instance.npy    u16 [N]: the id of each Gaussian's thing
//! ```

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result, anyhow, bail};
use glam::DVec3;
use serde::Deserialize;
use slag_encoder::store::StoreReader;

#[derive(Clone, Debug, Default, Deserialize)]
pub(super) struct Thing {
    pub(super) id: u16,
    pub(super) category: String,
    #[serde(default)]
    pub(super) words: Vec<String>,
    /// Its kinds, such as furniture; generated scenes have them.
    #[serde(default)]
    pub(super) kinds: Vec<String>,
    /// Pixels that show it in the photos to encode; generated scenes have it.
    #[serde(default)]
    pub(super) train_pixels: u64,
    /// Corners of its box, metres, where the labels have them.
    #[serde(default)]
    pub(super) aabb_min: DVec3,
    #[serde(default)]
    pub(super) aabb_max: DVec3,
}

#[derive(Clone, Debug)]
pub(crate) struct Truth {
    /// Without floors and walls.
    pub(super) things: Vec<Thing>,
    pub(super) background: Vec<Thing>,
    /// `[N]`: id of each Gaussian's thing; an id without a thing where there is none.
    pub(super) id_of_gaussian: Vec<u16>,
}

#[derive(Deserialize)]
struct Instances {
    instances: Vec<Thing>,
    #[serde(default)]
    background: Vec<Thing>,
}

/// Reads `gt/instances.json`: things, and background.
pub(super) fn read_things(dir: &Path) -> Result<(Vec<Thing>, Vec<Thing>)> {
    let path = dir.join("gt/instances.json");
    let expected =
        || format!("{}: expected instances and background, each with id and category", path.display());
    let Instances { instances, background } =
        serde_json::from_slice(&fs_err::read(&path)?).with_context(expected)?;
    Ok((instances, background))
}

pub(super) fn check_scene(reader: &StoreReader, n_scene: usize) -> Result<()> {
    let manifest = reader.manifest();
    let n_store = (manifest.n_gaussians + manifest.n_rejected) as usize;
    if n_store != n_scene {
        bail!("the store has {n_store} Gaussians, the splat {n_scene}; give the splat that was encoded");
    }
    Ok(())
}

impl Truth {
    pub(super) fn read(dir: &Path, n_gaussians: usize) -> Result<Self> {
        let (things, background) = read_things(dir)?;
        let path = dir.join("gt/gaussian_instance.npy");
        let expected = || {
            format!(
                "{}: expected u16 ids of shape [{n_gaussians}], one per Gaussian of the splat",
                path.display()
            )
        };
        let bytes = fs_err::read(&path)?;
        let npy = npyz::NpyFile::new(&bytes[..]).with_context(expected)?;
        if npy.shape() != [n_gaussians as u64] {
            return Err(anyhow!("{}, found {:?}", expected(), npy.shape()));
        }
        Ok(Self { things, background, id_of_gaussian: npy.into_vec().with_context(expected)? })
    }

    /// Returns the categories with the ids of their things, those with most Gaussians first.
    pub(super) fn categories(&self) -> Vec<(String, Vec<u16>)> {
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
