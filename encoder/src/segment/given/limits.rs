//! What masks may have: the size of their photo, and no more than memory holds.

use std::path::Path;

use crate::segment::segmenter::{MAX_MASK_BYTES, SegmentError, SegmentInput};

/// Returns the error for masks above [`MAX_MASK_BYTES`].
pub(super) fn too_large(path: &Path) -> SegmentError {
    SegmentError::TooLarge { path: path.to_owned(), limit_bytes: MAX_MASK_BYTES }
}

/// Checks that masks have the size of the photo.
pub(super) fn check_size(
    path: &Path,
    [width, height]: [u32; 2],
    input: &SegmentInput<'_>,
) -> Result<(), SegmentError> {
    let expected_px = [input.image.width(), input.image.height()];
    if [width, height] == expected_px {
        return Ok(());
    }
    let view = input.view.name.clone();
    Err(SegmentError::Size { path: path.to_owned(), view, found_px: [width, height], expected_px })
}
