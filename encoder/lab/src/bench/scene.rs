//! Scenes for benchmarks of the rasteriser: generated ones of any size, and a user's own.

use std::f64::consts::{PI, TAU};
use std::path::Path;

use anyhow::{Result, bail};
use glam::{DQuat, DVec2, DVec3};
use slag_common::splat::{self, ReadOptions};
use slag_common::{Gaussians, poses};

use crate::generate::compose::{looking, pinhole};
use slag_encoder::masks::RegionMap;
use slag_encoder::raster::RasterView;
use slag_math::random::Random;

/// Horizontal field of view of generated views.
const FIELD_OF_VIEW_RAD: f64 = 65.0 * PI / 180.0;
const N_VIEWS: usize = 4;
/// Objects on the ground of a generated scene.
const N_OBJECTS: usize = 60;
/// Radius of the ground. The backdrop stands on its edge.
const GROUND_RADIUS_M: f64 = 20.0;
const BACKDROP_HEIGHT_M: f64 = 8.0;
/// Median standard deviation of a surface Gaussian, in spacings: neighbours overlap.
const SPREAD: f64 = 0.5;

pub(super) struct BenchScene {
    pub(super) name: String,
    pub(super) gaussians: Gaussians,
    /// Views of one image size; at least one.
    pub(super) views: Vec<RasterView>,
}

impl BenchScene {
    /// Generates a scene with the statistics of a trained one.
    ///
    /// Flat Gaussians cover ground, objects and a backdrop; they shrink as their number grows, are denser towards
    /// the middle, log-normal in size, and of high or low opacity. A few large faint Gaussians float in the air.
    /// The cameras stand among the objects. Equal arguments give equal scenes on machines with the same
    /// mathematical library.
    pub(super) fn generated(n_gaussians: usize, width_px: u32, height_px: u32) -> Self {
        let mut maker = Maker { random: Random::new(1), gaussians: Gaussians::default() };
        let share = |percent: usize| n_gaussians * percent / 100;
        let (n_ground, n_backdrop, n_floating) = (share(30), share(20), share(5));
        maker.ground(n_ground);
        maker.backdrop(n_backdrop);
        maker.floating(n_floating);
        maker.objects(n_gaussians - n_ground - n_backdrop - n_floating);
        let intrinsics = pinhole([width_px, height_px], FIELD_OF_VIEW_RAD);
        let views = (0..N_VIEWS)
            .map(|i| {
                let angle = TAU * i as f64 / N_VIEWS as f64;
                let position = DVec3::new(4.5 * angle.cos(), 4.5 * angle.sin(), 1.6);
                let target = DVec3::new(1.5 * (angle + 2.0).cos(), 1.5 * (angle + 2.0).sin(), 0.6);
                RasterView { camera_from_world: looking(position, target - position), intrinsics }
            })
            .collect();
        Self { name: format!("generated-{n_gaussians}"), gaussians: maker.gaussians, views }
    }

    /// Reads a splat and its poses, scaled to `width_px`.
    pub(super) fn read(splat: &Path, views: &Path, width_px: u32) -> Result<Self> {
        let gaussians = splat::read(splat, &ReadOptions { with_sh_rest: false })?;
        let view = |view: &slag_common::View| RasterView {
            camera_from_world: view.camera_from_world,
            intrinsics: view.intrinsics.without_distortion().scaled_to_width(width_px),
        };
        let read: Vec<RasterView> = poses::read(views, None)?.views.iter().map(view).collect();
        // A benchmark has regions of one size.
        let size = |view: &RasterView| (view.intrinsics.width_px, view.intrinsics.height_px);
        let Some(first) = read.first().map(size) else { bail!("{}: no views", views.display()) };
        let step = read.len().div_ceil(N_VIEWS);
        let views = read.into_iter().filter(|view| size(view) == first).step_by(step).collect();
        let name = splat.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        Ok(Self { name, gaussians, views })
    }
}

/// Returns a map of `columns` x `rows` equal rectangles.
pub(super) fn grid_regions(width_px: u32, height_px: u32, columns: u32, rows: u32) -> RegionMap {
    let region = |x: u32, y: u32| {
        y * rows / height_px * columns + (u64::from(x) * u64::from(columns) / u64::from(width_px)) as u32
    };
    let region_of_pixel = (0..height_px).flat_map(|y| (0..width_px).map(move |x| region(x, y))).collect();
    RegionMap { width_px, height_px, region_of_pixel, n_regions: columns * rows }
}

/// Returns a map of regions with irregular borders: each pixel belongs to the nearest of `n_regions` sites, one at
/// a random place in each field of a grid.
pub(super) fn cell_regions(width_px: u32, height_px: u32, n_regions: u32) -> RegionMap {
    let (width, height) = (f64::from(width_px), f64::from(height_px));
    let columns = ((f64::from(n_regions) * width / height).sqrt().round() as u32).clamp(1, n_regions.max(1));
    let rows = n_regions.div_ceil(columns).max(1);
    let size_px = DVec2::new(width / f64::from(columns), height / f64::from(rows));
    let mut random = Random::new(2);
    let sites: Vec<DVec2> = (0..rows)
        .flat_map(|row| (0..columns).map(move |column| DVec2::new(f64::from(column), f64::from(row))))
        .map(|field| (field + DVec2::new(random.unit(), random.unit())) * size_px)
        .collect();
    let near = |at: u32, n: u32| at.saturating_sub(1)..(at + 2).min(n);
    let region = |x: u32, y: u32| {
        let centre = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
        let field = (centre / size_px).as_uvec2();
        let fields = near(field.y, rows).flat_map(|r| near(field.x, columns).map(move |c| r * columns + c));
        let distance = |&site: &u32| sites[site as usize].distance_squared(centre);
        let nearest = fields.min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap_or(0);
        // The grid may have more fields than regions.
        nearest.min(n_regions - 1)
    };
    let region_of_pixel = (0..height_px).flat_map(|y| (0..width_px).map(move |x| region(x, y))).collect();
    RegionMap { width_px, height_px, region_of_pixel, n_regions }
}

/// Returns a direction, uniform on the sphere.
fn direction(random: &mut Random) -> DVec3 {
    let (z, angle) = (2.0 * random.unit() - 1.0, TAU * random.unit());
    let r = (1.0 - z * z).sqrt();
    DVec3::new(r * angle.cos(), r * angle.sin(), z)
}

/// Adds Gaussians to a scene.
struct Maker {
    random: Random,
    gaussians: Gaussians,
}

impl Maker {
    /// Covers the ground, with a density of 1 / distance from the middle.
    fn ground(&mut self, n: usize) {
        for _ in 0..n {
            let (radius, angle) = (GROUND_RADIUS_M * self.random.unit(), TAU * self.random.unit());
            let spacing = (TAU * GROUND_RADIUS_M * radius.max(0.1) / n as f64).sqrt();
            let position = DVec3::new(radius * angle.cos(), radius * angle.sin(), 0.0);
            self.surface(position, DVec3::Z, spacing);
        }
    }

    fn backdrop(&mut self, n: usize) {
        let spacing = (TAU * GROUND_RADIUS_M * BACKDROP_HEIGHT_M / n as f64).sqrt();
        for _ in 0..n {
            let (angle, height) = (TAU * self.random.unit(), BACKDROP_HEIGHT_M * self.random.unit());
            let inward = -DVec3::new(angle.cos(), angle.sin(), 0.0);
            self.surface(-inward * GROUND_RADIUS_M + DVec3::Z * height, inward, spacing);
        }
    }

    /// Covers ellipsoids on the ground with equal numbers of Gaussians.
    fn objects(&mut self, n: usize) {
        for object in 0..N_OBJECTS {
            let half = DVec3::from_array(std::array::from_fn(|_| 0.15 + 0.6 * self.random.unit().powi(2)));
            let (radius, angle) = (7.0 * self.random.unit().sqrt(), TAU * self.random.unit());
            let centre = DVec3::new(radius * angle.cos(), radius * angle.sin(), half.z);
            let n_here = n * (object + 1) / N_OBJECTS - n * object / N_OBJECTS;
            // Thomsen's formula for the area, with p = 1.6075.
            let [a, b, c] = half.to_array().map(|h| h.powf(1.6075));
            let area = 4.0 * PI * ((a * b + a * c + b * c) / 3.0).powf(1.6075_f64.recip());
            let spacing = (area / n_here.max(1) as f64).sqrt();
            for _ in 0..n_here {
                let direction = direction(&mut self.random);
                self.surface(centre + direction * half, (direction / half).normalize(), spacing);
            }
        }
    }

    /// Adds large faint Gaussians in the air, as training leaves behind.
    fn floating(&mut self, n: usize) {
        let spacing = (PI * GROUND_RADIUS_M.powi(2) * BACKDROP_HEIGHT_M / n.max(1) as f64).cbrt();
        for _ in 0..n {
            let (radius, angle) = (GROUND_RADIUS_M * self.random.unit(), TAU * self.random.unit());
            let height = BACKDROP_HEIGHT_M * self.random.unit();
            let position = DVec3::new(radius * angle.cos(), radius * angle.sin(), height);
            let scales =
                std::array::from_fn(|_| (0.15 * spacing * (0.7 * self.random.normal()).exp()) as f32);
            let opacity = 0.01 + 0.1 * self.random.unit();
            let normal = direction(&mut self.random);
            self.push(position, normal, scales, opacity);
        }
    }

    /// Adds a flat Gaussian to a surface with Gaussians `spacing` apart.
    fn surface(&mut self, position: DVec3, normal: DVec3, spacing: f64) {
        let size = SPREAD * spacing * (0.9 * self.random.normal()).exp();
        let long = (0.4 * self.random.normal()).exp();
        let scales = [size * long, size / long, 0.15 * size].map(|s| s as f32);
        let opaque = self.random.unit() < 0.5;
        let share = self.random.unit();
        let opacity = if opaque { 1.0 - 0.5 * share * share } else { 0.02 + 0.5 * share };
        let position = position + normal * (0.2 * spacing * self.random.normal());
        self.push(position, normal, scales, opacity);
    }

    fn push(&mut self, position: DVec3, normal: DVec3, scales: [f32; 3], opacity: f64) {
        let turn = DQuat::from_rotation_z(TAU * self.random.unit());
        let q = (DQuat::from_rotation_arc(DVec3::Z, normal) * turn).normalize();
        self.gaussians.means_in_world.push(position);
        self.gaussians.rotations_wxyz.push([q.w, q.x, q.y, q.z].map(|c| c as f32));
        self.gaussians.scales.push(scales);
        self.gaussians.opacities.push(opacity as f32);
        self.gaussians.sh_dc.push([0.0; 3]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slag_encoder::raster::{CpuRasterizer, Rasterizer, WeightKind};

    #[test]
    fn generated_scenes_are_like_trained_ones() {
        let scene = BenchScene::generated(20_011, 162, 121);
        assert_eq!(scene.gaussians.len(), 20_011);
        assert!((0..20_011).all(|i| scene.gaussians.is_usable(i)));
        for view in &scene.views {
            let regions = grid_regions(162, 121, 3, 2);
            let found = CpuRasterizer.weights(&scene.gaussians, view, &regions, WeightKind::Blend).unwrap();
            let share_visible = found.counters.visible as f64 / 20_011.0;
            assert!((0.15..0.6).contains(&share_visible), "{share_visible}");
            // Surfaces are closed: hardly any light passes.
            let seen: f64 = found.entries.iter().map(|e| f64::from(e.weight)).sum();
            assert!(seen > 0.9 * 162.0 * 121.0 * 0.8, "{seen}");
        }
    }

    #[test]
    fn every_region_has_pixels() {
        for n_regions in [1, 8, 61, 512] {
            let map = cell_regions(324, 242, n_regions);
            let mut n_px = vec![0; n_regions as usize];
            map.region_of_pixel.iter().for_each(|&region| n_px[region as usize] += 1);
            assert!(n_px.iter().all(|&n| n > 0), "{n_regions}: {n_px:?}");
        }
        let grid = grid_regions(17, 9, 8, 6);
        assert_eq!(
            (grid.region_of_pixel[0], grid.region_of_pixel[16], grid.region_of_pixel[152]),
            (0, 7, 47)
        );
    }
}
