//! The errors of a check.

use crate::ingest::IngestError;
use crate::raster::RasterError;

/// Reason why a check fails.
#[derive(Debug, thiserror::Error)]
pub enum CheckError {
    /// There are no views.
    #[error("no views to check; give at least one photo with its pose")]
    NoViews,
    /// A photo cannot be loaded.
    #[error(transparent)]
    Photo(#[from] IngestError),
    /// A photo and its camera differ in size.
    #[error(
        "view {view}: the photo has {} x {} px but its camera {} x {} px; give the photo that the camera describes",
        image_px[0], image_px[1], camera_px[0], camera_px[1]
    )]
    ImageSize {
        /// Name of the view.
        view: String,
        /// Width and height of the photo.
        image_px: [u32; 2],
        /// Width and height of the camera.
        camera_px: [u32; 2],
    },
    /// A view cannot be drawn.
    #[error("view {view}: {source}")]
    Raster {
        /// Name of the view.
        view: String,
        /// The reason.
        source: RasterError,
    },
    /// A picture cannot be encoded.
    #[error("view {view}: cannot encode its picture ({source}); choose a smaller width")]
    Encode {
        /// Name of the view.
        view: String,
        /// The reason.
        source: image::ImageError,
    },
    /// A picture cannot be written.
    #[error("{0}; choose another folder for the pictures")]
    Write(#[from] std::io::Error),
}
