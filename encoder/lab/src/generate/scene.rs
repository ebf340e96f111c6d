//! A generated scene: Gaussians, views and labels.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use glam::{DQuat, DVec3};
use serde::Serialize;
use slag_common::gaussians::SH_C0;
use slag_common::{Gaussians, npy, splat};
use slag_encoder::progress::Progress;
use slag_encoder::raster::RasterView;
use slag_math::random::Xorshift;

use super::compose::{Layout, Walk, photo_intrinsics};
use super::grammar::{NOUNS, SceneKind};
use super::paint::word;
use super::render::NOTHING;

/// Distance between surface Gaussians, relative to the thing's radius.
const SPACING_OF_RADIUS: f64 = 0.03;
/// Bounds of that distance.
const SPACING_M: [f64; 2] = [0.012, 0.11];
const OPACITY: f32 = 0.97;
/// Standard deviation of a surface Gaussian in spacings: neighbours overlap into a closed surface.
const SPREAD: f64 = 0.62;
const THICKNESS_M: f32 = 0.002;
const N_TEST_VIEWS: u32 = 6;
/// First id of things in the labels. Ids of floor, walls and other background begin at 1.
const FIRST_ID: u16 = 10;

pub struct Scene {
    /// Metres, z up.
    pub gaussians: Gaussians,
    pub id_of_gaussian: Vec<u16>,
    /// Including floor and walls.
    pub objects: Vec<TrueObject>,
    pub views: Vec<RasterView>,
    test_views: Vec<RasterView>,
    layout: Layout,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TrueObject {
    pub id: u16,
    pub category: String,
    pub words: Vec<String>,
    pub kinds: Vec<String>,
    /// Its colours, the main one first.
    pub colours: Vec<String>,
    pub material: String,
    /// Whether it is background, such as floor and walls.
    pub background: bool,
    pub centre: DVec3,
    pub aabb_min: DVec3,
    pub aabb_max: DVec3,
    pub n_gaussians: usize,
    /// Pixels that show it, over all photos to encode.
    pub train_pixels: u64,
}

pub struct WrittenScene {
    pub scene: PathBuf,
    pub views: PathBuf,
}

impl Scene {
    /// Makes scenes of these kinds side by side along x. Equal seeds give equal scenes.
    pub fn new(kinds: &[SceneKind], seed: u64, n_views: u32) -> Self {
        let layout = Layout::new(kinds, seed, &|_, _| true);
        let solids = layout.solids();
        let mut random = Xorshift::new(seed ^ 0x5ca1e);
        let mut gaussians = Gaussians::default();
        let (mut id_of_gaussian, mut objects) = (Vec::new(), Vec::new());
        let mut next_ids = [1, FIRST_ID];
        for (i, placed) in layout.placed.iter().enumerate() {
            let next_id = &mut next_ids[usize::from(!placed.shell)];
            let id = *next_id;
            *next_id += 1;
            let spacing_m = (solids.things[i].radius_m * SPACING_OF_RADIUS).clamp(SPACING_M[0], SPACING_M[1]);
            let spread = (spacing_m * SPREAD) as f32;
            let covering = solids.covering(i, spacing_m);
            for (surfel, rgb) in &covering {
                let rotation = DQuat::from_rotation_arc(DVec3::Z, surfel.normal);
                let uneven = 0.02 * random.signed();
                gaussians.means_in_world.push(surfel.position);
                gaussians
                    .rotations_wxyz
                    .push([rotation.w, rotation.x, rotation.y, rotation.z].map(|q| q as f32));
                gaussians.scales.push([spread, spread, THICKNESS_M]);
                gaussians.opacities.push(OPACITY);
                gaussians.sh_dc.push(rgb.map(|c| ((c + uneven).clamp(0.0, 1.0) as f32 - 0.5) / SH_C0));
                id_of_gaussian.push(id);
            }
            let noun = &NOUNS[placed.noun];
            objects.push(TrueObject {
                id,
                category: noun.name.clone(),
                words: noun.words.clone(),
                kinds: noun.kinds.clone(),
                colours: placed.object.colours.iter().map(word).collect(),
                material: word(placed.object.paint.material),
                background: placed.shell,
                centre: placed.bounds.centre(),
                aabb_min: placed.bounds.min,
                aabb_max: placed.bounds.max,
                n_gaussians: covering.len(),
                train_pixels: 0,
            });
        }
        let views = layout.photos(Walk::Oval, n_views);
        let test_views = layout.walk(N_TEST_VIEWS, 0.37, photo_intrinsics());
        Self { gaussians, id_of_gaussian, objects, views, test_views, layout }
    }

    pub fn photograph(&mut self, walk: Walk, n_views: u32) {
        self.views = self.layout.photos(walk, n_views);
    }

    /// Writes `scene.ply`, `images/`, `transforms.json`; the held-out views in `test/`; and the labels in `gt/`:
    /// `masks/` and `test_masks/` (a thing's id at each pixel, 0 for the sky), `instances.json`,
    /// `gaussian_instance.npy`.
    pub fn write(&mut self, folder: &Path, progress: &dyn Progress) -> Result<WrittenScene> {
        let truth = folder.join("gt");
        for sub in ["images", "test", "gt/masks", "gt/test_masks"] {
            fs_err::create_dir_all(folder.join(sub))?;
        }
        let scene = folder.join("scene.ply");
        splat::ply::write(&scene, &self.gaussians)?;
        let views = folder.join("transforms.json");
        progress.begin("photos", "photo", (self.views.len() + self.test_views.len()) as u64, 0);
        let pixels =
            self.write_views(&self.views, [&folder.join("images"), &truth.join("masks")], &views, progress)?;
        self.objects.iter_mut().zip(pixels).for_each(|(object, n)| object.train_pixels = n);
        let test = folder.join("test");
        let poses = test.join("transforms.json");
        self.write_views(&self.test_views, [&test, &truth.join("test_masks")], &poses, progress)?;
        progress.end();
        let (background, instances): (Vec<_>, Vec<_>) = self.objects.iter().partition(|o| o.background);
        let instances = serde_json::json!({
            "unlabelled": u16::MAX, "void_mask_value": 0, "background": background, "instances": instances,
        });
        write_json(&truth.join("instances.json"), &instances)?;
        let ids = &self.id_of_gaussian;
        npy::write_file(&truth.join("gaussian_instance.npy"), &[ids.len()], ids)?;
        Ok(WrittenScene { scene, views })
    }

    /// Returns the number of pixels that show each object.
    fn write_views(
        &self,
        views: &[RasterView],
        [photos, masks]: [&Path; 2],
        poses: &Path,
        progress: &dyn Progress,
    ) -> Result<Vec<u64>> {
        let solids = self.layout.solids();
        let mut n_pixels = vec![0; self.objects.len()];
        let mut frames = Vec::new();
        for (i, view) in views.iter().enumerate() {
            let photo = solids.photo(view);
            let mut id_of = |thing: &u16| match *thing {
                NOTHING => 0,
                thing => {
                    n_pixels[usize::from(thing)] += 1;
                    self.objects[usize::from(thing)].id
                }
            };
            let ids: Vec<u16> = photo.thing_of_pixel.iter().map(&mut id_of).collect();
            let [width, height] = [view.intrinsics.width_px, view.intrinsics.height_px];
            let mask = image::ImageBuffer::<image::Luma<u16>, _>::from_raw(width, height, ids)
                .expect("a photo has one id per pixel");
            let name = format!("{i:04}.png");
            let path = masks.join(&name);
            mask.save(&path).with_context(|| path.display().to_string())?;
            let path = photos.join(&name);
            photo.image.save(&path).with_context(|| path.display().to_string())?;
            let beside = poses.parent().and_then(|folder| path.strip_prefix(folder).ok()).unwrap_or(&path);
            frames.push(frame(beside.to_string_lossy().into_owned(), view));
            progress.advance(1);
        }
        if let Some(RasterView { intrinsics: k, .. }) = views.first() {
            let transforms = serde_json::json!({
                "camera_model": "PINHOLE",
                "fl_x": k.focal_x_px, "fl_y": k.focal_y_px, "cx": k.centre_x_px, "cy": k.centre_y_px,
                "w": k.width_px, "h": k.height_px,
                "frames": frames,
            });
            write_json(poses, &transforms)?;
        }
        Ok(n_pixels)
    }
}

/// A view in the form of transforms.json: OpenGL axes, y up, z backward.
fn frame(file_path: String, view: &RasterView) -> serde_json::Value {
    let world_from_camera = view.camera_from_world.inverse();
    let [x, y, z] = world_from_camera.matrix3.to_cols_array_2d().map(DVec3::from);
    let columns = [x, -y, -z, world_from_camera.translation];
    let row = |r: usize| columns.map(|c| c[r]);
    serde_json::json!({"file_path": file_path, "transform_matrix": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]})
}

fn write_json(path: &Path, value: &serde_json::Value) -> std::io::Result<()> {
    fs_err::write(path, serde_json::to_vec_pretty(value)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use slag_encoder::check::psnr_db;
    use slag_encoder::raster::{CpuRasterizer, Rasterizer};

    const KINDS: [SceneKind; 4] = [SceneKind::Room, SceneKind::Yard, SceneKind::Street, SceneKind::Warehouse];

    #[test]
    fn things_stand_apart_and_within() {
        for (seed, kind) in (0..30).zip(KINDS.into_iter().cycle()) {
            let layout = Layout::new(&[kind], seed, &|_, _| true);
            let things: Vec<_> = layout.placed.iter().filter(|p| !p.shell).collect();
            assert!(things.len() >= 8, "{kind:?} {seed}: {} things", things.len());
            for (i, a) in things.iter().enumerate() {
                assert!(a.bounds.min.z > -0.1, "{} is below the ground", NOUNS[a.noun].name);
                for b in &things[..i] {
                    let apart = (a.bounds.min - b.bounds.max).max(b.bounds.min - a.bounds.max).max_element();
                    assert!(
                        apart > -0.04,
                        "{kind:?} {seed}: {} in {}",
                        NOUNS[a.noun].name,
                        NOUNS[b.noun].name
                    );
                }
            }
        }
    }

    #[test]
    fn the_same_seed_makes_the_same_scene() {
        let scene = |seed| Scene::new(&KINDS, seed, 3);
        let (a, b, other) = (scene(5), scene(5), scene(6));
        assert!(a.gaussians == b.gaussians && a.objects == b.objects && a.id_of_gaussian == b.id_of_gaussian);
        assert!(a.objects != other.objects);
        let ids: Vec<u16> = a.objects.iter().map(|object| object.id).collect();
        for (object, id) in a.objects.iter().zip(&ids) {
            let n = a.id_of_gaussian.iter().filter(|of| *of == id).count();
            assert_eq!((n, ids.iter().filter(|other| *other == id).count()), (object.n_gaussians, 1));
        }
    }

    /// Renderings of the Gaussians match the ray-cast photos.
    #[test]
    fn gaussians_look_like_the_photos() {
        for kind in KINDS {
            let scene = Scene::new(&[kind], 3, 4);
            assert!((0..scene.gaussians.len()).all(|i| scene.gaussians.is_usable(i)));
            let solids = scene.layout.solids();
            for view in &scene.views {
                let view = RasterView { intrinsics: view.intrinsics.scaled_to_width(320), ..*view };
                let photo = solids.photo(&view).image;
                let drawn = CpuRasterizer.draw(&scene.gaussians, &view, [0.9; 3]).expect("draws");
                let psnr = psnr_db(&photo, |pixel, c| drawn.rgb[3 * pixel + c]);
                assert!(psnr > 17.0, "{kind:?}: {psnr} dB");
            }
        }
    }
}
