//! Errors and output files of generation.

use std::path::{Path, PathBuf};

use image::RgbImage;
use slag_common::splat::SplatError;
use slag_encoder::raster::{Drawing, RasterView};

use super::grammar::GrammarError;

/// Error of writing generated data.
#[derive(Debug, thiserror::Error)]
pub enum GenerateError {
    /// A file cannot be written.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// The splat cannot be written.
    #[error(transparent)]
    Splat(#[from] SplatError),
    /// The object files cannot be used.
    #[error(transparent)]
    Grammar(#[from] GrammarError),
    /// A picture cannot be written.
    #[error("{}: {source}", path.display())]
    Image {
        /// The picture.
        path: PathBuf,
        /// The reason.
        source: image::ImageError,
    },
}

/// Writes values as an npy file.
pub(super) fn write_npy<T: npyz::AutoSerialize + Copy>(
    path: &Path,
    shape: &[u64],
    values: &[T],
) -> std::io::Result<()> {
    use npyz::WriterBuilder;
    let mut out = std::io::BufWriter::new(fs_err::File::create(path)?);
    let mut writer = npyz::WriteOptions::new().default_dtype().shape(shape).writer(&mut out).begin_nd()?;
    writer.extend(values.iter().copied())?;
    writer.finish()?;
    std::io::Write::flush(&mut out)
}

/// Returns a drawing as 8-bit RGB.
pub(crate) fn to_image(drawing: &Drawing, view: &RasterView) -> RgbImage {
    let bytes = drawing.rgb.iter().map(|c| (c.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    RgbImage::from_raw(view.intrinsics.width_px, view.intrinsics.height_px, bytes)
        .expect("a drawing has three values per pixel of its view")
}
