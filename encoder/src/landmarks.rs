//! The map with which a robot finds its own place: features of the photos, with the depth that the splat has at
//! their pixels.

use glam::{DAffine3, DVec2};
use slag_common::{Intrinsics, View};
use slag_locate::{
    Grey, Landmark, MAX_FEATURES, MappingView, Observation, Renderer, Rendering,
    WORKING_BYTES_PER_OBSERVATION, build, code, features,
};

use crate::ingest::{self, IngestError, LoadedImage};
use crate::memory::{MemoryPlan, Phase};
use crate::raster::{LoadedScene, RasterError, RasterView};

const BYTES_IN_SHARD: usize = 24;
/// One landmark per this many Gaussians: 1.98 bytes a Gaussian; headers of shards add less than 0.02.
const LANDMARKS: usize = 33;
const GAUSSIANS: usize = 400;
/// Widest drawing, pixels: splats show no finer detail of a photo.
const MAX_DRAWING_WIDTH_PX: u32 = 1600;

#[derive(Debug, thiserror::Error)]
pub enum LandmarkError {
    #[error(transparent)]
    Photo(#[from] IngestError),
    #[error(transparent)]
    Raster(#[from] RasterError),
}

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

/// Reserves the features of all photos and the lists made of them, a photo with its drawing, and the shards' content.
pub(crate) fn reserve(memory: &mut MemoryPlan, n_views: usize, views: &[View], n_gaussians: usize) {
    let photo_px = views.iter().map(ingest::photo_area_px).max().unwrap_or(0);
    let per_observation = size_of::<Observation>() + WORKING_BYTES_PER_OBSERVATION;
    let n_landmarks = (n_gaussians * LANDMARKS / GAUSSIANS).min(n_views * MAX_FEATURES);
    let lists_bytes = n_views * MAX_FEATURES * per_observation + 2 * n_landmarks * size_of::<Landmark>();
    memory.reserve(Phase::Landmarks, "features of all photos", lists_bytes as u64);
    // The photo, its grey, and five numbers per pixel of the drawing.
    let photo_bytes = photo_px * (ingest::LOADED_BYTES_PER_PX + 4)
        + photo_px.min(u64::from(MAX_DRAWING_WIDTH_PX).pow(2)) * 20;
    let photo_bytes = photo_bytes + slag_locate::working_bytes(photo_px as usize, 1) as u64;
    memory.reserve(Phase::Landmarks, "a photo that is searched", photo_bytes);
    memory.reserve(Phase::Always, "landmarks", (n_landmarks * BYTES_IN_SHARD) as u64);
}

/// Features of a photo that have a place in the scene.
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
    let mut observations = Vec::with_capacity(found.len());
    observations.extend(found.into_iter().filter_map(observation));
    Ok(MappingView { view: number, intrinsics: view.intrinsics, camera_from_world: pose, observations })
}

pub fn landmarks(views: &[MappingView], n_gaussians: usize) -> Vec<Landmark> {
    build(views, n_gaussians * LANDMARKS / GAUSSIANS)
}

#[cfg(test)]
mod tests;
