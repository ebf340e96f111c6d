//! Errors of checks.

use crate::ingest::IngestError;
use crate::raster::RasterError;

#[derive(Debug, thiserror::Error)]
pub enum CheckError {
    #[error("no views to check; give at least one photo with its pose")]
    NoViews,
    #[error("none of the {n_views} sampled photos can be read, the first: {first}")]
    NoPhotos { n_views: usize, first: IngestError },
    #[error(
        "view {view}: the photo has {} x {} px but its camera {} x {} px; give the photo that the camera describes",
        image_px[0], image_px[1], camera_px[0], camera_px[1]
    )]
    ImageSize { view: String, image_px: [u32; 2], camera_px: [u32; 2] },
    #[error("view {view}: {source}")]
    Raster { view: String, source: RasterError },
    #[error(transparent)]
    Scene(#[from] RasterError),
    #[error("view {view}: cannot encode its picture ({source}); choose a smaller width")]
    Encode { view: String, source: image::ImageError },
    #[error("{0}; choose another folder for the pictures")]
    Write(#[from] std::io::Error),
}
