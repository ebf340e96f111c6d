//! The objects of a cell, as its shards carry them.

use slag_common::objects::{
    MAX_PHOTO_BYTES, NO_OBJECT, ObjectRecord, Objects, ObjectsHeader, quantise_vectors,
};

use super::vectors::MAX_MEDOIDS;
use super::{NONE, SceneObjects};

/// Vectors of an object: the mean of its masks' and the medoids.
const N_VECTORS: usize = 1 + MAX_MEDOIDS;

/// The columns of a cell's objects.
pub struct CellObjects {
    header: ObjectsHeader,
    records: Vec<ObjectRecord>,
    vectors: Vec<i8>,
    steps: Vec<f32>,
    run_ends: Vec<u32>,
    run_objects: Vec<u16>,
    photos: String,
}

impl CellObjects {
    /// Collects the objects of a cell. `locals`: its Gaussians in the order of the shard; `dim`: components of an
    /// embedding.
    pub fn new(scene: &SceneObjects, cell_id: u32, locals: &[u32], dim: usize) -> Self {
        let object_of = &scene.object_of[cell_id as usize];
        let mut n_here = vec![0u32; scene.objects.len()];
        object_of.iter().filter(|object| **object != NONE).for_each(|object| n_here[*object as usize] += 1);
        // A cell has 65,536 Gaussians at most, so that hardly ever one is left over.
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
            },
            records: Vec::new(),
            vectors: Vec::new(),
            steps: Vec::new(),
            run_ends: Vec::new(),
            run_objects: Vec::new(),
            photos: String::new(),
        };
        let mut number_of = vec![NO_OBJECT; n_here.len()];
        for (number, object) in here.into_iter().enumerate() {
            number_of[object] = number as u16;
            let n_here = n_here[object];
            let object = &scene.objects[object];
            let name = plain(&object.photo);
            // Many objects are seen best in the same photo.
            let photo_start = cell.photos.find(&name).unwrap_or_else(|| {
                cell.photos.push_str(&name);
                cell.photos.len() - name.len()
            });
            cell.records.push(ObjectRecord {
                id: object.id,
                position_in_world: object.position_in_world.to_array(),
                box_min: object.box_in_world.min.to_array(),
                box_max: object.box_in_world.max.to_array(),
                n_gaussians: object.n_gaussians,
                n_gaussians_here: n_here,
                photo_box_px: object.photo_box_px,
                photo_start: photo_start as u32,
                photo_bytes: name.len() as u32,
            });
            let (components, steps) = quantise_vectors(&object.vectors, dim, N_VECTORS);
            cell.vectors.extend(components);
            cell.steps.extend(steps);
        }
        for (index, local) in locals.iter().enumerate() {
            let object = object_of[*local as usize];
            let number = if object == NONE { NO_OBJECT } else { number_of[object as usize] };
            if cell.run_objects.last() != Some(&number) {
                cell.run_objects.push(number);
                cell.run_ends.push(0);
            }
            cell.run_ends.last_mut().into_iter().for_each(|end| *end = index as u32 + 1);
        }
        (cell.header.n_runs, cell.header.photos_bytes) =
            (cell.run_ends.len() as u32, cell.photos.len() as u32);
        cell
    }

    /// Returns the columns.
    pub fn view(&self) -> Objects<'_> {
        Objects {
            header: self.header,
            records: &self.records,
            vectors: &self.vectors,
            steps: &self.steps,
            run_ends: &self.run_ends,
            run_objects: &self.run_objects,
            photos: &self.photos,
        }
    }
}

/// Returns a name that terminals and readers take: no control characters, not too long.
fn plain(name: &str) -> String {
    let mut plain: String =
        name.chars().map(|c| if c.is_control() { char::REPLACEMENT_CHARACTER } else { c }).collect();
    let end = (0..=MAX_PHOTO_BYTES.min(plain.len())).rev().find(|end| plain.is_char_boundary(*end));
    plain.truncate(end.unwrap_or(0));
    plain
}
