//! The partition of an image into regions: pixels that lie in the same masks.

use std::cmp::Reverse;
use std::collections::BTreeMap;

use super::mask::{Mask, NO_REGION};

/// A view's partition: the pixels of a region lie in the same masks.
#[derive(Clone, Debug, PartialEq)]
pub struct RegionMap {
    pub width_px: u32,
    pub height_px: u32,
    /// Row-major; [`NO_REGION`] outside all masks.
    pub region_of_pixel: Vec<u32>,
    /// Regions are numbered in the order of a row-major scan.
    pub n_regions: u32,
}

/// Class of invalid pixels, which belong to no region.
const INVALID: u32 = u32::MAX;
/// Class of pixels outside all masks so far.
const UNCOVERED: u32 = 0;

/// A sliver has less than one in this many pixels of the raster: 30 of 640 x 480.
const SLIVERS_PER_RASTER: usize = 10_000;
/// A sliver has less than one in this many pixels of every mask that covers it.
const SLIVERS_PER_MASK: u32 = 8;

/// Divides a raster into regions, the sets of pixels that lie in the same masks. Returns the map, and the masks of each
/// region as ascending indices into `masks`.
///
/// `masks` belong to an image of `width_px` x `height_px`; parts of their boxes outside it are ignored. Each pixel
/// centre of the raster of `target_width_px` x `target_height_px` takes the nearest image pixel. `valid`:
/// `[height_px * width_px]`, row-major; invalid pixels belong to no region. Time is proportional to the area of the
/// masks' boxes.
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
        assert_eq!(
            valid.len(),
            width_px as usize * height_px as usize,
            "`valid` needs one value per pixel of the image"
        );
        for (classes, y) in class_of_pixel.chunks_mut(width.max(1)).zip(&rows) {
            for (class, x) in classes.iter_mut().zip(&columns) {
                if !valid[*y as usize * width_px as usize + *x as usize] {
                    *class = INVALID;
                }
            }
        }
    }

    let mut classes = Classes::of(class_of_pixel);
    for mask in masks {
        classes.refine(mask, &columns, &rows);
    }
    number_regions(classes.of_pixel, classes.sizes.len(), masks, &columns, &rows)
}

/// Pixels by the masks that contain them so far.
struct Classes {
    of_pixel: Vec<u32>,
    sizes: Vec<usize>,
    /// By class: pixels in the current mask, and the new class. 0 between masks.
    n_inside: Vec<usize>,
    split: Vec<u32>,
    /// Of the current mask.
    pixels: Vec<usize>,
    touched: Vec<u32>,
}

impl Classes {
    fn of(of_pixel: Vec<u32>) -> Self {
        let sizes = vec![of_pixel.iter().filter(|class| **class == UNCOVERED).count()];
        let (pixels, touched) = (Vec::new(), Vec::new());
        Self { of_pixel, sizes, n_inside: vec![0], split: vec![INVALID], pixels, touched }
    }

    fn refine(&mut self, mask: &Mask, columns: &[u32], rows: &[u32]) {
        self.pixels.clear();
        for_each_pixel(mask, columns, rows, |pixel| {
            let class = self.of_pixel[pixel];
            if class != INVALID {
                if self.n_inside[class as usize] == 0 {
                    self.touched.push(class);
                }
                self.n_inside[class as usize] += 1;
                self.pixels.push(pixel);
            }
        });
        for class in self.touched.drain(..) {
            let at = class as usize;
            let inside = std::mem::take(&mut self.n_inside[at]);
            // A class entirely in the mask keeps its number, so there are never more classes than pixels; except the
            // uncovered one, whose number is reserved.
            self.split[at] = class;
            if class == UNCOVERED || inside < self.sizes[at] {
                self.split[at] = self.sizes.len() as u32;
                self.sizes[at] -= inside;
                self.sizes.push(inside);
                self.n_inside.push(0);
                self.split.push(INVALID);
            }
        }
        for pixel in &self.pixels {
            self.of_pixel[*pixel] = self.split[self.of_pixel[*pixel] as usize];
        }
    }
}

/// Merges slivers, which ragged edges of overlapping masks leave, into their neighbours.
///
/// A sliver has fewer pixels than a 10,000th of the raster and an eighth of every mask that covers it. It joins the
/// region, not itself a sliver, with the longest common border, or stays without such a neighbour. A mask never
/// disappears: if all of its regions would join others, its largest one stays.
pub fn absorb_slivers(map: &mut RegionMap, masks_of_region: &mut Vec<Vec<u32>>) {
    let mut size_of_region = vec![0_u32; map.n_regions as usize];
    let covered = map.region_of_pixel.iter().filter(|region| **region != NO_REGION);
    covered.for_each(|region| size_of_region[*region as usize] += 1);
    let mut regions_of_mask: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
    for (masks, region) in masks_of_region.iter().zip(0..) {
        masks.iter().for_each(|mask| regions_of_mask.entry(*mask).or_default().push(region));
    }

    let is_sliver = slivers(map, masks_of_region, &size_of_region, &regions_of_mask);
    let mut target_of_region = longest_borders(map, &is_sliver);
    for regions in regions_of_mask.values() {
        let stays = |region: &u32| target_of_region[*region as usize] == *region;
        if !regions.iter().any(stays) {
            let by_size = |region: &&u32| (size_of_region[**region as usize], Reverse(**region));
            let largest = regions.iter().max_by_key(by_size);
            largest.into_iter().for_each(|region| target_of_region[*region as usize] = *region);
        }
    }

    // In the order of the scan.
    let mut number_of_region = vec![NO_REGION; map.n_regions as usize];
    let mut masks_of_number = Vec::new();
    for region in map.region_of_pixel.iter_mut().filter(|region| **region != NO_REGION) {
        let target = target_of_region[*region as usize] as usize;
        if number_of_region[target] == NO_REGION {
            number_of_region[target] = masks_of_number.len() as u32;
            masks_of_number.push(std::mem::take(&mut masks_of_region[target]));
        }
        *region = number_of_region[target];
    }
    map.n_regions = masks_of_number.len() as u32;
    *masks_of_region = masks_of_number;
}

fn slivers(
    map: &RegionMap,
    masks_of_region: &[Vec<u32>],
    size_of_region: &[u32],
    regions_of_mask: &BTreeMap<u32, Vec<u32>>,
) -> Vec<bool> {
    let size_of_mask: BTreeMap<u32, u32> = regions_of_mask
        .iter()
        .map(|(mask, regions)| (*mask, regions.iter().map(|region| size_of_region[*region as usize]).sum()))
        .collect();
    let max_px = map.region_of_pixel.len() / SLIVERS_PER_RASTER;
    let is_sliver = |(masks, size): (&Vec<u32>, &u32)| {
        (*size as usize) < max_px && masks.iter().all(|mask| SLIVERS_PER_MASK * size < size_of_mask[mask])
    };
    masks_of_region.iter().zip(size_of_region).map(is_sliver).collect()
}

/// For each sliver, the region, not itself a sliver, with the longest common border (the first of equals); for other
/// regions, and slivers without such a neighbour, the region itself.
fn longest_borders(map: &RegionMap, is_sliver: &[bool]) -> Vec<u32> {
    let is = |region: u32| region != NO_REGION && is_sliver[region as usize];
    // (sliver, neighbour), once per pair of pixels along their border.
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
    longest.into_iter().map(|(_, region)| region).collect()
}

/// Numbers classes in the order of a row-major scan, and collects each one's masks at its first pixel.
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

/// Nearest original pixel for each pixel centre of a resampled axis; empty if the original axis is.
pub(crate) fn nearest(size_px: u32, target_size_px: u32) -> Vec<u32> {
    if size_px == 0 {
        return Vec::new();
    }
    let (size, target) = (u64::from(size_px), u64::from(target_size_px));
    // floor((i + 1/2) size / target), exactly.
    (0..target).map(|i| ((2 * i + 1) * size / (2 * target)) as u32).collect()
}

/// Visits, row-major, the raster pixels whose image pixel is in the mask.
fn for_each_pixel(mask: &Mask, columns: &[u32], rows: &[u32], mut visit: impl FnMut(usize)) {
    let range = |axis: &[u32], low: u32, high: u32| {
        let (start, end) = (axis.partition_point(|p| *p < low), axis.partition_point(|p| *p < high));
        start..end.max(start)
    };
    let box_px = mask.box_px;
    let (in_columns, in_rows) = (range(columns, box_px.x0, box_px.x1), range(rows, box_px.y0, box_px.y1));
    for row in in_rows {
        for column in in_columns.clone() {
            if mask.inside.get(box_px.place_of(columns[column], rows[row])) {
                visit(row * columns.len() + column);
            }
        }
    }
}
