//! A photo matched with a rendering of the scene.

use glam::{DAffine3, DVec2, DVec3};
use slag_common::Intrinsics;
use slag_math::dot;
use slag_raster::Drawing;

use crate::features::{Feature, MAX_FEATURES, features};
use crate::grey::Grey;
use crate::pose::Match;

/// Largest distance of descriptors, as a share of the second best's (Lowe 2004, 7.1): poses are near, so most
/// features have their match.
const MAX_RATIO: f32 = 0.9;
/// Largest step of the depth between neighbouring pixels of a surface, as a share of the depth.
const MAX_DEPTH_STEP: f32 = 0.05;

/// Opacity of a pixel from which its depth is a surface's.
const MIN_COVERAGE: f32 = 0.5;
/// Widest rendering, pixels: splats show no more of a photo than that.
pub const MAX_RENDERING_WIDTH_PX: u32 = 1600;

/// A picture of the scene, with the camera z of each pixel; 0 where there is no surface.
pub struct Rendering {
    pub grey: Grey,
    pub depth: Vec<f32>,
}

/// Draws the scene.
pub trait Renderer {
    /// Draws what an ideal pinhole sees; `None` where that cannot be drawn.
    fn render(&self, camera_from_world: &DAffine3, intrinsics: &Intrinsics) -> Option<Rendering>;
}

impl Rendering {
    /// Takes the picture and the surfaces of a drawing.
    pub fn of(drawing: &Drawing) -> Self {
        let surface = drawing.depth.iter().zip(&drawing.coverage);
        let depth =
            surface.map(|(depth, coverage)| if *coverage >= MIN_COVERAGE { *depth } else { 0.0 }).collect();
        let bytes: Vec<u8> = drawing.rgb.iter().map(|v| (v * 255.0).round() as u8).collect();
        let grey = Grey::from_rgb8(drawing.width_px as usize, drawing.height_px as usize, &bytes);
        Self { grey, depth }
    }

    /// Returns the camera z at a place; `None` beside the picture, without a surface and at the edge of one.
    pub fn depth_at(&self, at: DVec2) -> Option<f64> {
        let Grey { width, height, .. } = self.grey;
        let (x, y) = (at.x.floor() as usize, at.y.floor() as usize);
        if at.min_element() < 1.0 || x + 1 >= width || y + 1 >= height {
            return None;
        }
        let around =
            [y - 1, y, y + 1].into_iter().flat_map(|y| [x - 1, x, x + 1].map(|x| self.depth[y * width + x]));
        let (near, far) = around.fold((f32::INFINITY, 0.0f32), |(n, f), d| (n.min(d), f.max(d)));
        (near > 0.0 && far - near <= MAX_DEPTH_STEP * near).then(|| f64::from(self.depth[y * width + x]))
    }
}

/// Returns the point that a pixel of an ideal pinhole shows at a depth.
pub fn point_in_world(camera_from_world: &DAffine3, intrinsics: &Intrinsics, at: DVec2, depth: f64) -> DVec3 {
    let [x, y] = intrinsics.distorted_from_pixel(at.to_array());
    camera_from_world.inverse().transform_point3(DVec3::new(x, y, 1.0) * depth)
}

/// Matches the features of a photo with those of a rendering at a pose, each the other's best.
pub(crate) fn match_rendering(
    renderer: &dyn Renderer,
    camera_from_world: &DAffine3,
    intrinsics: &Intrinsics,
    photo: &[Feature],
    at: &[DVec2],
) -> Vec<Match> {
    let width_px = intrinsics.width_px.min(MAX_RENDERING_WIDTH_PX);
    let pinhole = intrinsics.without_distortion().scaled_to_width(width_px);
    let Some(rendering) = renderer.render(camera_from_world, &pinhole) else { return Vec::new() };
    let rendered = features(&rendering.grey, MAX_FEATURES);
    let n = rendered.len();
    let mut products = vec![0.0; photo.len() * n];
    for (row, feature) in products.chunks_exact_mut(n.max(1)).zip(photo) {
        row.iter_mut().zip(&rendered).for_each(|(p, r)| *p = dot(&feature.descriptor, &r.descriptor));
    }
    let best_of_rendered: Vec<usize> = (0..n)
        .map(|r| {
            (0..photo.len())
                .fold(0, |best, f| if products[f * n + r] > products[best * n + r] { f } else { best })
        })
        .collect();
    let one = |feature: usize| {
        let row = &products[feature * n..][..n];
        let best = (0..n).max_by(|a, b| row[*a].total_cmp(&row[*b]))?;
        // Another orientation of the same keypoint is no rival.
        let place = rendered[best].at;
        let second = (0..n).filter(|r| rendered[*r].at != place).map(|r| row[r]).fold(-1.0, f32::max);
        let length = |product: f32| (2.0 - 2.0 * product).max(0.0).sqrt();
        let is_match = best_of_rendered[best] == feature && length(row[best]) < MAX_RATIO * length(second);
        let pixel = DVec2::from(place);
        let depth = is_match.then(|| rendering.depth_at(pixel)).flatten()?;
        let point_in_world = point_in_world(camera_from_world, &pinhole, pixel, depth);
        Some(Match { feature, landmark: best, at: at[feature], point_in_world })
    };
    (0..photo.len()).filter_map(one).collect()
}
