//! Generated scenes, views and region maps.

use super::*;

pub trait SceneRandom {
    /// Log-uniform.
    fn log_between(&mut self, low: f64, high: f64) -> f64;
    /// A point in the image or in a border of a quarter of its width, and a depth.
    fn in_view(&mut self, view: &RasterView, depths: [f64; 2]) -> DVec3;
    fn direction(&mut self) -> DVec3;
}

impl SceneRandom for Random {
    fn log_between(&mut self, low: f64, high: f64) -> f64 {
        self.between(low.ln(), high.ln()).exp()
    }

    fn in_view(&mut self, view: &RasterView, depths: [f64; 2]) -> DVec3 {
        let (width, height) = (f64::from(view.intrinsics.width_px), f64::from(view.intrinsics.height_px));
        let (x, y) = (self.between(-0.25, 1.25) * width, self.between(-0.25, 1.25) * height);
        let depth = self.log_between(depths[0], depths[1]);
        unproject(view, x, y, depth)
    }

    fn direction(&mut self) -> DVec3 {
        DVec3::from_array(std::array::from_fn(|_| self.between(-1.0, 1.0))).normalize()
    }
}

pub fn random_view(random: &mut Random, width_px: u32, height_px: u32) -> RasterView {
    let focal = random.between(0.6, 2.0) * f64::from(width_px.max(height_px));
    let rotation = DQuat::from_axis_angle(random.direction(), random.between(0.0, 3.0));
    let position = random.direction() * 3.0;
    let world_from_camera = DAffine3::from_rotation_translation(rotation, position);
    RasterView {
        camera_from_world: world_from_camera.inverse(),
        intrinsics: Intrinsics {
            focal_y_px: focal * random.between(0.9, 1.1),
            centre_x_px: f64::from(width_px) * random.between(0.4, 0.6),
            centre_y_px: f64::from(height_px) * random.between(0.4, 0.6),
            ..pinhole([width_px, height_px], focal)
        },
    }
}

/// Gaussians around the view's axis, from before the near plane to 10 units away.
pub fn random_scene(random: &mut Random, n: usize, view: &RasterView, sh_degree: u8) -> Gaussians {
    let world_from_camera = view.camera_from_world.inverse();
    let mut scene = Gaussians { sh_degree, ..Gaussians::default() };
    for _ in 0..n {
        let z = random.between(-0.5, 10.0);
        let spread = 0.8 * z.abs();
        let mean = DVec3::new(random.between(-spread, spread), random.between(-spread, spread), z);
        scene.means_in_world.push(world_from_camera.transform_point3(mean));
        let axis = random.direction();
        let rotation = DQuat::from_axis_angle(axis, random.between(0.0, 6.0));
        scene.rotations_wxyz.push([rotation.w, rotation.x, rotation.y, rotation.z].map(|c| c as f32));
        scene.scales.push(std::array::from_fn(|_| random.between(-7.0, 0.3).exp() as f32));
        scene.opacities.push(random.between(0.0, 1.0) as f32);
        scene.sh_dc.push(std::array::from_fn(|_| random.between(-2.0, 2.0) as f32));
        for _ in 0..Gaussians::sh_rest_per_channel(sh_degree) * 3 {
            scene.sh_rest.push(random.between(-0.5, 0.5) as f32);
        }
    }
    scene
}

pub fn random_regions(random: &mut Random, view: &RasterView, n_regions: u32) -> RegionMap {
    let (width_px, height_px) = (view.intrinsics.width_px, view.intrinsics.height_px);
    // Runs of random length give uniform and mixed stretches.
    let mut region_of_pixel = Vec::new();
    while region_of_pixel.len() < (width_px * height_px) as usize {
        let region = if random.below(5) == 0 { NO_REGION } else { random.below(n_regions) };
        let run = 1 + random.below(3) * random.below(30);
        region_of_pixel.extend((0..run).map(|_| region));
    }
    region_of_pixel.truncate((width_px * height_px) as usize);
    RegionMap { width_px, height_px, region_of_pixel, n_regions }
}

/// A camera near the origin, its principal point near the middle.
pub fn posed(random: &mut Random, [width_px, height_px]: [u32; 2], focal_px: f64) -> RasterView {
    let mut view = random_view(random, width_px, height_px);
    view.intrinsics.focal_x_px = focal_px;
    view.intrinsics.focal_y_px = focal_px * random.between(0.9, 1.1);
    view
}

/// Returns the point at a depth that projects to a pixel position, camera frame.
pub fn unproject(view: &RasterView, x_px: f64, y_px: f64, depth: f64) -> DVec3 {
    let camera = &view.intrinsics;
    let x = (x_px - camera.centre_x_px) / camera.focal_x_px;
    let y = (y_px - camera.centre_y_px) / camera.focal_y_px;
    DVec3::new(x, y, 1.0) * depth
}

pub fn push(
    scene: &mut Gaussians,
    view: &RasterView,
    random: &mut Random,
    mean_in_camera: DVec3,
    scales: [f64; 3],
    opacity: f64,
) {
    let rotation = DQuat::from_axis_angle(random.direction(), random.between(0.0, 6.0));
    scene.means_in_world.push(view.camera_from_world.inverse().transform_point3(mean_in_camera));
    scene.rotations_wxyz.push([rotation.w, rotation.x, rotation.y, rotation.z].map(|c| c as f32));
    scene.scales.push(scales.map(|s| s as f32));
    scene.opacities.push(opacity as f32);
    scene.sh_dc.push([0.0; 3]);
}
