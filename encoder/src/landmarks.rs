//! The map with which a robot finds its own place: features of the photos, with the depth that the splat has at
//! their pixels.

use glam::{DAffine3, DVec2};
use slag_common::{Intrinsics, View};
use slag_locate::{
    Grey, Landmark, MAX_FEATURES, MappingView, Observation, Renderer, Rendering, build, code, features,
};

use crate::ingest::{self, IngestError, LoadedImage};
use crate::raster::{LoadedScene, RasterError, RasterView};

/// Landmarks for so many Gaussians: at 24 bytes 1.98 bytes a Gaussian; headers of shards add less than 0.02.
const LANDMARKS: usize = 33;
const GAUSSIANS: usize = 400;
/// Widest drawing, pixels: splats show no more of a photo than that.
const MAX_DRAWING_WIDTH_PX: u32 = 1600;

#[derive(Debug, thiserror::Error)]
pub enum LandmarkError {
    #[error(transparent)]
    Photo(#[from] IngestError),
    #[error(transparent)]
    Raster(#[from] RasterError),
}

/// A scene that can be drawn.
pub struct SceneRenderer<'a>(pub &'a dyn LoadedScene);

impl SceneRenderer<'_> {
    fn draw(&self, camera_from_world: &DAffine3, intrinsics: &Intrinsics) -> Result<Rendering, RasterError> {
        let view = RasterView { camera_from_world: *camera_from_world, intrinsics: *intrinsics };
        Ok(Rendering::of(&self.0.draw(&view, [0.5; 3])?))
    }
}

impl Renderer for SceneRenderer<'_> {
    fn render(&self, camera_from_world: &DAffine3, intrinsics: &Intrinsics) -> Option<Rendering> {
        let told = |error: &RasterError| tracing::warn!("a pose is not verified: {error}");
        self.draw(camera_from_world, intrinsics).inspect_err(told).ok()
    }
}

/// Returns the features of a photo that have a place in the scene.
pub fn observe(scene: &dyn LoadedScene, number: u16, view: &View) -> Result<MappingView, LandmarkError> {
    let LoadedImage { view, image, .. } = ingest::load_image(view)?;
    let grey = Grey::from_rgb8(image.width() as usize, image.height() as usize, image.as_raw());
    let width_px = view.intrinsics.width_px.min(MAX_DRAWING_WIDTH_PX);
    let (intrinsics, pose) = (view.intrinsics.scaled_to_width(width_px), view.camera_from_world);
    let (found, drawn) =
        rayon::join(|| features(&grey, MAX_FEATURES), || SceneRenderer(scene).draw(&pose, &intrinsics));
    let drawn = drawn?;
    let scale = f64::from(width_px) / f64::from(view.intrinsics.width_px);
    let observation = |feature: slag_locate::Feature| {
        let at = DVec2::from(feature.at);
        let depth = drawn.depth_at(at * scale)?;
        let point_in_world = slag_locate::point_in_world(&pose, &view.intrinsics, at, depth);
        Some(Observation { at, point_in_world, code: code(&feature.descriptor) })
    };
    let observations = found.into_iter().filter_map(observation).collect();
    Ok(MappingView { view: number, intrinsics: view.intrinsics, camera_from_world: pose, observations })
}

pub fn landmarks(views: &[MappingView], n_gaussians: usize) -> Vec<Landmark> {
    build(views, n_gaussians * LANDMARKS / GAUSSIANS)
}
