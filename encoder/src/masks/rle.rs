//! COCO's run-length encoding of masks.
//!
//! Runs alternate between outside and inside, column by column. Their compact text has signed base-32 digits, least
//! significant first; from the third run on, it holds the difference to the run two before. This is the format of the
//! COCO API (`maskApi.c`), "similar to LEB128" to its authors.

use serde::Serialize;

use super::mask::{Bits, BoxPx, Mask};

/// Most digits of a signed 32-bit number, at 5 bits per digit.
const MAX_DIGITS: u32 = 7;

/// Most crossings of a polygon with columns of pixels, so that no file takes all memory.
const MAX_CROSSINGS: usize = 1 << 24;

#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Rle {
    width_px: u32,
    height_px: u32,
    /// Run lengths, outside first; their sum is the number of pixels.
    counts: Vec<u32>,
}

#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RleError {
    #[error("runs add up to {found} pixels, expected {expected}; encode the mask again")]
    Sum { expected: u64, found: u64 },
    #[error("size {width_px} x {height_px} px, expected at most 65535 px per side; encode the mask again")]
    Size { width_px: u32, height_px: u32 },
    #[error("run {index} is out of range; encode the mask again")]
    Run { index: usize },
    #[error("counts: invalid digit at byte {offset_bytes}; encode the mask again")]
    Digit { offset_bytes: usize },
    #[error(
        "{n_polygons} polygons of an image whose width and height the file does not state; state them in `images`, or \
         convert the polygons with annToRLE of pycocotools"
    )]
    Polygons { n_polygons: usize },
    #[error(
        "polygon {index} has {n} numbers, expected x and y of 3 to a million points; draw the mask again"
    )]
    Polygon { index: usize, n: usize },
}

impl Rle {
    /// Takes runs in column-major order, outside first.
    ///
    /// # Errors
    /// [`RleError::Size`] if the image is too large to count its pixels in 32 bits, [`RleError::Sum`] unless the runs
    /// fill the image exactly.
    pub fn from_counts(width_px: u32, height_px: u32, counts: Vec<u32>) -> Result<Self, RleError> {
        if width_px.max(height_px) > u32::from(u16::MAX) {
            return Err(RleError::Size { width_px, height_px });
        }
        let expected = u64::from(width_px) * u64::from(height_px);
        // Fewer than 2^32 runs of 32 bits cannot overflow 64 bits.
        let found = counts.iter().map(|count| u64::from(*count)).sum();
        if found == expected {
            Ok(Self { width_px, height_px, counts })
        } else {
            Err(RleError::Sum { expected, found })
        }
    }

    /// Takes polygons, each `x0, y0, x1, y1, ...` in pixels from the upper left corner. A pixel is inside if its middle
    /// is, by the even-odd rule, in any of them.
    ///
    /// # Errors
    /// [`RleError::Size`]; [`RleError::Polygon`] for one that is no polygon.
    pub fn from_polygons(width_px: u32, height_px: u32, polygons: &[Vec<f64>]) -> Result<Self, RleError> {
        if width_px.max(height_px) > u32::from(u16::MAX) {
            return Err(RleError::Size { width_px, height_px });
        }
        let pixel = |at: f64, n: u32| (at - 0.5).ceil().clamp(0.0, f64::from(n)) as u32;
        // First pixel and the one after the last, column-major.
        let mut runs: Vec<(u32, u32)> = Vec::new();
        for (index, polygon) in polygons.iter().enumerate() {
            let points: Vec<[f64; 2]> = polygon.chunks_exact(2).map(|point| [point[0], point[1]]).collect();
            let invalid = RleError::Polygon { index, n: polygon.len() };
            if polygon.len() % 2 != 0 || points.len() < 3 || polygon.iter().any(|value| !value.is_finite()) {
                return Err(invalid);
            }
            let mut crossings: Vec<(u32, f64)> = Vec::new();
            for (a, b) in points.iter().zip(points.iter().cycle().skip(1)) {
                let ([x0, y0], [x1, y1]) = if a[0] < b[0] { (*a, *b) } else { (*b, *a) };
                let y_of = |column: u32| y0 + (f64::from(column) + 0.5 - x0) / (x1 - x0) * (y1 - y0);
                crossings
                    .extend((pixel(x0, width_px)..pixel(x1, width_px)).map(|column| (column, y_of(column))));
                if crossings.len() > MAX_CROSSINGS {
                    return Err(invalid);
                }
            }
            // A closed outline crosses each column an even number of times.
            crossings.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
            let run = |pair: &[(u32, f64)]| {
                let [first, after] =
                    [pair[0].1, pair[1].1].map(|y| pair[0].0 * height_px + pixel(y, height_px));
                (first < after).then_some((first, after))
            };
            runs.extend(crossings.chunks_exact(2).filter_map(run));
        }
        runs.sort_unstable();
        let (mut counts, mut position) = (Vec::new(), 0);
        for (first, after) in runs {
            match counts.last_mut() {
                Some(inside) if first <= position => *inside += after.saturating_sub(position),
                _ => counts.extend([first - position, after - first]),
            }
            position = position.max(after);
        }
        counts.push(width_px * height_px - position);
        Self::from_counts(width_px, height_px, counts)
    }

    pub fn from_text(width_px: u32, height_px: u32, text: &str) -> Result<Self, RleError> {
        let mut counts: Vec<u32> = Vec::new();
        let mut bytes = text.bytes().enumerate();
        while let Some((start, first)) = bytes.next() {
            let mut value = 0_i64;
            let mut digit = (start, first);
            for position in 0.. {
                let (offset_bytes, byte) = digit;
                if position == MAX_DIGITS || !(48..48 + 64).contains(&byte) {
                    return Err(RleError::Digit { offset_bytes });
                }
                let bits = i64::from(byte - 48);
                value |= (bits & 0x1F) << (5 * position);
                if bits & 0x20 == 0 {
                    if bits & 0x10 != 0 {
                        value |= -1 << (5 * (position + 1));
                    }
                    break;
                }
                digit = bytes.next().ok_or(RleError::Digit { offset_bytes })?;
            }
            let index = counts.len();
            let base = if index > 2 { i64::from(counts[index - 2]) } else { 0 };
            counts.push(u32::try_from(base + value).map_err(|_| RleError::Run { index })?);
        }
        Self::from_counts(width_px, height_px, counts)
    }

    pub fn size_px(&self) -> [u32; 2] {
        [self.width_px, self.height_px]
    }

    /// First pixel (column-major) and length of each run inside the mask.
    fn runs_inside(&self) -> impl Iterator<Item = (u64, u64)> {
        let mut position = 0;
        self.counts.iter().enumerate().filter_map(move |(index, count)| {
            let start = position;
            position += u64::from(*count);
            (index % 2 == 1 && *count > 0).then_some((start, u64::from(*count)))
        })
    }

    /// Tight bounding box; `None` for an empty mask.
    pub fn box_px(&self) -> Option<BoxPx> {
        let height = u64::from(self.height_px);
        let mut box_px = BoxPx { x0: u32::MAX, y0: u32::MAX, x1: 0, y1: 0 };
        for (start, len) in self.runs_inside() {
            let last = start + len - 1;
            box_px.x0 = box_px.x0.min((start / height) as u32);
            box_px.x1 = box_px.x1.max((last / height) as u32 + 1);
            if start / height == last / height {
                box_px.y0 = box_px.y0.min((start % height) as u32);
                box_px.y1 = box_px.y1.max((last % height) as u32 + 1);
            } else {
                // A run past the foot of a column contains its last row and the next one's first.
                (box_px.y0, box_px.y1) = (0, self.height_px);
            }
        }
        (box_px.x1 > 0).then_some(box_px)
    }

    /// Decodes to a mask of level 0; `None` if empty. Allocates one bit per pixel of [`Rle::box_px`].
    pub fn to_mask(&self) -> Option<Mask> {
        let box_px = self.box_px()?;
        let height = u64::from(self.height_px);
        let mut inside = Bits::of(false, box_px.area_px() as usize);
        let mut area_px = 0;
        for (start, len) in self.runs_inside() {
            for pixel in start..start + len {
                inside.set(box_px.place_of((pixel / height) as u32, (pixel % height) as u32), true);
            }
            area_px += len as u32;
        }
        Some(Mask { box_px, inside, area_px, level: 0 })
    }
}
