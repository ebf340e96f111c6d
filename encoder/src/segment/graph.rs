//! The built-in segmenter: graph-based segmentation at several scales (Felzenszwalb and Huttenlocher, "Efficient
//! Graph-Based Image Segmentation", IJCV 59(2), 2004).
//!
//! The weights of edges combine the object boundaries that a small model predicts from the photo and the splat's
//! depth, differences of colour in CIE L*a*b* (where distances are about proportional to perceived differences),
//! and jumps of depth.

use std::borrow::Cow;
use std::collections::HashMap;
use std::iter;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use image::{RgbImage, imageops};
use slag_math::graph_segmentation::Components;
use slag_math::union_find::{NOT_NUMBERED, Numbering};
use slag_models::SessionOptions;
use slag_models::boundaries::Boundaries;
use slag_models::session::SessionError;

use super::{SegmentError, SegmentInput, Segmenter};
use crate::masks::regions::nearest;
use crate::masks::{Bits, BoxPx, Mask, NO_REGION, masks_of_labels};

/// Edge weight per unit of L*a*b* distance; 16 bits then exceed the distance from black to white.
const WEIGHT_STEPS: f32 = 200.0;
/// A component needs one surrounded pixel in this many. A strip 3 px wide has a third, a ring around an object almost
/// none.
const MIN_SURROUNDED: u32 = 8;
/// Pixels of the working image: a JPEG block, the size of its artefacts.
const MIN_AREA_PX: u32 = 64;
/// Scale of observation of small things, finer than all levels: only its compact components are masks.
const COMPACT_SCALE: f32 = 100.0;
/// A compact component fills this share of its box, is at most this share of the photo, and touches no edge of it.
const MIN_FILL: f32 = 0.65;
const MAX_COMPACT_SHARE: f32 = 0.03;
/// Predicted boundary along its outline that suffices for a compact component.
const COMPACT_SUPPORT: f32 = 0.3;
/// Neighbours to which a pixel has an edge: half of the 8-neighbourhood; the rest by symmetry.
const NEIGHBOURS: [(i64, i64); 4] = [(1, 0), (-1, 1), (0, 1), (1, 1)];

#[derive(Clone, Debug, PartialEq)]
pub struct GraphSettings {
    /// Longest side of the working image, pixels; masks are scaled up from it.
    pub max_side_px: u32,
    /// Standard deviation of the smoothing, pixels of the working image.
    pub smoothing_px: f32,
    /// Scale of observation k of each level, coarsest first, in units of colour distance times pixels.
    pub scales: Vec<f32>,
    /// Smallest component kept, as a share of the image.
    pub min_area_share: f32,
    pub colour_weight: f32,
    /// Weight of a certain object boundary, in units of colour distance; 0 disables the model.
    pub boundary_weight: f32,
    /// Weight of a jump to twice the depth, in units of colour distance.
    pub depth_weight: f32,
    /// A mask is dropped if its intersection over union with one of a coarser level exceeds this.
    pub max_overlap_iou: f32,
    /// A mask is dropped if the predicted boundary along its outline is less than this on average; 0 keeps all. What
    /// only such masks cover is divided as at the finest level, so that every pixel shows something.
    pub min_support: f32,
    /// Most masks per image; the largest are kept.
    pub max_masks: usize,
}

impl Default for GraphSettings {
    fn default() -> Self {
        Self {
            max_side_px: 640,
            smoothing_px: 0.6,
            scales: vec![3000.0, 1200.0, 600.0, 300.0, 150.0],
            min_area_share: 0.0008,
            colour_weight: 1.0,
            boundary_weight: 0.0,
            depth_weight: 100.0,
            max_overlap_iou: 0.9,
            min_support: 0.0,
            max_masks: 400,
        }
    }
}

impl GraphSettings {
    /// For use with the boundary model, with the `n_scales` coarsest scales.
    pub fn learnt(n_scales: usize) -> Self {
        Self {
            scales: [1500.0, 800.0, 400.0, 100.0].into_iter().take(n_scales).collect(),
            colour_weight: 0.3,
            boundary_weight: 40.0,
            depth_weight: 0.0,
            min_support: 0.5,
            ..Self::default()
        }
    }
}

#[derive(Debug)]
pub struct GraphSegmenter {
    settings: GraphSettings,
    identity: String,
    model: Option<ModelPool>,
}

/// Instances of the model, one per concurrent image.
#[derive(Debug)]
struct ModelPool {
    options: SessionOptions,
    /// Instances are opened on these in turn.
    gpus: Vec<u32>,
    n_opened: AtomicUsize,
    idle: Mutex<Vec<Boundaries>>,
}

impl ModelPool {
    fn open(&self) -> Result<Boundaries, SessionError> {
        let n = self.n_opened.fetch_add(1, Ordering::Relaxed);
        let gpu = self.gpus.get(n % self.gpus.len().max(1)).copied().unwrap_or_default();
        Boundaries::open(&SessionOptions { gpu, ..self.options.clone() })
    }

    fn boundaries(&self, image: &RgbImage, depth_m: Option<&[f32]>) -> Result<Vec<f32>, SessionError> {
        let idle = || self.idle.lock().unwrap_or_else(PoisonError::into_inner);
        let taken = idle().pop();
        let mut model = taken.map_or_else(|| self.open(), Ok)?;
        let boundaries = model.of(image, depth_m);
        idle().push(model);
        boundaries
    }
}

impl GraphSegmenter {
    /// Without the model; only the first 255 scales count.
    pub fn new(mut settings: GraphSettings) -> Self {
        settings.scales.truncate(usize::from(Mask::FILLER));
        settings.max_side_px = settings.max_side_px.max(1);
        let identity = format!("graph 4, {settings:?}");
        Self { settings, identity, model: None }
    }

    /// With the embedded model, on one thread per image; `gpus` share the photos if the session asks for GPUs.
    pub fn learnt(
        settings: GraphSettings,
        session: &SessionOptions,
        gpus: &[u32],
    ) -> Result<Self, SessionError> {
        let options = SessionOptions { intra_op_threads: 1, ..session.clone() };
        let pool =
            ModelPool { options, gpus: gpus.to_vec(), n_opened: AtomicUsize::new(0), idle: Mutex::default() };
        // Now, so that a runtime that does not load is an error before the first photo.
        let first = pool.open()?;
        pool.idle.lock().unwrap_or_else(PoisonError::into_inner).push(first);
        let without = Self::new(settings);
        let identity = format!("{}, boundaries {}", without.identity, Boundaries::sha256());
        Ok(Self { model: Some(pool), identity, ..without })
    }
}

impl Default for GraphSegmenter {
    fn default() -> Self {
        Self::new(GraphSettings::default())
    }
}

impl Segmenter for GraphSegmenter {
    fn identity(&self) -> String {
        self.identity.clone()
    }

    fn wants_depth(&self) -> bool {
        self.settings.depth_weight > 0.0 || self.model.is_some()
    }

    fn segment(&self, input: &SegmentInput<'_>) -> Result<Vec<Mask>, SegmentError> {
        let (width_px, height_px) = input.image.dimensions();
        if width_px == 0 || height_px == 0 {
            return Ok(Vec::new());
        }
        let (image, raster) = Raster::new(input, &self.settings);
        let depth_m = raster.depth_m.as_deref();
        let boundaries = self.model.as_ref().map(|model| model.boundaries(&image, depth_m)).transpose()?;
        let edges = raster.edges_by_weight(&self.settings, boundaries.as_deref());
        let n_pixels = raster.lab.len();
        let min_area_px = ((n_pixels as f32 * self.settings.min_area_share) as u32).max(MIN_AREA_PX);
        let compact_scale = boundaries.as_ref().map(|_| COMPACT_SCALE);
        let levels: Vec<Labels> = (self.settings.scales.iter().copied().chain(compact_scale))
            .map(|scale| raster.components(&edges, scale * WEIGHT_STEPS, min_area_px))
            .collect();

        let mut masks = Vec::new();
        let finest = self.settings.scales.len().checked_sub(1).map(|finest| &levels[finest]);
        // The finest component of each pixel without a mask.
        let mut rest = finest.map_or(Vec::new(), |finest| finest.of_pixel.clone());
        for (level, labels) in levels.iter().enumerate() {
            let kept = self.kept(&raster, boundaries.as_deref(), min_area_px, &levels[..level], labels);
            let mut is_kept = vec![false; labels.area_px.len()];
            kept.iter().for_each(|(label, _)| is_kept[*label as usize] = true);
            let covered = labels.of_pixel.iter().map(|label| is_kept.get(*label as usize) == Some(&true));
            rest.iter_mut()
                .zip(covered)
                .filter(|(_, covered)| *covered)
                .for_each(|(rest, _)| *rest = NO_REGION);
            let level = level.min(self.settings.scales.len().saturating_sub(1)) as u8;
            masks.extend(kept.into_iter().map(|(_, mask)| Mask { level, ..mask }));
        }
        if boundaries.is_some() {
            let n_components = finest.map_or(0, |finest| finest.area_px.len());
            let fillers = masks_of_labels(&rest, raster.width_px, n_components, u64::MAX).unwrap_or_default();
            let fillers = fillers.into_iter().filter(|(_, mask)| mask.area_px >= min_area_px);
            masks.extend(fillers.map(|(_, mask)| Mask { level: Mask::FILLER, ..mask }));
        }
        self.keep_largest(&mut masks);
        let (columns, rows) = (nearest(raster.width_px, width_px), nearest(raster.height_px, height_px));
        Ok(masks.iter().filter_map(|mask| scaled_up(mask, &columns, &rows)).collect())
    }
}

impl GraphSegmenter {
    /// Components that become masks, with their labels: large enough, in no coarser level, and outlined by boundaries.
    /// Compact ones need fewer of these; of the scale finer than all levels, only compact ones count.
    fn kept(
        &self,
        raster: &Raster,
        boundaries: Option<&[f32]>,
        min_area_px: u32,
        coarser: &[Labels],
        labels: &Labels,
    ) -> Vec<(u32, Mask)> {
        let n_components = labels.area_px.len();
        let repeats = labels.repeats_of(coarser, self.settings.max_overlap_iou);
        let support = boundaries.map(|boundaries| {
            of_outlines(&labels.of_pixel, raster.width_px as usize, n_components, boundaries)
        });
        let is_level = coarser.len() < self.settings.scales.len();
        let is_confirmed = |label: usize, mask: &Mask| {
            support.as_ref().is_none_or(|of| {
                (is_level && of[label] >= self.settings.min_support)
                    || (of[label] >= COMPACT_SUPPORT && raster.is_compact(mask))
            })
        };
        let is_kept = |(label, mask): &(u32, Mask)| {
            let label = *label as usize;
            mask.area_px >= min_area_px && !repeats[label] && is_confirmed(label, mask)
        };
        let all = masks_of_labels(&labels.of_pixel, raster.width_px, n_components, u64::MAX);
        all.unwrap_or_default().into_iter().filter(is_kept).collect()
    }

    fn keep_largest(&self, masks: &mut Vec<Mask>) {
        if masks.len() <= self.settings.max_masks {
            return;
        }
        let mut numbered: Vec<(usize, Mask)> = std::mem::take(masks).into_iter().enumerate().collect();
        numbered.sort_by_key(|(_, mask)| std::cmp::Reverse(mask.area_px));
        numbered.truncate(self.settings.max_masks);
        numbered.sort_by_key(|(number, _)| *number);
        masks.extend(numbered.into_iter().map(|(_, mask)| mask));
    }
}

// Pixels without a component are in no region.
const _: () = assert!(NOT_NUMBERED == NO_REGION);

/// Pixel times 4, plus the index of the neighbour.
type Edge = u32;

struct Raster {
    width_px: u32,
    height_px: u32,
    /// Smoothed, L* a* b*.
    lab: Vec<[f32; 3]>,
    /// Metres along the camera's axis, 0 if unknown.
    depth_m: Option<Vec<f32>>,
    /// Pixels inside the lens image.
    valid: Vec<bool>,
}

impl Raster {
    /// Scales the photo to the working size and prepares colours and depths; also returns the scaled photo.
    fn new<'a>(input: &SegmentInput<'a>, settings: &GraphSettings) -> (Cow<'a, RgbImage>, Self) {
        let (full_width, full_height) = input.image.dimensions();
        let longest = full_width.max(full_height);
        let scaled = |side: u32| {
            let side = u64::from(side) * u64::from(settings.max_side_px.min(longest));
            ((side + u64::from(longest) / 2) / u64::from(longest)).max(1) as u32
        };
        let (width_px, height_px) = (scaled(full_width), scaled(full_height));
        let image = if longest <= settings.max_side_px {
            Cow::Borrowed(input.image)
        } else {
            Cow::Owned(imageops::thumbnail(input.image, width_px, height_px))
        };
        let mut lab = lab_of(&image);
        smooth(&mut lab, width_px as usize, settings.smoothing_px);

        let (columns, rows) = (nearest(full_width, width_px), nearest(full_height, height_px));
        let depth_m = input.depth.map(|depth_m| {
            sample(full_width, &columns, &rows, |at| depth_m.get(at).copied().unwrap_or_default())
        });
        let valid = input.valid.map_or_else(
            || vec![true; lab.len()],
            |valid| sample(full_width, &columns, &rows, |at| valid.get(at) == Some(&true)),
        );
        (image, Self { width_px, height_px, lab, depth_m, valid })
    }

    /// Pixel at the other end of an edge; `None` outside the image.
    fn neighbour(&self, pixel: usize, step: (i64, i64)) -> Option<usize> {
        let width = self.width_px as usize;
        self.neighbour_of((pixel % width, pixel / width), step)
    }

    /// Pixel beside (x, y); `None` outside the image.
    fn neighbour_of(&self, (x, y): (usize, usize), (dx, dy): (i64, i64)) -> Option<usize> {
        let (width, height) = (i64::from(self.width_px), i64::from(self.height_px));
        let (x, y) = (x as i64 + dx, y as i64 + dy);
        ((0..width).contains(&x) && (0..height).contains(&y)).then_some((y * width + x) as usize)
    }

    /// Relative depth jump between neighbours; 0 if unknown. A plane's inverse depth is linear in the image, so the
    /// slope on each side is extrapolated across the edge, and the jump is the smaller of the two residuals. A slanted
    /// floor and the fold between floor and wall have no jump.
    fn depth_jump(&self, a: usize, b: usize, step: (i64, i64)) -> f32 {
        let Some(depth_m) = &self.depth_m else { return 0.0 };
        let inverse = |pixel: usize| if depth_m[pixel] > 0.0 { 1.0 / depth_m[pixel] } else { f32::NAN };
        let (at_a, at_b) = (inverse(a), inverse(b));
        let carried_on = |near: f32, far: f32, beyond: Option<usize>| {
            let beyond = beyond.map_or(near, inverse);
            let slope = if beyond.is_nan() { 0.0 } else { near - beyond };
            (far - near - slope).abs().min((far - near).abs())
        };
        let from_a = carried_on(at_a, at_b, self.neighbour(a, (-step.0, -step.1)));
        let from_b = carried_on(at_b, at_a, self.neighbour(b, step));
        let relative = from_a.min(from_b) / at_a.max(at_b);
        if relative.is_finite() { relative } else { 0.0 }
    }

    /// Edges between valid pixels, ascending by weight, then by position. `boundaries`: `[neighbour][pixel]`, 0 to 1.
    fn edges_by_weight(&self, settings: &GraphSettings, boundaries: Option<&[f32]>) -> Vec<(Edge, u16)> {
        let mut edges = Vec::with_capacity(4 * self.lab.len());
        let (width, height) = (self.width_px as usize, self.height_px as usize);
        let has_depth = settings.depth_weight > 0.0;
        for (pixel, at) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).enumerate() {
            for (direction, step) in NEIGHBOURS.into_iter().enumerate() {
                let Some(other) = self.neighbour_of(at, step) else { continue };
                if !(self.valid[pixel] && self.valid[other]) {
                    continue;
                }
                let colour = settings.colour_weight * distance(self.lab[pixel], self.lab[other]);
                // A jump of 1/2 in relative inverse depth is to twice the depth.
                let jump = if has_depth { self.depth_jump(pixel, other, step) } else { 0.0 };
                let depth = 2.0 * settings.depth_weight * jump;
                let boundary = boundaries.map_or(0.0, |of| of[direction * self.lab.len() + pixel]);
                let weight = colour + depth + settings.boundary_weight * boundary;
                let weight = (weight * WEIGHT_STEPS) as u16;
                edges.push((pixel as u32 * 4 + direction as u32, weight));
            }
        }
        // A stable counting sort keeps the order of positions among equal weights.
        let mut ends = vec![0_u32; usize::from(u16::MAX) + 2];
        edges.iter().for_each(|(_, weight)| ends[usize::from(*weight) + 1] += 1);
        for weight in 1..ends.len() {
            ends[weight] += ends[weight - 1];
        }
        let mut sorted = vec![(0, 0); edges.len()];
        for edge in edges {
            let slot = &mut ends[usize::from(edge.1)];
            sorted[*slot as usize] = edge;
            *slot += 1;
        }
        sorted
    }

    /// Whether a mask has the shape of a thing rather than of the space between things.
    fn is_compact(&self, mask: &Mask) -> bool {
        let BoxPx { x0, y0, x1, y1 } = mask.box_px;
        let (area, n_box) = (mask.area_px as f32, (x1 - x0) as f32 * (y1 - y0) as f32);
        let is_inside = x0 > 0 && y0 > 0 && x1 < self.width_px && y1 < self.height_px;
        is_inside && area >= MIN_FILL * n_box && area <= MAX_COMPACT_SHARE * self.lab.len() as f32
    }

    /// Joins pixels over ascending edges while the edge is no larger than both components' largest inner weight plus
    /// `scale` over their size; then joins what is smaller than `min_area_px` to its most similar neighbour.
    fn components(&self, edges: &[(Edge, u16)], scale: f32, min_area_px: u32) -> Labels {
        let mut components = Components::new(self.lab.len(), scale);
        // Inside the image, because edges exist only there.
        let steps = NEIGHBOURS.map(|(dx, dy)| (dy * i64::from(self.width_px) + dx) as u32);
        let ends = |edge: Edge| (edge / 4, (edge / 4).wrapping_add(steps[edge as usize % 4]));
        let mut open = Vec::new();
        for (edge, weight) in edges {
            let (a, b) = ends(*edge);
            if !components.join_if_similar(a, b, f32::from(*weight)) {
                open.push(*edge);
            }
        }
        for edge in &open {
            let (a, b) = ends(*edge);
            components.join_if_small(a, b, min_area_px);
        }
        let mut thick = self.thick(&mut components);
        for edge in &open {
            let (a, b) = ends(*edge);
            let (a, b) = (components.root(a), components.root(b));
            let [a_is_thick, b_is_thick] = [a, b].map(|root| thick[root as usize]);
            if a != b && !(a_is_thick && b_is_thick) {
                let root = components.join_roots(a, b);
                thick[root as usize] = a_is_thick || b_is_thick;
            }
        }
        let valid = (0..).zip(&self.valid).filter(|(_, valid)| **valid);
        let Numbering { of_item, sizes } = components.number(valid.map(|(pixel, _)| pixel));
        Labels { of_pixel: of_item, area_px: sizes }
    }

    /// Whether a sufficient share of each root's component is surrounded by it. A smoothed outline is a ramp of
    /// colours; a component as narrow as this ramp is a strip of it and belongs to no object.
    fn thick(&self, components: &mut Components) -> Vec<bool> {
        let roots: Vec<usize> =
            (0..self.lab.len() as u32).map(|pixel| components.root(pixel) as usize).collect();
        let (width, height) = (self.width_px as usize, self.height_px as usize);
        if width < 3 || height < 3 {
            return vec![true; roots.len()];
        }
        let mut surrounded_px = vec![0_u32; roots.len()];
        for pixel in (1..height - 1).flat_map(|y| y * width + 1..(y + 1) * width - 1) {
            let rows = [pixel - width, pixel, pixel + width];
            let same =
                |middle: &usize| roots[middle - 1..=middle + 1].iter().all(|root| *root == roots[pixel]);
            surrounded_px[roots[pixel]] += u32::from(rows.iter().all(same));
        }
        let shares = surrounded_px.iter().zip(components.sizes());
        shares.map(|(surrounded_px, area_px)| surrounded_px * MIN_SURROUNDED >= *area_px).collect()
    }
}

struct Labels {
    of_pixel: Vec<u32>,
    area_px: Vec<u32>,
}

impl Labels {
    /// Whether each component's overlap with one of a coarser level exceeds `max_iou`.
    fn repeats_of(&self, coarser: &[Self], max_iou: f32) -> Vec<bool> {
        let mut repeats = vec![false; self.area_px.len()];
        for other in coarser {
            let mut unsorted_overlaps: HashMap<(u32, u32), u32> = HashMap::new();
            // Neighbouring pixels mostly have the same two components.
            let pairs: Vec<(u32, u32)> =
                iter::zip(&self.of_pixel, &other.of_pixel).map(|(a, b)| (*a, *b)).collect();
            for same in pairs.chunk_by(|a, b| a == b).filter(|same| same[0].0 != NO_REGION) {
                *unsorted_overlaps.entry(same[0]).or_default() += same.len() as u32;
            }
            for ((a, b), overlap_px) in unsorted_overlaps {
                let union_px = self.area_px[a as usize] + other.area_px[b as usize] - overlap_px;
                repeats[a as usize] |= overlap_px as f32 > max_iou * union_px as f32;
            }
        }
        repeats
    }
}

/// Takes, for each pixel of the working image, the nearest pixel of an image of this width.
fn sample<T>(width_px: u32, columns: &[u32], rows: &[u32], value_at: impl Fn(usize) -> T) -> Vec<T> {
    let mut values = Vec::with_capacity(columns.len() * rows.len());
    for y in rows {
        let start = *y as usize * width_px as usize;
        values.extend(columns.iter().map(|x| value_at(start + *x as usize)));
    }
    values
}

/// `None` if the result is empty.
fn scaled_up(mask: &Mask, columns: &[u32], rows: &[u32]) -> Option<Mask> {
    let range = |axis: &[u32], low: u32, high: u32| {
        (axis.partition_point(|p| *p < low) as u32, axis.partition_point(|p| *p < high) as u32)
    };
    let ((x0, x1), (y0, y1)) =
        (range(columns, mask.box_px.x0, mask.box_px.x1), range(rows, mask.box_px.y0, mask.box_px.y1));
    let of_row = |y: &u32| {
        let columns = columns[x0 as usize..x1 as usize].iter();
        columns.map(|x| mask.inside.get(mask.box_px.place_of(*x, *y))).collect::<Vec<bool>>()
    };
    let inside: Bits = rows[y0 as usize..y1 as usize].iter().flat_map(of_row).collect();
    let area_px = inside.count() as u32;
    (area_px > 0).then_some(Mask { box_px: BoxPx { x0, y0, x1, y1 }, inside, area_px, level: mask.level })
}

pub(super) fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    let [l, m, n] = [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
    (l * l + m * m + n * n).sqrt()
}

/// Converts sRGB (IEC 61966-2-1) to CIE L*a*b* of illuminant D65 (CIE 15).
pub(super) fn lab_of(image: &RgbImage) -> Vec<[f32; 3]> {
    let linear: Vec<f32> = (0..=255_u8)
        .map(|value| {
            let v = f32::from(value) / 255.0;
            if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
        })
        .collect();
    let root = |t: f32| if t > 216.0 / 24389.0 { t.cbrt() } else { (24389.0 / 27.0 * t + 16.0) / 116.0 };
    let lab = |pixel: &image::Rgb<u8>| {
        let [r, g, b] = pixel.0.map(|value| linear[usize::from(value)]);
        let x = root((0.4124564 * r + 0.3575761 * g + 0.1804375 * b) / 0.95047);
        let y = root(0.2126729 * r + 0.7151522 * g + 0.072175 * b);
        let z = root((0.0193339 * r + 0.119192 * g + 0.9503041 * b) / 1.08883);
        [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
    };
    image.pixels().map(lab).collect()
}

/// Gaussian truncated at four standard deviations; border pixels are repeated outwards.
pub(super) fn smooth(lab: &mut [[f32; 3]], width: usize, sigma_px: f32) {
    let radius = (4.0 * sigma_px).ceil().clamp(0.0, 64.0) as usize;
    if radius == 0 || width == 0 {
        return;
    }
    let mut kernel: Vec<f32> =
        (0..=2 * radius).map(|i| (-0.5 * ((i as f32 - radius as f32) / sigma_px).powi(2)).exp()).collect();
    let sum: f32 = kernel.iter().sum();
    kernel.iter_mut().for_each(|weight| *weight /= sum);

    // Along rows, then along columns; sums run over whole rows, so that no pixel is handled alone.
    let height = lab.len() / width;
    let add = |sums: &mut [[f32; 3]], weight: f32, colours: &[[f32; 3]]| {
        let (sums, colours) = (sums.as_flattened_mut().iter_mut(), colours.as_flattened());
        sums.zip(colours).for_each(|(sum, colour)| *sum += weight * colour);
    };
    let mut padded = Vec::new();
    for row in lab.chunks_exact_mut(width) {
        padded.clear();
        padded.extend((0..width + 2 * radius).map(|i| row[i.saturating_sub(radius).min(width - 1)]));
        row.fill([0.0; 3]);
        kernel.iter().zip(padded.windows(width)).for_each(|(weight, shifted)| add(row, *weight, shifted));
    }
    let rows = lab.to_vec();
    for (y, row) in lab.chunks_exact_mut(width).enumerate() {
        row.fill([0.0; 3]);
        for (i, weight) in kernel.iter().enumerate() {
            let from = (y + i).saturating_sub(radius).min(height - 1) * width;
            add(row, *weight, &rows[from..from + width]);
        }
    }
}

/// For each component, the mean, over the pairs of pixels across its outline, of the strongest boundary predicted
/// within a pixel: 0 to 1, and 1 without an outline. The photo's edge is no outline. `of_pixel`: each pixel's
/// component, row-major. `boundaries`: `[neighbour][pixel]`, the first to the right, the third below.
pub(super) fn of_outlines(
    of_pixel: &[u32],
    width_px: usize,
    n_components: usize,
    boundaries: &[f32],
) -> Vec<f32> {
    let n_pixels = of_pixel.len();
    let mut sums = vec![(0.0_f32, 0_u32); n_components];
    let [right, below] =
        [0, 2].map(|neighbour| &boundaries[neighbour * n_pixels..(neighbour + 1) * n_pixels]);
    for pixel in 0..n_pixels {
        let column = pixel % width_px;
        let beside = (column + 1 < width_px).then_some((pixel + 1, right));
        let under = (pixel + width_px < n_pixels).then_some((pixel + width_px, below));
        for (other, predicted) in [beside, under].into_iter().flatten() {
            let ends = [of_pixel[pixel], of_pixel[other]];
            if ends[0] == ends[1] {
                continue;
            }
            let near = [
                (column > 0).then(|| pixel - 1),
                (column + 1 < width_px).then_some(pixel + 1),
                pixel.checked_sub(width_px),
                Some(pixel + width_px).filter(|below| *below < n_pixels),
            ];
            let near = near.into_iter().flatten().map(|at| predicted[at]);
            let strongest = near.fold(predicted[pixel], f32::max);
            for component in ends.into_iter().filter(|component| *component != NO_REGION) {
                let (sum, n) = &mut sums[component as usize];
                *sum += strongest;
                *n += 1;
            }
        }
    }
    sums.into_iter().map(|(sum, n)| if n == 0 { 1.0 } else { sum / n as f32 }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand, in 100 x 100 pixels: fills its box, touches no edge and is no large part of the photo.
    #[test]
    fn compact_is_what_has_the_shape_of_a_thing() {
        let (lab, valid) = (vec![[0.0; 3]; 10_000], vec![true; 10_000]);
        let raster = Raster { width_px: 100, height_px: 100, lab, depth_m: None, valid };
        let is_compact = |x0: u32, y0: u32, side: u32, is_inside: &dyn Fn(u32, u32) -> bool| {
            let box_px = BoxPx { x0, y0, x1: x0 + side, y1: y0 + side };
            raster.is_compact(&Mask::within(box_px, |x, y| is_inside(x - x0, y - y0)))
        };
        let disc = |x: u32, y: u32| x.abs_diff(8).pow(2) + y.abs_diff(8).pow(2) <= 64;
        assert!(is_compact(40, 40, 17, &disc));
        assert!(!is_compact(0, 40, 17, &disc) && !is_compact(40, 83, 17, &disc));
        assert!(!is_compact(40, 40, 17, &|x, y| x.abs_diff(y) < 4));
        assert!(is_compact(40, 40, 17, &|_, _| true) && !is_compact(40, 40, 18, &|_, _| true));
    }

    const SIDE: usize = 8;

    /// Component 1 is a square of 4 x 4 px with its upper left pixel at (x, y), component 0 the rest.
    fn square(x: usize, y: usize) -> Vec<u32> {
        let inside = |i: usize| (x..x + 4).contains(&(i % SIDE)) && (y..y + 4).contains(&(i / SIDE));
        (0..SIDE * SIDE).map(|i| u32::from(inside(i))).collect()
    }

    /// Boundaries between different components, where `seen` says so.
    fn boundaries(of_pixel: &[u32], seen: impl Fn(usize, usize) -> bool) -> Vec<f32> {
        let mut boundaries = vec![0.0; 4 * SIDE * SIDE];
        for i in 0..SIDE * SIDE {
            for (neighbour, there, step) in [(0, i % SIDE + 1 < SIDE, 1), (2, i / SIDE + 1 < SIDE, SIDE)] {
                if there && of_pixel[i] != of_pixel[i + step] && seen(i % SIDE, i / SIDE) {
                    boundaries[neighbour * SIDE * SIDE + i] = 1.0;
                }
            }
        }
        boundaries
    }

    /// Support of both components where boundaries are those of `predicted` that `seen` says.
    fn support(of_pixel: &[u32], predicted: &[u32], seen: impl Fn(usize, usize) -> bool) -> [f32; 2] {
        let found = of_outlines(of_pixel, SIDE, 2, &boundaries(predicted, seen));
        [found[0], found[1]]
    }

    /// By hand. A pixel without a component has no outline of its own.
    #[test]
    fn the_share_of_the_outline_that_is_predicted() {
        let middle = square(2, 2);
        assert_eq!(support(&middle, &middle, |_, _| true), [1.0, 1.0]);
        assert_eq!(support(&middle, &middle, |_, _| false), [0.0, 0.0]);
        // Without its right side, whose pairs begin in column 5; none of these is beside a pair of another side of its
        // kind. The bottom's last pair begins in that column, too, but its neighbour is predicted.
        assert_eq!(support(&middle, &middle, |x, y| x != 5 || !(2..6).contains(&y)), [0.75, 0.75]);
        let mut without = middle.clone();
        without[0] = NO_REGION;
        assert_eq!(support(&without, &without, |_, _| true), [1.0, 1.0]);
        // Two sides lie on the photo's edge, which is no outline.
        let corner = square(4, 4);
        assert_eq!(support(&corner, &corner, |_, _| true), [1.0, 1.0]);
        assert_eq!(support(&[0; SIDE * SIDE], &[0; SIDE * SIDE], |_, _| true)[0], 1.0);
        // A boundary may be a pixel off, but not two.
        assert_eq!(support(&middle, &square(3, 2), |_, _| true)[1], 1.0);
        assert!(support(&middle, &square(4, 2), |_, _| true)[1] < 0.5);
    }
}
