//! Matches a photo with a rendering of the scene.

use std::borrow::Cow;

use glam::{DAffine3, DVec2, DVec3};
use slag_common::Intrinsics;
use slag_math::dot;
use slag_raster::Drawing;

use crate::features::{Feature, MAX_FEATURES, MAX_PX, features};
use crate::grey::Grey;
use crate::patches;
use crate::pose::Match;

/// Largest ratio to the second best distance (Lowe 2004, 7.1): high, because poses are near and most features match.
const MAX_RATIO: f32 = 0.9;
/// Largest relative depth step between neighbouring pixels of a surface.
const MAX_DEPTH_STEP: f32 = 0.05;

/// Opacity from which a pixel shows a surface.
const MIN_COVERAGE: f32 = 0.5;
/// An image of the scene, with the camera z of each pixel; 0 where there is no surface.
pub struct Rendering {
    pub grey: Grey,
    pub depth: Vec<f32>,
}

pub trait Renderer {
    /// Draws the view of an ideal pinhole; `None` if that is impossible.
    fn render(&self, camera_from_world: &DAffine3, intrinsics: &Intrinsics) -> Option<Rendering>;
}

impl Rendering {
    pub fn of(drawing: &Drawing) -> Self {
        let surface = drawing.depth.iter().zip(&drawing.coverage);
        let depth =
            surface.map(|(depth, coverage)| if *coverage >= MIN_COVERAGE { *depth } else { 0.0 }).collect();
        let bytes: Vec<u8> = drawing.rgb.iter().map(|v| (v * 255.0).round() as u8).collect();
        let grey = Grey::from_rgb8(drawing.width_px as usize, drawing.height_px as usize, &bytes);
        Self { grey, depth }
    }

    /// Camera z at a position; `None` outside the image, without a surface and at its edge.
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

/// Returns the point at a pixel and depth of an ideal pinhole.
pub fn point_in_world(camera_from_world: &DAffine3, intrinsics: &Intrinsics, at: DVec2, depth: f64) -> DVec3 {
    let [x, y] = intrinsics.distorted_from_pixel(at.to_array());
    camera_from_world.inverse().transform_point3(DVec3::new(x, y, 1.0) * depth)
}

/// A photo at the size for comparison with renderings.
pub(crate) struct Compared<'a> {
    photo: Cow<'a, Grey>,
    /// Width of its pixels, in pixels of the photo.
    px: f64,
    /// Pixels of a rendering per pixel of the photo.
    scale: f64,
    /// Camera of renderings at its pose.
    pinhole: Intrinsics,
    /// The photo's features, and their positions in an ideal pinhole's image, pixels of the photo.
    features: &'a [Feature],
    at: &'a [DVec2],
}

impl<'a> Compared<'a> {
    pub(crate) fn new(
        photo: &'a Grey,
        intrinsics: &Intrinsics,
        features: &'a [Feature],
        at: &'a [DVec2],
    ) -> Self {
        let (photo, px) = photo.limited(MAX_PX);
        let pinhole = intrinsics.without_distortion().scaled_to_width(photo.width as u32);
        let scale = f64::from(pinhole.width_px) / f64::from(intrinsics.width_px);
        Self { photo, px: f64::from(px), scale, pinhole, features, at }
    }

    pub(crate) fn render(&self, renderer: &dyn Renderer, camera_from_world: &DAffine3) -> Option<Rendered> {
        let rendering = renderer.render(camera_from_world, &self.pinhole)?;
        Some(Rendered { rendering, camera_from_world: *camera_from_world, pinhole: self.pinhole })
    }

    fn matched(&self, rendered: &Rendered, feature: usize, landmark: usize, pixel: DVec2) -> Option<Match> {
        let point_in_world = rendered.point_at(pixel)?;
        Some(Match { feature, landmark, at: self.at[feature], point_in_world })
    }

    /// Matches features of photo and rendering that are each other's best.
    pub(crate) fn match_features(&self, rendered: &Rendered) -> Vec<Match> {
        let photo = self.features;
        let in_rendering = features(&rendered.rendering.grey, MAX_FEATURES);
        let n = in_rendering.len();
        let mut products = vec![0.0; photo.len() * n];
        for (row, feature) in products.chunks_exact_mut(n.max(1)).zip(photo) {
            let of_row = row.iter_mut().zip(&in_rendering);
            of_row.for_each(|(p, r)| *p = dot(&feature.descriptor, &r.descriptor));
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
            let place = in_rendering[best].at;
            let second = (0..n).filter(|r| in_rendering[*r].at != place).map(|r| row[r]).fold(-1.0, f32::max);
            let length = |product: f32| (2.0 - 2.0 * product).max(0.0).sqrt();
            let is_match =
                best_of_rendered[best] == feature && length(row[best]) < MAX_RATIO * length(second);
            is_match.then(|| self.matched(rendered, feature, best, DVec2::from(place))).flatten()
        };
        (0..photo.len()).filter_map(one).collect()
    }

    /// Matches patches of the photo with a rendering; also returns how many were tried.
    pub(crate) fn match_patches(&self, rendered: &Rendered) -> (Vec<Match>, usize) {
        let at: Vec<DVec2> = self.at.iter().map(|at| *at * self.scale).collect();
        let found = patches::find(&self.photo, self.px, self.features, &at, &rendered.rendering.grey);
        let matched =
            found.matches.iter().filter_map(|(feature, pixel)| self.matched(rendered, *feature, 0, *pixel));
        (matched.collect(), found.n_tried)
    }
}

pub(crate) struct Rendered {
    rendering: Rendering,
    camera_from_world: DAffine3,
    pinhole: Intrinsics,
}

impl Rendered {
    fn point_at(&self, pixel: DVec2) -> Option<DVec3> {
        let depth = self.rendering.depth_at(pixel)?;
        Some(point_in_world(&self.camera_from_world, &self.pinhole, pixel, depth))
    }
}
