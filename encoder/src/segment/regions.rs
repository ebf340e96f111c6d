//! The partition of an image into pixels with the same set of masks.

use super::{Mask, NO_REGION, RegionMap};

/// The class of pixels that show nothing; no mask ever touches it.
const INVALID: u32 = u32::MAX;
/// The class of pixels that no mask has covered so far.
const UNCOVERED: u32 = 0;

/// Cuts a raster into regions of pixels that lie in the same set of masks.
///
/// The masks are those of an image of `width_px` x `height_px`. Each pixel centre of the raster of
/// `target_width_px` x `target_height_px` takes the nearest image pixel. `valid`: `[height_px *
/// width_px]`, row-major; pixels that are not valid belong to no region. What a mask's box holds
/// outside the image is ignored.
///
/// Returns the map and the masks of each region, as ascending indices into `masks`. Masks refine
/// the partition one after the other, each within its box, so the time is that of reading the masks.
///
/// # Panics
/// If `valid` has another length than the image has pixels.
pub fn partition(
    masks: &[Mask],
    width_px: u32,
    height_px: u32,
    target_width_px: u32,
    target_height_px: u32,
    valid: Option<&[bool]>,
) -> (RegionMap, Vec<Vec<u32>>) {
    let columns = nearest(width_px, target_width_px);
    let rows = nearest(height_px, target_height_px);
    let width = columns.len();
    let mut class_of_pixel = vec![UNCOVERED; width * rows.len()];
    if let Some(valid) = valid {
        assert_eq!(valid.len(), width_px as usize * height_px as usize, "`valid` is of another size");
        for (classes, y) in class_of_pixel.chunks_mut(width.max(1)).zip(&rows) {
            for (class, x) in classes.iter_mut().zip(&columns) {
                if !valid[*y as usize * width_px as usize + *x as usize] {
                    *class = INVALID;
                }
            }
        }
    }

    let mut size_of_class = vec![class_of_pixel.iter().filter(|class| **class == UNCOVERED).count()];
    let (mut inside_of_class, mut split_of_class) = (vec![0_usize], vec![INVALID]);
    let mut pixels = Vec::new();
    let mut touched = Vec::new();
    for mask in masks {
        pixels.clear();
        touched.clear();
        for_each_pixel(mask, &columns, &rows, |pixel| {
            let class = class_of_pixel[pixel];
            if class != INVALID {
                if inside_of_class[class as usize] == 0 {
                    touched.push(class);
                }
                inside_of_class[class as usize] += 1;
                pixels.push(pixel);
            }
        });
        for class in touched.drain(..) {
            let at = class as usize;
            let inside = std::mem::take(&mut inside_of_class[at]);
            // A class that lies in the mask as a whole stays one, so there are never more classes
            // than pixels; only the uncovered one must remain what its name says.
            split_of_class[at] = class;
            if class == UNCOVERED || inside < size_of_class[at] {
                split_of_class[at] = size_of_class.len() as u32;
                size_of_class[at] -= inside;
                size_of_class.push(inside);
                inside_of_class.push(0);
                split_of_class.push(INVALID);
            }
        }
        for pixel in &pixels {
            class_of_pixel[*pixel] = split_of_class[class_of_pixel[*pixel] as usize];
        }
    }
    number_regions(class_of_pixel, size_of_class.len(), masks, &columns, &rows)
}

/// Numbers the classes in the order of a row-major scan, and finds the masks of each at its first pixel.
fn number_regions(
    mut class_of_pixel: Vec<u32>,
    n_classes: usize,
    masks: &[Mask],
    columns: &[u32],
    rows: &[u32],
) -> (RegionMap, Vec<Vec<u32>>) {
    let mut region_of_class = vec![NO_REGION; n_classes];
    let mut first_pixels = Vec::new();
    for (pixel, class) in class_of_pixel.iter_mut().enumerate() {
        if *class == INVALID || *class == UNCOVERED {
            *class = NO_REGION;
            continue;
        }
        let region = &mut region_of_class[*class as usize];
        if *region == NO_REGION {
            *region = first_pixels.len() as u32;
            first_pixels.push(pixel);
        }
        *class = *region;
    }
    let masks_at = |pixel: &usize| {
        let (x, y) = (columns[pixel % columns.len()], rows[pixel / columns.len()]);
        (0_u32..).zip(masks).filter(|(_, mask)| mask.contains(x, y)).map(|(index, _)| index).collect()
    };
    let map = RegionMap {
        width_px: columns.len() as u32,
        height_px: rows.len() as u32,
        n_regions: first_pixels.len() as u32,
        region_of_pixel: class_of_pixel,
    };
    (map, first_pixels.iter().map(masks_at).collect())
}

/// Returns, for each pixel centre of a resampled axis, the nearest pixel of the original one;
/// nothing if that has none.
pub(super) fn nearest(size_px: u32, target_size_px: u32) -> Vec<u32> {
    if size_px == 0 {
        return Vec::new();
    }
    let (size, target) = (u64::from(size_px), u64::from(target_size_px));
    // floor((i + 1/2) size / target), exactly.
    (0..target).map(|i| ((2 * i + 1) * size / (2 * target)) as u32).collect()
}

/// Calls `visit` with each raster pixel, in row-major order, whose image pixel lies in the mask.
fn for_each_pixel(mask: &Mask, columns: &[u32], rows: &[u32], mut visit: impl FnMut(usize)) {
    let range = |axis: &[u32], low: u32, high: u32| {
        let (start, end) = (axis.partition_point(|p| *p < low), axis.partition_point(|p| *p < high));
        start..end.max(start)
    };
    let box_px = mask.box_px;
    let (in_columns, in_rows) = (range(columns, box_px.x0, box_px.x1), range(rows, box_px.y0, box_px.y1));
    for row in in_rows {
        let start = (rows[row] - box_px.y0) as usize * box_px.width_px() as usize;
        for column in in_columns.clone() {
            if mask.inside[start + (columns[column] - box_px.x0) as usize] {
                visit(row * columns.len() + column);
            }
        }
    }
}
