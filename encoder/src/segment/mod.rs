//! Stage 1: masks of an image, and the partition of the image that they make.

mod given;
mod graph;
mod noise;
mod regions;
mod rle;
mod sam;

use std::io;
use std::path::PathBuf;

use image::RgbImage;
use slag_common::View;
use slag_models::session::SessionError;

use crate::ingest::{LoadedImage, Undistorter};

pub use given::GivenMasks;
pub use graph::{GraphSegmenter, GraphSettings};
pub use noise::{MaskNoise, NoisyMasks};
pub use regions::{absorb_slivers, border_share, partition};
pub use rle::{Rle, RleError};
pub use sam::{SamSegmenter, SamSettings};

/// Most pixels that the boxes of a view's masks may have in all; a byte each.
const MAX_MASK_BYTES: u64 = 1 << 30;

/// Finds the masks of an image.
pub trait Segmenter: Sync {
    /// Returns what identifies the segmenter's results: its method and every parameter of it.
    fn name(&self) -> &str;

    /// Returns whether it looks at [`SegmentInput::depth`], which takes a drawing of the scene.
    fn wants_depth(&self) -> bool {
        false
    }

    /// Returns how many images a model or device of its own works on at once; `None` on the processor.
    fn n_lanes(&self) -> Option<usize> {
        None
    }

    /// Returns the masks of an image; they may overlap.
    ///
    /// # Errors
    /// [`SegmentError`] if masks cannot be made or read.
    fn segment(&self, input: &SegmentInput<'_>) -> Result<Vec<Mask>, SegmentError>;
}

/// What a segmenter may look at.
#[derive(Clone, Copy, Debug)]
pub struct SegmentInput<'a> {
    /// The view, its intrinsics those of `image`: an ideal pinhole.
    pub view: &'a View,
    /// The photo, free of distortion.
    pub image: &'a RgbImage,
    /// Pixels that show something, row-major; `None` where all do.
    pub valid: Option<&'a [bool]>,
    /// How the photo was freed of distortion, for masks that were made before.
    pub undistorter: Option<&'a Undistorter>,
    /// The scene's own depth, camera z per pixel of `image`, row-major; 0 or NaN where there is none.
    pub depth: Option<&'a [f32]>,
}

impl<'a> SegmentInput<'a> {
    /// Returns the input that a loaded photo makes, with depth or without.
    pub fn new(loaded: &'a LoadedImage, depth: Option<&'a [f32]>) -> Self {
        Self {
            view: &loaded.view,
            image: &loaded.image,
            valid: loaded.valid.as_deref(),
            undistorter: loaded.undistorter.as_ref(),
            depth,
        }
    }
}

/// Why masks could not be made or read.
#[derive(Debug, thiserror::Error)]
pub enum SegmentError {
    /// A file could not be read; the message has its path.
    #[error("{0}; check that the file exists and may be read")]
    Io(#[from] io::Error),
    /// A mask image is damaged.
    #[error("{}: {source}; write the mask image again", path.display())]
    Png {
        /// The file.
        path: PathBuf,
        /// The decoder's reason.
        #[source]
        source: png::DecodingError,
    },
    /// A mask image has colours instead of ids.
    #[error("{}: {found} pixels; give ids: a PNG of 8 or 16 bit gray, or with a palette", path.display())]
    NotIds {
        /// The file.
        path: PathBuf,
        /// The kind of its pixels.
        found: &'static str,
    },
    /// A mask file is not JSON of the expected form.
    #[error(
        "{}: {source}; expected SAM's list of masks, each with segmentation {{size, counts}}, or a COCO data set",
        path.display()
    )]
    Json {
        /// The file.
        path: PathBuf,
        /// Line, column and reason.
        #[source]
        source: serde_json::Error,
    },
    /// A mask of a JSON file cannot be used.
    #[error("{}: mask {index}: {source}", path.display())]
    Rle {
        /// The file.
        path: PathBuf,
        /// Position in the file's list, counted from 0.
        index: usize,
        /// The reason.
        #[source]
        source: RleError,
    },
    /// A mask is of another size than its image.
    #[error(
        "{}: masks of {} x {} px, but the image of view {view:?} is {} x {} px; make the masks from these images",
        path.display(), found_px[0], found_px[1], expected_px[0], expected_px[1]
    )]
    Size {
        /// The file.
        path: PathBuf,
        /// The view.
        view: String,
        /// Width and height of the masks.
        found_px: [u32; 2],
        /// Width and height of the image.
        expected_px: [u32; 2],
    },
    /// The masks of one view need more memory than is allowed.
    #[error(
        "{}: the masks of one view cover more than {limit_bytes} pixels in all; leave out the specks or give fewer masks",
        path.display()
    )]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// The limit: the sum over the masks of their boxes' areas.
        limit_bytes: u64,
    },
    /// A segmentation model failed: no fault of the image.
    #[error(transparent)]
    Model(Box<SessionError>),
    /// A model finds more masks than is allowed.
    #[error(
        "view {view:?}: the masks found take more than {limit_bytes} bytes; ask for fewer points, or be stricter          with --sam-predicted-iou and --sam-stability"
    )]
    TooManyMasks {
        /// The view.
        view: String,
        /// The limit.
        limit_bytes: u64,
    },
}

impl From<SessionError> for SegmentError {
    fn from(error: SessionError) -> Self {
        Self::Model(Box::new(error))
    }
}

/// A box in pixels: `x0 <= x < x1`, `y0 <= y < y1`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BoxPx {
    /// Left, inclusive.
    pub x0: u32,
    /// Top, inclusive.
    pub y0: u32,
    /// Right, exclusive.
    pub x1: u32,
    /// Bottom, exclusive.
    pub y1: u32,
}

impl BoxPx {
    /// Returns the width in pixels.
    pub fn width_px(&self) -> u32 {
        self.x1 - self.x0
    }

    /// Returns the height in pixels.
    pub fn height_px(&self) -> u32 {
        self.y1 - self.y0
    }
}

/// One mask of an image: a set of pixels, which other masks may overlap.
#[derive(Clone, Debug, PartialEq)]
pub struct Mask {
    /// The tight box around its pixels.
    pub box_px: BoxPx,
    /// Membership, row-major within the box.
    pub inside: Vec<bool>,
    /// Number of pixels inside.
    pub area_px: u32,
    /// Coarseness, where the segmenter has several: 0 is the coarsest (whole objects).
    pub level: u8,
}

impl Mask {
    /// Returns whether a pixel of the image belongs to the mask.
    pub fn contains(&self, x: u32, y: u32) -> bool {
        let BoxPx { x0, y0, x1, y1 } = self.box_px;
        (x0..x1).contains(&x)
            && (y0..y1).contains(&y)
            && self.inside[(y - y0) as usize * self.box_px.width_px() as usize + (x - x0) as usize]
    }
}

/// Makes one mask of each label but [`NO_REGION`], in ascending order of the labels; `None` if the
/// boxes of all masks together exceed `limit_bytes`.
///
/// `labels`: row-major, `width_px` a row, each less than `n_labels` or [`NO_REGION`].
pub(crate) fn masks_of_labels(
    labels: &[u32],
    width_px: u32,
    n_labels: usize,
    limit_bytes: u64,
) -> Option<Vec<(u32, Mask)>> {
    let empty = BoxPx { x0: u32::MAX, y0: u32::MAX, x1: 0, y1: 0 };
    let mut boxes = vec![(empty, 0_u32); n_labels];
    let rows = || labels.chunks(width_px.max(1) as usize).zip(0_u32..);
    for (row, y) in rows() {
        for (label, x) in row.iter().zip(0_u32..).filter(|(label, _)| **label != NO_REGION) {
            let (box_px, area_px) = &mut boxes[*label as usize];
            box_px.x0 = box_px.x0.min(x);
            box_px.x1 = box_px.x1.max(x + 1);
            box_px.y0 = box_px.y0.min(y);
            box_px.y1 = y + 1;
            *area_px += 1;
        }
    }
    let box_bytes = |b: &BoxPx| u64::from(b.width_px()) * u64::from(b.height_px());
    let total_bytes: u64 = boxes.iter().filter(|(_, area)| *area > 0).map(|(b, _)| box_bytes(b)).sum();
    if total_bytes > limit_bytes {
        return None;
    }
    let mut slot_of_label = vec![usize::MAX; n_labels];
    let mut masks = Vec::new();
    for ((box_px, area_px), label) in boxes.into_iter().zip(0_u32..).filter(|((_, area), _)| *area > 0) {
        slot_of_label[label as usize] = masks.len();
        let inside = vec![false; box_bytes(&box_px) as usize];
        masks.push((label, Mask { box_px, inside, area_px, level: 0 }));
    }
    for (row, y) in rows() {
        for (label, x) in row.iter().zip(0_u32..).filter(|(label, _)| **label != NO_REGION) {
            let mask = &mut masks[slot_of_label[*label as usize]].1;
            let at = (y - mask.box_px.y0) as usize * mask.box_px.width_px() as usize
                + (x - mask.box_px.x0) as usize;
            mask.inside[at] = true;
        }
    }
    Some(masks)
}

/// Marks a pixel that no mask covers in [`RegionMap::region_of_pixel`].
pub const NO_REGION: u32 = u32::MAX;

/// The partition of a view that its masks make: pixels with the same set of masks are a region.
#[derive(Clone, Debug, PartialEq)]
pub struct RegionMap {
    /// Width, pixels.
    pub width_px: u32,
    /// Height, pixels.
    pub height_px: u32,
    /// Region of each pixel, row-major; [`NO_REGION`] where no mask lies.
    pub region_of_pixel: Vec<u32>,
    /// Number of regions; numbered in the order in which a row-major scan meets them.
    pub n_regions: u32,
}
