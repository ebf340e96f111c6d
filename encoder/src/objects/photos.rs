//! Where a view's masks lie in its photo: kept beside its sums, so that an object can name the photo that shows it.

use std::path::Path;

use slag_common::container::{self, AlignedBytes, ContainerError, Layout};

use crate::lift::SumsError;
use crate::segment::Mask;

const MAGIC: [u8; 8] = *b"SLAGMBOX";
const VERSION: u32 = 1;

/// A view's name and the boxes of its masks.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Photo {
    /// Name of the view.
    pub name: String,
    /// Box of each mask, pixels of the photo free of distortion: x0, y0, x1, y1, the latter exclusive.
    pub boxes_px: Vec<[u32; 4]>,
}

/// Returns the boxes of a view's masks.
pub fn boxes_of(masks: &[Mask]) -> Vec<[u32; 4]> {
    masks.iter().map(|mask| [mask.box_px.x0, mask.box_px.y0, mask.box_px.x1, mask.box_px.y1]).collect()
}

/// Writes a view's boxes durably.
///
/// # Errors
/// [`SumsError::Io`].
pub fn write_boxes(path: &Path, boxes_px: &[[u32; 4]]) -> Result<(), SumsError> {
    let mut bytes = Vec::new();
    let n = boxes_px.len() as u64;
    let sections = [(1, bytemuck::bytes_of(&n)), (2, container::bytes_of(boxes_px))];
    container::write(&mut bytes, MAGIC, VERSION, &sections)?;
    Ok(crate::store::write_durably(path, &bytes)?)
}

/// Reads the boxes of a view of `n_masks` masks.
///
/// # Errors
/// [`SumsError`], naming the file.
pub fn read_boxes(path: &Path, n_masks: usize) -> Result<Vec<[u32; 4]>, SumsError> {
    let damaged = |source| SumsError::Damaged { path: path.to_owned(), source };
    let bytes = AlignedBytes::read(path)?;
    let layout = Layout::check(&bytes, MAGIC, VERSION).map_err(damaged)?;
    let n: u64 = layout.value(&bytes, 1, "number of masks").map_err(damaged)?;
    if n != n_masks as u64 {
        let what = format!("boxes of {n} masks, the view has {n_masks}");
        return Err(damaged(ContainerError::Damaged { offset_bytes: 0, what }));
    }
    let boxes = layout.column::<[u32; 4]>(2, "boxes", n_masks).map_err(damaged)?;
    Ok(bytemuck::pod_collect_to_vec(&bytes[boxes]))
}
