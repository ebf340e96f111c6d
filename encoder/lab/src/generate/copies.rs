//! Large scenes: a photographed scene many times over, on a square grid, with its photos, masks and poses moved
//! along.

use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use glam::DVec3;
use serde_json::Value;
use slag_common::Gaussians;
use slag_common::splat::{self, ReadOptions};
use slag_encoder::progress::Progress;
use slag_math::stats::trimmed_range;

/// Share of the means on either side of an axis that is ignored for the distance of copies: floaters.
const TRIMMED: f64 = 0.005;
/// Distance between copies, relative to their size.
const SPACING: f64 = 1.1;

#[derive(Clone, Debug)]
pub struct WrittenCopies {
    pub scene: PathBuf,
    pub views: PathBuf,
    pub masks: Option<PathBuf>,
    pub n_gaussians: u64,
    /// Distance between neighbouring copies, world units.
    pub spacing: f64,
}

/// Writes `scene.ply`, `transforms.json`, `images/` and `gt/masks/` from a folder with a labelled scene. Photos
/// and masks are hard links where the file system allows it. Cameras see neighbouring copies in the distance,
/// where photos show none.
pub fn write(
    source: &Path,
    folder: &Path,
    n_copies: u32,
    n_views: u32,
    progress: &dyn Progress,
) -> Result<WrittenCopies> {
    let mut source = Source::read(source)?;
    if u64::from(n_views) > u64::from(n_copies) * source.frames.len() as u64 {
        let n = source.frames.len();
        bail!(
            "{}: it has {n} photos, too few for {n_views} of {n_copies} copies; ask for fewer",
            source.folder.display()
        );
    }
    let grid = Grid::of(&source.gaussians, n_copies);
    fs_err::create_dir_all(folder.join("images"))?;
    fs_err::create_dir_all(folder.join("gt/masks"))?;
    let (scene, views) = (folder.join("scene.ply"), folder.join("transforms.json"));
    let n_gaussians = source.write_copies(&scene, &grid, progress)?;
    let frames = (0..n_views).map(|view| source.frame(view, n_views, &grid, folder));
    source.poses["frames"] = frames.collect::<Result<Vec<_>>>()?.into();
    fs_err::write(&views, serde_json::to_vec(&source.poses)?)?;
    let masks = source.masks.map(|_| folder.join("gt/masks"));
    Ok(WrittenCopies { scene, views, masks, n_gaussians, spacing: grid.spacing })
}

/// Where copies stand. The up axis is unknown, so the grid spans the two longest sides.
struct Grid {
    n_copies: u32,
    up: usize,
    side: u32,
    spacing: f64,
}

impl Grid {
    fn of(gaussians: &Gaussians, n_copies: u32) -> Self {
        let size = [0, 1, 2].map(|axis| {
            let mut values: Vec<f64> = gaussians.means_in_world.iter().map(|mean| mean[axis]).collect();
            trimmed_range(&mut values, TRIMMED).map_or(0.0, |(low, high)| high - low)
        });
        let up = (0..3).min_by(|a, b| size[*a].total_cmp(&size[*b])).unwrap_or(2);
        let spacing = size.into_iter().fold(0.0, f64::max) * SPACING;
        Self { n_copies, up, side: f64::from(n_copies).sqrt().ceil() as u32, spacing }
    }

    fn offset(&self, copy: u32) -> DVec3 {
        let mut offset = DVec3::ZERO;
        offset[(self.up + 1) % 3] = f64::from(copy % self.side) * self.spacing;
        offset[(self.up + 2) % 3] = f64::from(copy / self.side) * self.spacing;
        offset
    }
}

struct Source {
    folder: PathBuf,
    gaussians: Gaussians,
    poses: Value,
    frames: Vec<Value>,
    masks: Option<PathBuf>,
}

impl Source {
    fn read(folder: &Path) -> Result<Self> {
        let shown = folder.display();
        let splats = ["scene.ply", "point_cloud.ply"].map(|name| folder.join(name));
        let splat = splats.into_iter().find(|path| path.exists());
        let splat = splat.with_context(|| format!("{shown}: no scene.ply or point_cloud.ply"))?;
        let gaussians = splat::read(&splat, &ReadOptions { with_sh_rest: true })?;
        let poses = folder.join("transforms.json");
        let poses: Value =
            serde_json::from_slice(&fs_err::read(&poses)?).with_context(|| poses.display().to_string())?;
        let frames = poses["frames"].as_array().filter(|frames| !frames.is_empty());
        let frames = frames.with_context(|| format!("{shown}: transforms.json has no frames"))?.clone();
        let masks = Some(folder.join("gt/masks")).filter(|masks| masks.is_dir());
        Ok(Self { folder: folder.to_owned(), gaussians, poses, frames, masks })
    }

    /// Writes the Gaussians of all copies; returns their number.
    fn write_copies(&mut self, path: &Path, grid: &Grid, progress: &dyn Progress) -> Result<u64> {
        let gaussians = &mut self.gaussians;
        let n_gaussians = gaussians.len() as u64 * u64::from(grid.n_copies);
        progress.begin("copies", "copy", u64::from(grid.n_copies), 0);
        let mut out = BufWriter::new(fs_err::File::create(path)?);
        splat::ply::write_header(&mut out, n_gaussians, gaussians.sh_degree)?;
        let means = gaussians.means_in_world.clone();
        for copy in 0..grid.n_copies {
            let moved = grid.offset(copy);
            gaussians.means_in_world.iter_mut().zip(&means).for_each(|(out, mean)| *out = *mean + moved);
            splat::ply::write_rows(&mut out, gaussians)?;
            progress.advance(1);
        }
        out.flush()?;
        progress.end();
        Ok(n_gaussians)
    }

    /// Links a view's photo and mask, and returns its frame.
    fn frame(&self, view: u32, n_views: u32, grid: &Grid, folder: &Path) -> Result<Value> {
        let [view, n_views, n_copies] = [view, n_views, grid.n_copies].map(u64::from);
        let copy = view * n_copies / n_views;
        // Neighbouring copies show different photos where each has few.
        let first = (copy * n_views).div_ceil(n_copies);
        let of_copy = ((copy + 1) * n_views).div_ceil(n_copies) - first;
        let at = (view - first) * self.frames.len() as u64 / of_copy + copy * 7;
        let mut frame = self.frames[at as usize % self.frames.len()].clone();
        let path = frame["file_path"].as_str();
        let shown = self.folder.display();
        let photo = self.folder.join(path.with_context(|| format!("{shown}: a frame without file_path"))?);
        let (stem, suffix) = (file_part(photo.file_stem()), file_part(photo.extension()));
        let name = format!("c{copy:04}_{stem}");
        link(&photo, &folder.join(format!("images/{name}.{suffix}")))?;
        if let Some(masks) = &self.masks {
            link(&masks.join(format!("{stem}.png")), &folder.join(format!("gt/masks/{name}.png")))?;
        }
        frame["file_path"] = format!("images/{name}.{suffix}").into();
        for (axis, by) in grid.offset(copy as u32).to_array().into_iter().enumerate() {
            let cell = &mut frame["transform_matrix"][axis][3];
            let wrong = || format!("{shown}: a transform_matrix that is not 4x4");
            *cell = (cell.as_f64().with_context(wrong)? + by).into();
        }
        if let Some(frame) = frame.as_object_mut() {
            frame.remove("mask_instance_path");
        }
        Ok(frame)
    }
}

fn file_part(part: Option<&std::ffi::OsStr>) -> String {
    part.unwrap_or_default().to_string_lossy().into_owned()
}

/// Makes a hard link, or a copy on another file system.
fn link(from: &Path, to: &Path) -> std::io::Result<()> {
    if to.exists() {
        fs_err::remove_file(to)?;
    }
    fs_err::hard_link(from, to).or_else(|_| fs_err::copy(from, to).map(|_| ()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::generate::Scene;
    use crate::generate::grammar::SceneKind;
    use slag_common::poses;
    use slag_encoder::progress::Silent;

    /// Each camera sees its copy as the source's camera sees the source, and has the source's photo and mask.
    #[test]
    fn copies_look_like_their_source() {
        let dir = tempfile::tempdir().expect("a folder");
        let (source, copies) = (dir.path().join("source"), dir.path().join("copies"));
        Scene::new(&[SceneKind::Room], 5, 6).write(&source, &Silent).expect("writes");
        let written = write(&source, &copies, 5, 13, &Silent).expect("writes");
        let read = |path: &Path| splat::read(path, &ReadOptions { with_sh_rest: true }).expect("reads");
        let (one, all) = (read(&source.join("scene.ply")), read(&written.scene));
        assert_eq!((all.len(), written.n_gaussians), (5 * one.len(), 5 * one.len() as u64));
        let views = poses::read(&written.views, None).expect("reads").views;
        let of_source = poses::read(&source.join("transforms.json"), None).expect("reads").views;
        assert_eq!(views.len(), 13);
        let mut n_views_of = [0; 5];
        for view in &views {
            let (copy, stem) = view.name["c".len()..].split_once('_').expect("a copy and a name");
            let copy: usize = copy.parse().expect("a number");
            n_views_of[copy] += 1;
            let original = of_source.iter().find(|v| v.name == stem).expect("the source's view");
            for k in (0..one.len()).step_by(97) {
                let expected = original.camera_from_world.transform_point3(one.means_in_world[k]);
                let found = view.camera_from_world.transform_point3(all.means_in_world[copy * one.len() + k]);
                assert!((found - expected).length() < 1e-4, "{found} {expected}");
            }
            let same = |path: &Path, of: &Path| fs_err::read(path).unwrap() == fs_err::read(of).unwrap();
            assert!(same(&view.image_path, &original.image_path));
            let mask = |dir: &Path, name: &str| dir.join("gt/masks").join(name).with_extension("png");
            assert!(same(&mask(&copies, &view.name), &mask(&source, stem)));
        }
        assert_eq!(n_views_of, [3, 3, 2, 3, 2]);
        assert_eq!(all.scales[one.len()..2 * one.len()], one.scales[..]);
    }

    #[test]
    fn too_many_photos_are_refused() {
        let dir = tempfile::tempdir().expect("a folder");
        Scene::new(&[SceneKind::Room], 5, 2).write(dir.path(), &Silent).expect("writes");
        let error = write(dir.path(), &dir.path().join("out"), 2, 5, &Silent).expect_err("too many");
        assert!(error.to_string().contains("it has 2 photos"), "{error}");
    }
}
