//! Photo files: formats, and damage that decoders do not report.

mod jpeg;

use std::io::{self, BufRead, BufReader, Seek, SeekFrom};
use std::path::Path;

use image::{DynamicImage, ImageDecoder, ImageError, ImageFormat, ImageReader, Limits, RgbImage};

use crate::files;
use jpeg::Damage;

/// Most bytes of a file's inflated header: colour profile, texts, a row of pixels. JPEG decoders also copy the file.
pub const HEAD_BYTES: u64 = 16 << 20;
/// Brands of HEIF files, which phones write: bytes 8 to 12, after `ftyp`.
const HEIF_BRANDS: &str = "heic heix heim heis hevc hevx mif1 msf1 avif";

#[derive(Debug, thiserror::Error)]
pub enum PhotoError {
    #[error(transparent)]
    StandIn(files::WrongContent),
    #[error("a HEIC or AVIF image; convert the photos to JPEG, for example with heif-convert")]
    Heif,
    #[error("the file ends before its image does; copy the photo again")]
    Cut,
    #[error("a piece of the image is zeros, which no camera writes; copy the photo again")]
    Zeros,
    #[error(
        "its colour profile, its texts or a row of its pixels take more than {HEAD_BYTES} bytes, the limit; give a smaller copy without metadata"
    )]
    Head,
    #[error("{0}; give a JPEG, PNG or WebP that opens elsewhere")]
    Decode(ImageError),
    #[error(transparent)]
    Io(#[from] io::Error),
}

impl From<ImageError> for PhotoError {
    fn from(error: ImageError) -> Self {
        match error {
            ImageError::Limits(_) => Self::Head,
            error => Self::Decode(error),
        }
    }
}

/// Reads everything before the pixels, within [`HEAD_BYTES`].
pub fn head<'a>(input: impl BufRead + Seek + 'a) -> Result<Box<dyn ImageDecoder + 'a>, PhotoError> {
    let mut reader = ImageReader::new(input).with_guessed_format()?;
    let mut limits = Limits::no_limits();
    limits.max_alloc = Some(HEAD_BYTES);
    reader.limits(limits);
    Ok(Box::new(reader.into_decoder()?))
}

/// Width and height of a photo by its header, whatever its name ends in; `None` if it cannot be read.
pub fn size_px(path: &Path) -> Option<(u32, u32)> {
    Some(head(BufReader::new(files::open(path).ok()?)).ok()?.dimensions())
}

/// Opens a photo as [`head`] does; refuses other files, and damage that decoders would fill with grey or noise.
pub fn open<'a>(mut input: impl BufRead + Seek + 'a) -> Result<Box<dyn ImageDecoder + 'a>, PhotoError> {
    let start = input.fill_buf()?;
    if let Some(found) = files::stand_in(start) {
        return Err(PhotoError::StandIn(found));
    }
    let brand = start.get(4..12).and_then(|kind| kind.strip_prefix(b"ftyp"));
    if brand.is_some_and(|brand| HEIF_BRANDS.split(' ').any(|known| known.as_bytes() == brand)) {
        return Err(PhotoError::Heif);
    }
    let stated_bytes = start.get(4..8).map_or(0, |len| u32::from_le_bytes([len[0], len[1], len[2], len[3]]));
    let damage = match image::guess_format(start) {
        Ok(ImageFormat::Jpeg) => jpeg::damage(&mut input)?,
        // A RIFF chunk, after its header of eight bytes; some writers count a padding byte.
        Ok(ImageFormat::WebP) => {
            let is_cut = input.seek(SeekFrom::End(0))? + 1 < u64::from(stated_bytes) + 8;
            is_cut.then_some(Damage::Cut)
        }
        _ => None,
    };
    match damage {
        Some(Damage::Cut) => return Err(PhotoError::Cut),
        Some(Damage::Zeros) => return Err(PhotoError::Zeros),
        None => input.rewind()?,
    }
    head(input)
}

/// Returns the colours of a photo and, if some pixels are transparent, which are opaque (at least half). Transparent
/// pixels become black: their colours are leftovers of editing, or noise.
pub fn colours(photo: DynamicImage) -> (RgbImage, Option<Vec<bool>>) {
    let opaque = photo.color().has_alpha().then(|| opaque_pixels(&photo)).filter(|all| all.contains(&false));
    let mut colours = photo.into_rgb8();
    if let Some(opaque) = &opaque {
        let hidden = colours.pixels_mut().zip(opaque).filter(|(_, opaque)| !**opaque);
        hidden.for_each(|(pixel, _)| pixel.0 = [0; 3]);
    }
    (colours, opaque)
}

fn opaque_pixels(photo: &DynamicImage) -> Vec<bool> {
    photo.to_luma_alpha8().pixels().map(|pixel| pixel.0[1] >= 128).collect()
}

#[cfg(test)]
mod tests;
