//! The objects of a cell, as its shards store them.

use half::f16;
use slag_common::objects::{
    MAX_PHOTO_BYTES, NO_OBJECT, ObjectRecord, Objects, ObjectsHeader, Thumbnails, collect_runs,
    quantise_vectors,
};
use slag_common::shard::Basis;
use slag_math::cholesky::{SmallPivots, cholesky};

use super::object::{MAX_MEDOIDS, NONE, Object, SceneObjects};

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
        let basis = basis.map(|basis| {
            let of_vector = |(v, step): (&[i8], &f32)| {
                let step = f64::from(*step);
                v.iter().map(move |v| f64::from(*v) * step).collect::<Vec<f64>>()
            };
            (
                basis.mean,
                basis.vectors.chunks_exact(dim).zip(basis.steps).flat_map(of_vector).collect::<Vec<f64>>(),
            )
        });
        let mut prepared = Self { dim, basis, factor: Vec::new() };
        let Some((_, vectors)) = &prepared.basis else { return prepared };
        let m = prepared.m();
        let row = |i: usize| &vectors[i * dim..][..dim];
        let mut products = vec![0.0; m * m];
        for i in 0..m {
            for j in 0..=i {
                products[i * m + j] = row(i).iter().zip(row(j)).map(|(a, b)| a * b).sum();
            }
        }
        // Dependent basis vectors get no component.
        prepared.factor = cholesky(products, m, SmallPivots::Drop(1e-9));
        prepared
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
            cell.add(&scene.objects[object], n_here[object], basis);
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

    fn add(&mut self, object: &Object, n_gaussians_here: u32, basis: &CentroidBasis<'_>) {
        let name = plain(&object.photo);
        // Many objects share their best photo.
        let photo_start = self.photos.find(&name).unwrap_or_else(|| {
            self.photos.push_str(&name);
            self.photos.len() - name.len()
        });
        self.records.push(ObjectRecord {
            id: object.id,
            position_in_world: object.position_in_world.to_array(),
            box_min: object.box_in_world.min.to_array(),
            box_max: object.box_in_world.max.to_array(),
            n_gaussians: object.n_gaussians,
            n_gaussians_here,
            photo_box_px: object.photo_box_px,
            photo_start: photo_start as u32,
            photo_bytes: name.len() as u32,
        });
        let (components, steps) = quantise_vectors(&basis.components(&object.vectors), basis.m(), N_VECTORS);
        let error = basis.largest_error(&object.vectors, &components, &steps);
        self.header.score_error_bound = self.header.score_error_bound.max(error);
        self.vectors.extend(components);
        self.steps.extend(steps);
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
