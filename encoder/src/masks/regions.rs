//! The partition of an image into pixels with the same set of masks.

use super::Mask;

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

/// The class of pixels that show nothing; no mask ever touches it.
const INVALID: u32 = u32::MAX;
/// The class of pixels that no mask has covered so far.
const UNCOVERED: u32 = 0;

/// One over the share of a raster below which a region may be a sliver: 30 pixels of 640 x 480.
const SLIVERS_A_RASTER: usize = 10_000;
/// One over the share of every mask that covers it below which it is one.
const SLIVERS_A_MASK: u32 = 8;

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

/// Returns the length of a partition's borders over its area, both in pixels: pairs of neighbouring pixels of which
/// just one lies in a region or each in another, over the pixels that lie in any. It falls with the raster's width.
pub fn border_share(map: &RegionMap) -> f64 {
    let (pixels, width) = (&map.region_of_pixel, (map.width_px as usize).max(1));
    let in_rows = pixels.chunks(width).map(|row| row.windows(2).filter(|pair| pair[0] != pair[1]).count());
    let in_columns = pixels.iter().zip(pixels.iter().skip(width)).filter(|(a, b)| a != b).count();
    let n_covered = pixels.iter().filter(|region| **region != NO_REGION).count();
    (in_rows.sum::<usize>() + in_columns) as f64 / n_covered.max(1) as f64
}

/// Gives slivers, which ragged edges of masks leave where they overlap, to their neighbours. A sliver has less than a
/// 10,000th of the raster and less than an eighth of every mask that covers it, so that no mask loses its place. It
/// goes to the region, no sliver itself, with which it has the longest border; where there is none it stays.
pub fn absorb_slivers(map: &mut RegionMap, masks_of_region: &mut Vec<Vec<u32>>) {
    let mut size_of_region = vec![0_u32; map.n_regions as usize];
    let covered = map.region_of_pixel.iter().filter(|region| **region != NO_REGION);
    covered.for_each(|region| size_of_region[*region as usize] += 1);
    let n_masks = masks_of_region.iter().flatten().max().map_or(0, |mask| *mask as usize + 1);
    let mut size_of_mask = vec![0_u32; n_masks];
    for (masks, size) in masks_of_region.iter().zip(&size_of_region) {
        masks.iter().for_each(|mask| size_of_mask[*mask as usize] += size);
    }
    let max_px = map.region_of_pixel.len() / SLIVERS_A_RASTER;
    let is_sliver: Vec<bool> = (masks_of_region.iter().zip(&size_of_region))
        .map(|(masks, size)| {
            let is_small = |mask: &u32| SLIVERS_A_MASK * size < size_of_mask[*mask as usize];
            (*size as usize) < max_px && masks.iter().all(is_small)
        })
        .collect();
    let is = |region: u32| region != NO_REGION && is_sliver[region as usize];
    // (sliver, neighbour), once for each pair of pixels along their border.
    let mut borders = Vec::new();
    let width = (map.width_px as usize).max(1);
    for (at, a) in map.region_of_pixel.iter().enumerate() {
        let right = map.region_of_pixel.get(at + 1).filter(|_| (at + 1) % width > 0);
        for b in right.into_iter().chain(map.region_of_pixel.get(at + width)) {
            match (is(*a), is(*b)) {
                (true, false) if *b != NO_REGION => borders.push((*a, *b)),
                (false, true) if *a != NO_REGION => borders.push((*b, *a)),
                _ => {}
            }
        }
    }
    borders.sort_unstable();
    let mut longest: Vec<(usize, u32)> = (0..map.n_regions).map(|region| (0, region)).collect();
    for run in borders.chunk_by(|x, y| x == y) {
        let (sliver, neighbour) = run[0];
        if run.len() > longest[sliver as usize].0 {
            longest[sliver as usize] = (run.len(), neighbour);
        }
    }
    // Numbered anew in the order of the scan.
    let mut number_of_region = vec![NO_REGION; map.n_regions as usize];
    let mut masks_of_number = Vec::new();
    for region in map.region_of_pixel.iter_mut().filter(|region| **region != NO_REGION) {
        let kept = longest[*region as usize].1 as usize;
        if number_of_region[kept] == NO_REGION {
            number_of_region[kept] = masks_of_number.len() as u32;
            masks_of_number.push(std::mem::take(&mut masks_of_region[kept]));
        }
        *region = number_of_region[kept];
    }
    map.n_regions = masks_of_number.len() as u32;
    *masks_of_region = masks_of_number;
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
pub(crate) fn nearest(size_px: u32, target_size_px: u32) -> Vec<u32> {
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
