//! Ids of mask images.

use std::collections::BTreeSet;
use std::io::{BufRead, BufReader};
use std::path::Path;

use slag_common::files;

use super::coco::check_size;
use crate::segment::segmenter::{SegmentError, SegmentInput};

/// Memory for the PNG decoder beside the pixels.
const PNG_OVERHEAD_BYTES: usize = 1 << 20;

/// Least number of values in the seams of a blurred image.
const MIN_SOFT: usize = 8;
/// Longest run of pixels in a seam.
const MAX_SEAM_PX: usize = 2;

/// Number of values in the seams of a mask image that was blurred, drawn with antialiasing or enlarged smoothly;
/// `None` for one of ids. In seams, short runs have values between those beside them.
pub(super) fn n_soft(ids: &[u32], width: usize) -> Option<usize> {
    let mut values = BTreeSet::new();
    let (mut n_between, mut n_runs) = (0, 0);
    for row in ids.chunks_exact(width.max(1)) {
        let runs: Vec<&[u32]> = row.chunk_by(u32::eq).collect();
        for sides in runs.windows(3) {
            let [low, value, high] = [sides[0][0], sides[1][0], sides[2][0]];
            n_runs += 1;
            if sides[1].len() <= MAX_SEAM_PX && (low.min(high) < value && value < low.max(high)) {
                n_between += 1;
                values.insert(value);
            }
        }
    }
    (values.len() >= MIN_SOFT && 4 * n_between > n_runs).then_some(values.len())
}

/// Ids of a PNG of the photo's size, row-major; of a palette, the indices.
pub(super) fn read_ids(path: &Path, input: &SegmentInput<'_>) -> Result<Vec<u32>, SegmentError> {
    let failed = |source| SegmentError::Png { path: path.to_owned(), source };
    let n_pixels = input.image.width() as usize * input.image.height() as usize;
    let limits = png::Limits { bytes: 2 * n_pixels + PNG_OVERHEAD_BYTES };
    let mut file = BufReader::new(files::open(path)?);
    if let Some((what, advice)) = files::stand_in(file.fill_buf()?) {
        return Err(SegmentError::StandIn { path: path.to_owned(), what, advice });
    }
    let mut decoder = png::Decoder::new_with_limits(file, limits);
    decoder.set_transformations(png::Transformations::IDENTITY);
    let (width_px, height_px) = decoder.read_header_info().map_err(failed)?.size();
    check_size(path, [width_px, height_px], input)?;
    let mut reader = decoder.read_info().map_err(failed)?;
    let (color, depth) = reader.output_color_type();
    let found = match color {
        png::ColorType::Grayscale | png::ColorType::Indexed => None,
        png::ColorType::Rgb => Some("RGB"),
        png::ColorType::GrayscaleAlpha => Some("gray and alpha"),
        png::ColorType::Rgba => Some("RGBA"),
    };
    if let Some(found) = found {
        return Err(SegmentError::NotIds { path: path.to_owned(), found });
    }
    // Bounded: at most 16 bits per pixel of the photo's size.
    let mut bytes = vec![0; reader.output_buffer_size().unwrap_or(0)];
    let frame = reader.next_frame(&mut bytes).map_err(failed)?;
    check_size(path, [frame.width, frame.height], input)?;

    let mut ids = Vec::with_capacity(n_pixels);
    let bits = depth as usize;
    for row in bytes.chunks_exact(frame.line_size.max(1)).take(height_px as usize) {
        match bits {
            16 => {
                ids.extend(row.chunks_exact(2).map(|pair| u32::from(u16::from_be_bytes([pair[0], pair[1]]))))
            }
            8 => ids.extend(row.iter().map(|byte| u32::from(*byte))),
            // Several pixels per byte, the leftmost in the highest bits; each row starts at a byte.
            _ => ids.extend((0..width_px as usize).map(|x| {
                let shift = 8 - bits - x * bits % 8;
                u32::from(row[x * bits / 8] >> shift) & ((1 << bits) - 1)
            })),
        }
    }
    Ok(ids)
}
