//! The outlines of a view's masks in its photo, kept beside its contributions: how much the photo's edge cuts off,
//! and the box that shows the object.

use std::path::Path;

use bytemuck::{Pod, Zeroable};
use slag_common::container::{self, AlignedBytes, ContainerError, Layout};

use super::contributions::ContributionError;
use crate::masks::{BoxPx, Mask};

const MAGIC: [u8; 8] = *b"SLAGMBOX";
const VERSION: u32 = 2;

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Photo {
    pub name: String,
    pub outlines: Vec<MaskOutline>,
}

#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub struct MaskOutline {
    /// Pixels of the undistorted photo: x0, y0, x1, y1, the last two exclusive.
    pub box_px: [u32; 4],
    /// Outline on the photo's edge, pixels.
    pub(crate) cut_px: u32,
    /// As of [`Mask::level`].
    pub level: u32,
}

impl MaskOutline {
    /// `valid`: pixels that undistortion filled; `None` if all.
    pub fn of(mask: &Mask, width_px: u32, height_px: u32, valid: Option<&[bool]>) -> Self {
        let BoxPx { x0, y0, x1, y1 } = mask.box_px;
        let is_there = |x: u32, y: u32| {
            x < width_px && y < height_px && valid.is_none_or(|valid| valid[(y * width_px + x) as usize])
        };
        // 0 - 1 wraps beyond any photo's width.
        let n_cut = |x: u32, y: u32| {
            let beside = [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)];
            beside.into_iter().filter(|(x, y)| !is_there(*x, *y)).count()
        };
        let may_be_cut = valid.is_some() || x0 == 0 || y0 == 0 || x1 >= width_px || y1 >= height_px;
        let rows = if may_be_cut { y0..y1 } else { 0..0 };
        let pixels = rows.flat_map(|y| (x0..x1).map(move |x| (x, y))).zip(mask.inside.iter());
        let cut_px = pixels.filter(|(_, inside)| *inside).map(|((x, y), _)| n_cut(x, y) as u32).sum();
        Self { box_px: [x0, y0, x1, y1], cut_px, level: mask.level.into() }
    }

    /// 1 - truncation, 0 to 1: share of the outline that the photo's edge does not cut off. The box's perimeter stands
    /// for the outline's length, which raggedness would increase.
    pub(crate) fn uncut_share(&self) -> f32 {
        let [x0, y0, x1, y1] = self.box_px.map(f64::from);
        (1.0 - f64::from(self.cut_px) / (2.0 * (x1 - x0 + y1 - y0))).max(0.0) as f32
    }
}

pub(crate) fn write_outlines(path: &Path, outlines: &[MaskOutline]) -> Result<(), ContributionError> {
    Ok(slag_common::durable::write(path, &outlines_to_bytes(outlines)?)?)
}

pub(crate) fn outlines_to_bytes(outlines: &[MaskOutline]) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let n = outlines.len() as u64;
    let sections = [(1, bytemuck::bytes_of(&n)), (2, container::bytes_of(outlines))];
    container::write(&mut bytes, MAGIC, VERSION, &sections)?;
    Ok(bytes)
}

pub(crate) fn read_outlines(path: &Path, n_masks: usize) -> Result<Vec<MaskOutline>, ContributionError> {
    let damaged = |source| ContributionError::Damaged { path: path.to_owned(), source };
    let bytes = AlignedBytes::read(path)?;
    let layout = Layout::check(&bytes, MAGIC, VERSION).map_err(damaged)?;
    let n: u64 = layout.value(&bytes, 1, "number of masks").map_err(damaged)?;
    if n != n_masks as u64 {
        let what = format!("outlines of {n} masks, the view has {n_masks}");
        return Err(damaged(ContainerError::Damaged { offset_bytes: 0, what }));
    }
    layout.values(&bytes, 2, "outlines", n_masks).map_err(damaged)
}

#[cfg(test)]
mod tests {
    use super::*;
    use slag_test_support::assert_error;

    /// A mask that fills a box except for a hole.
    fn mask([x0, y0, x1, y1]: [u32; 4], hole: impl Fn(u32, u32) -> bool) -> Mask {
        Mask { level: 2, ..Mask::within(BoxPx { x0, y0, x1, y1 }, |x, y| !hole(x, y)) }
    }

    /// By hand: outlines on the photo's edge, and along pixels that undistortion left empty.
    #[test]
    fn the_photos_edge_cuts_off_what_touches_it() {
        let of = |mask: &Mask, valid| MaskOutline::of(mask, 20, 10, valid);
        let inner = of(&mask([3, 2, 9, 8], |_, _| false), None);
        assert_eq!(inner, MaskOutline { box_px: [3, 2, 9, 8], cut_px: 0, level: 2 });
        assert_eq!(inner.uncut_share(), 1.0);
        // 4 of the left edge, 5 of the lower one.
        let corner = of(&mask([0, 6, 5, 10], |_, _| false), None);
        assert_eq!((corner.cut_px, corner.uncut_share()), (9, 0.5));
        // Two pixels of its five rows touch the right edge.
        let tip = of(&mask([14, 2, 20, 7], |x, y| x == 19 && !(3..5).contains(&y)), None);
        assert_eq!((tip.cut_px, tip.uncut_share()), (2, 10.0_f32 / 11.0));
        let whole_photo = of(&mask([0, 0, 20, 10], |_, _| false), None);
        assert_eq!((whole_photo.cut_px, whole_photo.uncut_share()), (60, 0.0));
        // Columns 0 to 2 are empty, so the mask beside them is cut along its 6 rows.
        let valid: Vec<bool> = (0..200).map(|at| at % 20 > 2).collect();
        assert_eq!(of(&mask([3, 2, 9, 8], |_, _| false), Some(&valid)).cut_px, 6);
        assert_eq!(of(&mask([4, 2, 9, 8], |_, _| false), Some(&valid)).cut_px, 0);
    }

    #[test]
    fn outlines_are_kept_and_damage_is_named() {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let path = dir.path().join("a.outlines");
        let outlines = [[1, 2, 3, 4], [5, 6, 7, 8]].map(|box_px| MaskOutline { box_px, cut_px: 3, level: 1 });
        write_outlines(&path, &outlines).expect("writes");
        assert_eq!(read_outlines(&path, 2).expect("reads"), outlines);
        assert_error(read_outlines(&path, 3), &["a.outlines", "the view has 3"]);
        let mut bytes = AlignedBytes::read(&path).expect("reads").to_vec();
        // In the second section: the first is padded.
        bytes[200] ^= 1;
        fs_err::write(&path, &bytes).expect("writes");
        read_outlines(&path, 2).expect_err("damaged");
    }
}
