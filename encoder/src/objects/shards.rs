//! The objects of a cell, as its shards store them.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};

use half::f16;
use image::codecs::jpeg::JpegEncoder;
use image::imageops::{self, FilterType};
use image::{GenericImageView, RgbImage, SubImage};
use rayon::prelude::*;
use slag_common::View;
use slag_common::objects::{
    MAX_PHOTO_BYTES, MAX_THUMBNAIL_BYTES, NO_OBJECT, ObjectRecord, Objects, ObjectsHeader, Thumbnails,
    collect_runs, quantise_vectors,
};
use slag_common::shard::Basis;
use slag_math::cholesky::{SmallPivots, cholesky};

use super::{MAX_MEDOIDS, NONE, Object, SceneObjects};
use crate::progress::Progress;

const N_VECTORS: usize = 1 + MAX_MEDOIDS;

/// A shard's centroid basis, and the projection onto it.
pub struct CentroidBasis<'a> {
    dim: usize,
    /// Mean, and `[m][dim]`; `None`: vectors are their own components.
    basis: Option<(&'a [f16], Vec<f64>)>,
    /// `[m][m]`: lower triangle of the Cholesky factor of the basis vectors' products.
    factor: Vec<f64>,
}

impl<'a> CentroidBasis<'a> {
    pub fn new(dim: usize, basis: Option<Basis<'a>>) -> Self {
        let Some(Basis { mean, vectors, steps }) = basis else {
            return Self { dim, basis: None, factor: Vec::new() };
        };
        let step_of = steps.iter().flat_map(|step| std::iter::repeat_n(f64::from(*step), dim));
        let vectors: Vec<f64> = vectors.iter().zip(step_of).map(|(v, step)| f64::from(*v) * step).collect();
        let m = vectors.len() / dim;
        let row = |i: usize| &vectors[i * dim..][..dim];
        let mut products = vec![0.0; m * m];
        for i in 0..m {
            for j in 0..=i {
                products[i * m + j] = row(i).iter().zip(row(j)).map(|(a, b)| a * b).sum();
            }
        }
        // Dependent basis vectors get no component.
        let factor = cholesky(products, m, SmallPivots::Drop(1e-9));
        Self { dim, basis: Some((mean, vectors)), factor }
    }

    pub fn m(&self) -> usize {
        self.basis.as_ref().map_or(self.dim, |(_, vectors)| vectors.len() / self.dim)
    }

    /// Components (`[n][m]`) of the nearest vectors in the basis's span, by least squares.
    pub fn components(&self, vectors: &[f32]) -> Vec<f32> {
        let Some((mean, basis)) = &self.basis else { return vectors.to_vec() };
        let m = self.m();
        let solve = |vector: &[f32]| {
            let apart: Vec<f64> =
                vector.iter().zip(*mean).map(|(v, mean)| f64::from(*v) - mean.to_f64()).collect();
            let mut x: Vec<f64> = basis
                .chunks_exact(self.dim)
                .map(|b| b.iter().zip(&apart).map(|(b, a)| b * a).sum())
                .collect();
            let divided = |rest: f64, pivot: f64| if pivot > 0.0 { rest / pivot } else { 0.0 };
            for i in 0..m {
                let known: f64 = (0..i).map(|j| self.factor[i * m + j] * x[j]).sum();
                x[i] = divided(x[i] - known, self.factor[i * m + i]);
            }
            for i in (0..m).rev() {
                let known: f64 = (i + 1..m).map(|j| self.factor[j * m + i] * x[j]).sum();
                x[i] = divided(x[i] - known, self.factor[i * m + i]);
            }
            x.into_iter().map(|x| x as f32).collect::<Vec<f32>>()
        };
        vectors.chunks_exact(self.dim).flat_map(solve).collect()
    }

    /// Largest distance between vectors (`[n][dim]`) and their decoded rounded components.
    fn largest_error(&self, vectors: &[f32], components: &[i8], steps: &[f32]) -> f32 {
        let m = self.m();
        let of_vector = |((vector, components), step): ((&[f32], &[i8]), &f32)| {
            let mut made: Vec<f64> = match &self.basis {
                None => components.iter().map(|c| f64::from(*c) * f64::from(*step)).collect(),
                Some((mean, _)) => mean.iter().map(|mean| mean.to_f64()).collect(),
            };
            for (component, basis) in
                components.iter().zip(self.basis.iter().flat_map(|(_, basis)| basis.chunks_exact(self.dim)))
            {
                let scale = f64::from(*component) * f64::from(*step);
                made.iter_mut().zip(basis).for_each(|(made, b)| *made += scale * b);
            }
            made.iter().zip(vector).map(|(made, v)| (made - f64::from(*v)).powi(2)).sum::<f64>().sqrt()
        };
        let all = vectors.chunks_exact(self.dim).zip(components.chunks_exact(m.max(1))).zip(steps);
        // Rounded up to stay a bound in f32.
        all.map(of_vector).fold(0.0, f64::max) as f32 * (1.0 + 2.0 * f32::EPSILON)
    }
}

pub struct CellObjects {
    header: ObjectsHeader,
    records: Vec<ObjectRecord>,
    vectors: Vec<i8>,
    steps: Vec<f32>,
    run_ends: Vec<u32>,
    run_objects: Vec<u16>,
    photos: String,
    /// Ends, and concatenated JPEG files.
    thumbnails: (Vec<u32>, Vec<u8>),
}

impl CellObjects {
    /// `locals`: the cell's Gaussians in the shard's order; `basis`: of its centroids.
    pub fn new(scene: &SceneObjects, cell_id: u32, locals: &[u32], basis: &CentroidBasis<'_>) -> Self {
        let object_of = &scene.object_of[cell_id as usize];
        let mut n_here = vec![0u32; scene.objects.len()];
        object_of.iter().filter(|object| **object != NONE).for_each(|object| n_here[*object as usize] += 1);
        // Objects beyond the limit are all but impossible: a cell has at most 65,536 Gaussians.
        let here: Vec<usize> =
            (0..n_here.len()).filter(|object| n_here[*object] > 0).take(usize::from(NO_OBJECT) - 1).collect();
        let mut cell = Self {
            header: ObjectsHeader {
                n_objects: here.len() as u32,
                n_vectors: N_VECTORS as u32,
                n_runs: 0,
                photos_bytes: 0,
                score_mean: scene.calibration.score_mean,
                score_spread: scene.calibration.score_spread,
                score_error_bound: 0.0,
            },
            records: Vec::new(),
            vectors: Vec::new(),
            steps: Vec::new(),
            run_ends: Vec::new(),
            run_objects: Vec::new(),
            photos: String::new(),
            thumbnails: Default::default(),
        };
        let mut number_of = vec![NO_OBJECT; n_here.len()];
        for (number, object) in here.into_iter().enumerate() {
            number_of[object] = number as u16;
            let Object {
                id, n_gaussians, position_in_world, box_in_world, vectors, photo, photo_box_px, ..
            } = &scene.objects[object];
            let name = plain(photo);
            // Many objects share their best photo.
            let photo_start = cell.photos.find(&name).unwrap_or_else(|| {
                cell.photos.push_str(&name);
                cell.photos.len() - name.len()
            });
            cell.records.push(ObjectRecord {
                id: *id,
                position_in_world: position_in_world.to_array(),
                box_min: box_in_world.min.to_array(),
                box_max: box_in_world.max.to_array(),
                n_gaussians: *n_gaussians,
                n_gaussians_here: n_here[object],
                photo_box_px: *photo_box_px,
                photo_start: photo_start as u32,
                photo_bytes: name.len() as u32,
            });
            let (components, steps) = quantise_vectors(&basis.components(vectors), basis.m(), N_VECTORS);
            let error = basis.largest_error(vectors, &components, &steps);
            cell.header.score_error_bound = cell.header.score_error_bound.max(error);
            cell.vectors.extend(components);
            cell.steps.extend(steps);
            let (ends, pictures) = &mut cell.thumbnails;
            pictures.extend(scene.thumbnails.get(object).into_iter().flatten());
            ends.push(pictures.len() as u32);
        }
        (cell.run_ends, cell.run_objects) =
            collect_runs(locals.iter().map(|local| match object_of[*local as usize] {
                NONE => NO_OBJECT,
                object => number_of[object as usize],
            }));
        (cell.header.n_runs, cell.header.photos_bytes) =
            (cell.run_ends.len() as u32, cell.photos.len() as u32);
        cell
    }

    pub fn view(&self) -> Objects<'_> {
        let (ends, pictures) = &self.thumbnails;
        Objects {
            header: self.header,
            records: &self.records,
            vectors: &self.vectors,
            steps: &self.steps,
            run_ends: &self.run_ends,
            run_objects: &self.run_objects,
            photos: self.photos.as_bytes(),
            thumbnails: (!pictures.is_empty()).then_some(Thumbnails { ends, pictures }),
        }
    }
}

/// A name without control characters, cut to the readers' limit.
fn plain(name: &str) -> String {
    let mut plain: String =
        name.chars().map(|c| if c.is_control() { char::REPLACEMENT_CHARACTER } else { c }).collect();
    let end = (0..=MAX_PHOTO_BYTES.min(plain.len())).rev().find(|end| plain.is_char_boundary(*end));
    plain.truncate(end.unwrap_or(0));
    plain
}

/// Longest edge.
const EDGE_PX: u32 = 128;
/// Margin on each side, as a share of the box's longer edge.
const AROUND: f64 = 0.15;
/// The best one with a short enough file is taken. Noise has 9 kB with the least.
const JPEG_QUALITIES: [u8; 2] = [75, 30];

type Cuts = Vec<(usize, Vec<u8>)>;

/// Cuts a JPEG thumbnail per object, `[n]`: empty if its photo is unreadable or the run was cancelled. Also returns the
/// first error. `views`: sorted by name.
pub(crate) fn cut<E: Send>(
    objects: &[Object],
    views: &[&View],
    load: impl Fn(&View) -> Result<RgbImage, E> + Sync,
    progress: &dyn Progress,
    cancel: &AtomicBool,
) -> (Vec<Vec<u8>>, Option<E>) {
    let mut of_photo: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
    (0..objects.len()).for_each(|object| of_photo.entry(&objects[object].photo).or_default().push(object));
    progress.begin("thumbnails", "photo", of_photo.len() as u64, 0);
    let cut_all = |(name, objects_here): (&str, Vec<usize>)| {
        let found = views.binary_search_by(|view| view.name.as_str().cmp(name)).ok();
        let Some(view) = found.filter(|_| !cancel.load(Ordering::Relaxed)) else { return Ok(Vec::new()) };
        let photo = load(views[view]);
        progress.advance(1);
        let cut = |photo: RgbImage| {
            objects_here.iter().map(|object| (*object, jpeg(&photo, objects[*object].photo_box_px))).collect()
        };
        photo.map(cut)
    };
    let cuts: Vec<Result<Cuts, E>> = of_photo.into_par_iter().map(cut_all).collect();
    progress.end();
    let (mut thumbnails, mut fault) = (vec![Vec::new(); objects.len()], None);
    for cuts in cuts {
        match cuts {
            Ok(cuts) => cuts.into_iter().for_each(|(object, jpeg)| thumbnails[object] = jpeg),
            Err(error) => fault = fault.or(Some(error)),
        }
    }
    (thumbnails, fault)
}

/// JPEG of a photo around a box, at most [`EDGE_PX`] wide and high.
fn jpeg(photo: &RgbImage, box_px: [u32; 4]) -> Vec<u8> {
    let cut = around(photo, box_px);
    let (width, height) = (cut.width(), cut.height());
    let scale = f64::from(EDGE_PX) / f64::from(width.max(height).max(EDGE_PX));
    let scaled = |edge: u32| ((f64::from(edge) * scale).round() as u32).max(1);
    let picture = imageops::resize(&*cut, scaled(width), scaled(height), FilterType::Triangle);
    let encoded = JPEG_QUALITIES.into_iter().map(|quality| {
        let mut bytes = Vec::new();
        let encoder = JpegEncoder::new_with_quality(&mut bytes, quality);
        picture.write_with_encoder(encoder).expect("writing to memory cannot fail");
        bytes
    });
    encoded.into_iter().find(|bytes| bytes.len() <= MAX_THUMBNAIL_BYTES).unwrap_or_default()
}

fn around(photo: &RgbImage, [x0, y0, x1, y1]: [u32; 4]) -> SubImage<&RgbImage> {
    let margin = (f64::from((x1 - x0).max(y1 - y0)) * AROUND).round() as u32;
    let range = |low: u32, high: u32, size: u32| {
        let start = low.saturating_sub(margin).min(size - 1);
        (start, (high + margin).clamp(start + 1, size) - start)
    };
    let ((x, width), (y, height)) = (range(x0, x1, photo.width()), range(y0, y1, photo.height()));
    imageops::crop_imm(photo, x, y, width, height)
}

#[cfg(test)]
mod tests {
    use image::{ImageFormat, Rgb};

    use super::*;

    /// By hand: a box of 300 x 100 px at (90, 30). The margin is 45 px, but only 30 above the box.
    #[test]
    fn the_box_is_shown_with_a_margin_and_made_small() {
        let is_inside = |x: u32, y: u32| (90..390).contains(&x) && (30..130).contains(&y);
        let photo =
            RgbImage::from_fn(600, 400, |x, y| Rgb(if is_inside(x, y) { [250, 10, 10] } else { [0; 3] }));
        let cut = around(&photo, [90, 30, 390, 130]);
        assert_eq!((cut.offsets(), cut.width(), cut.height()), ((45, 0), 390, 175));
        let bytes = jpeg(&photo, [90, 30, 390, 130]);
        let picture =
            image::load_from_memory_with_format(&bytes, ImageFormat::Jpeg).expect("a JPEG").to_rgb8();
        assert_eq!(picture.dimensions(), (128, 57));
        assert!(picture.get_pixel(64, 26)[0] > 220 && picture.get_pixel(4, 53)[0] < 30);
        // Small ones are not enlarged, and those at a corner are cut.
        assert_eq!(around(&photo, [590, 390, 600, 400]).width(), 12);
        let small = image::load_from_memory(&jpeg(&photo, [590, 390, 600, 400])).expect("a JPEG");
        assert_eq!((small.width(), small.height()), (12, 12));
    }

    /// The worst that a photo can hold.
    #[test]
    fn noise_fits() {
        let mut random = slag_math::random::Random::new(3);
        let photo = RgbImage::from_fn(128, 128, |_, _| Rgb([0; 3].map(|_: u8| random.bits() as u8)));
        let len = jpeg(&photo, [0, 0, 128, 128]).len();
        assert!((1..=MAX_THUMBNAIL_BYTES).contains(&len), "{len}");
    }
}
