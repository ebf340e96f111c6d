//! The objects of a shard: things that the masks of several views agree on. The byte table is in `FORMAT.md`.
//!
//! A shard carries the whole record of every object that has Gaussians in its cell, so that a robot with a part of the
//! scene knows what it sees a part of. Sections of their own: a shard without them, or a reader that does not know
//! them, is as before.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use glam::DVec3;

use crate::container::{self, ContainerError, Layout};
use crate::frames::Aabb;
use crate::shard::{ShardView, quantise};

/// Marks a run of Gaussians that belong to no object.
pub const NO_OBJECT: u16 = u16::MAX;
/// Vectors of an object at most.
pub const MAX_VECTORS: u32 = 16;
/// Longest name of a photo, bytes.
pub const MAX_PHOTO_BYTES: usize = 1024;
/// No vector's step is larger: components are scaled to about unit length.
const MAX_STEP: f32 = 4096.0;
/// No score is off by more: the longest difference of vectors of about unit length.
const MAX_ERROR: f32 = 4.0;

/// Ids of the sections.
pub mod section {
    /// [`super::ObjectsHeader`].
    pub const HEADER: u32 = 20;
    /// `[n]` [`super::ObjectRecord`].
    pub const RECORDS: u32 = 21;
    /// `[n][n_vectors][m]` i8, in the basis of the shard's rows.
    pub const VECTORS: u32 = 22;
    /// `[n][n_vectors]` f32: what a vector's components are multiplied by.
    pub const STEPS: u32 = 23;
    /// `[n_runs]` u32: where each run of Gaussians ends.
    pub const RUN_ENDS: u32 = 24;
    /// `[n_runs]` u16: the run's object, or [`super::NO_OBJECT`].
    pub const RUN_OBJECTS: u32 = 25;
    /// UTF-8: names of photos, one after the other.
    pub const PHOTOS: u32 = 26;
}

/// The fixed part.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct ObjectsHeader {
    /// Objects with Gaussians in the cell, n.
    pub n_objects: u32,
    /// Vectors of each.
    pub n_vectors: u32,
    /// Runs of Gaussians.
    pub n_runs: u32,
    /// Bytes of the photos' names.
    pub photos_bytes: u32,
    /// Mean of the scores of a bank of texts and all objects of the scene.
    pub score_mean: f32,
    /// Their standard deviation.
    pub score_spread: f32,
    /// No score of an object is off by more: the largest distance of a vector from what is kept of it.
    pub score_error_bound: f32,
}

/// An object, as every shard that holds some of it says.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct ObjectRecord {
    /// The same in all shards of a generation, and of another one if its Gaussians are.
    pub id: u64,
    /// Mean of its Gaussians inside the box, world frame.
    pub position_in_world: [f64; 3],
    /// Smallest corner: 2nd percentile of its Gaussians' means along each axis.
    pub box_min: [f64; 3],
    /// Largest corner: 98th percentile.
    pub box_max: [f64; 3],
    /// Its Gaussians, in all cells.
    pub n_gaussians: u32,
    /// Of those, in this one.
    pub n_gaussians_here: u32,
    /// Where it lies in the photo that shows it best: x0, y0, x1, y1 in pixels, the latter exclusive.
    pub photo_box_px: [u32; 4],
    /// Where the photo's name starts.
    pub photo_start: u32,
    /// Bytes of the photo's name.
    pub photo_bytes: u32,
}

impl ObjectRecord {
    /// Returns the box.
    pub fn bounds(&self) -> Aabb {
        Aabb { min: self.box_min.into(), max: self.box_max.into() }
    }

    /// Returns the position.
    pub fn position(&self) -> DVec3 {
        self.position_in_world.into()
    }
}

/// Objects as columns, borrowed from a shard's bytes, or from what they are to be written from.
#[derive(Clone, Copy, Debug)]
pub struct Objects<'a> {
    /// The fixed part.
    pub header: ObjectsHeader,
    /// `[n]`.
    pub records: &'a [ObjectRecord],
    /// `[n][n_vectors][m]`: components as a row has them.
    pub vectors: &'a [i8],
    /// `[n][n_vectors]`.
    pub steps: &'a [f32],
    /// `[n_runs]`, ascending: the last is N.
    pub run_ends: &'a [u32],
    /// `[n_runs]`.
    pub run_objects: &'a [u16],
    /// Names of photos, UTF-8.
    pub photos: &'a [u8],
}

impl<'a> Objects<'a> {
    /// Returns the sections, to be written behind a shard's own.
    pub fn sections(&self) -> [(u32, &[u8]); 7] {
        [
            (section::HEADER, bytemuck::bytes_of(&self.header)),
            (section::RECORDS, container::bytes_of(self.records)),
            (section::VECTORS, container::bytes_of(self.vectors)),
            (section::STEPS, container::bytes_of(self.steps)),
            (section::RUN_ENDS, container::bytes_of(self.run_ends)),
            (section::RUN_OBJECTS, container::bytes_of(self.run_objects)),
            (section::PHOTOS, self.photos),
        ]
    }

    /// Returns the name of the photo that shows an object best.
    pub fn photo(&self, record: &ObjectRecord) -> &'a str {
        let start = record.photo_start as usize;
        let name = self.photos.get(start..start + record.photo_bytes as usize);
        name.and_then(|name| std::str::from_utf8(name).ok()).unwrap_or_default()
    }

    /// Returns the indices of a run's Gaussians in the shard.
    pub fn run(&self, run: usize) -> Range<u32> {
        run.checked_sub(1).map_or(0, |before| self.run_ends[before])..self.run_ends[run]
    }

    /// Returns the runs of Gaussians: their indices in the shard, and their object's.
    pub fn runs(&self) -> impl Iterator<Item = (Range<u32>, Option<usize>)> + 'a {
        let starts = std::iter::once(&0).chain(self.run_ends);
        let object = |object: u16| (object != NO_OBJECT).then_some(usize::from(object));
        starts.zip(self.run_ends).zip(self.run_objects).map(move |((s, e), o)| (*s..*e, object(*o)))
    }

    /// Returns the score of each object with a query (`[dim]`), see [`object_score`], in float64. `shard`: the one that
    /// they are of.
    pub fn scores(&self, shard: &ShardView<'_>, query: &[f32]) -> Vec<f32> {
        let (offset, of_components) = shard.components_of_query(query);
        let m = of_components.len();
        let product = |(at, step): (usize, &f32)| {
            let vector = self.vectors[at * m..][..m].iter();
            let sum: f64 = vector.zip(&of_components).map(|(v, q)| f64::from(*v) * q).sum();
            (offset + f64::from(*step) * sum) as f32
        };
        let products: Vec<f32> = self.steps.iter().enumerate().map(product).collect();
        products.chunks_exact(self.header.n_vectors as usize).map(object_score).collect()
    }

    /// Returns the vectors of all objects, `[n][n_vectors][dim]`. `shard`: the one that they are of.
    pub fn decode(&self, shard: &ShardView<'_>) -> Vec<f64> {
        let (m, dim) = (shard.header.n_components as usize, shard.header.dim as usize);
        let mut vectors = vec![0.0; self.steps.len() * dim];
        for (at, (out, step)) in vectors.chunks_exact_mut(dim).zip(self.steps).enumerate() {
            let vector = self.vectors[at * m..][..m].iter();
            let components: Vec<f64> = vector.map(|v| f64::from(*v) * f64::from(*step)).collect();
            shard.combine(&components, out);
        }
        vectors
    }
}

/// Returns the score of an object, from the cosines of its vectors: the mean of that of its masks' mean and of the
/// best of those that stand for its sides. The mean alone is that of a blend of sides that no text describes; the best
/// alone is that of the one crop in hundreds that happens to look like anything.
pub fn object_score(cosines: &[f32]) -> f32 {
    match cosines {
        [] => f32::NAN,
        [mean] => *mean,
        [mean, sides @ ..] => 0.5 * (mean + sides.iter().copied().fold(f32::NEG_INFINITY, f32::max)),
    }
}

/// Rounds the vectors of an object (`[n][m]`, components) to 8 bits and repeats the last up to `n_vectors`, which changes
/// no score. Returns components and steps, of which one is 1/127 of a vector's largest component.
pub fn quantise_vectors(vectors: &[f32], m: usize, n_vectors: usize) -> (Vec<i8>, Vec<f32>) {
    let (mut components, mut steps) = (Vec::new(), Vec::new());
    let last = (vectors.len() / m.max(1)).saturating_sub(1);
    for vector in 0..n_vectors {
        let (rounded, step) = quantise(&vectors[vector.min(last) * m..][..m]);
        components.extend(rounded);
        steps.push(step);
    }
    (components, steps)
}

/// Collects the runs of neighbours of the same object. `objects`: of each Gaussian of a shard, [`NO_OBJECT`] for none.
/// Returns where each run ends, and its object.
pub fn collect_runs(objects: impl IntoIterator<Item = u16>) -> (Vec<u32>, Vec<u16>) {
    let (mut run_ends, mut run_objects) = (Vec::new(), Vec::new());
    for (index, object) in (0u32..).zip(objects) {
        if run_objects.last() != Some(&object) {
            run_objects.push(object);
            run_ends.push(index);
        }
        run_ends.last_mut().into_iter().for_each(|end| *end = index + 1);
    }
    (run_ends, run_objects)
}

/// Where the checked objects of a shard lie.
#[derive(Clone, Debug)]
pub(crate) struct ObjectsLayout {
    header: ObjectsHeader,
    columns: [Range<usize>; 6],
}

impl ObjectsLayout {
    /// Checks the sections of a shard of `n_gaussians` Gaussians and rows of `m` components; `None` without.
    pub(crate) fn check(
        bytes: &[u8],
        layout: &Layout,
        n_gaussians: u32,
        m: usize,
    ) -> Result<Option<Self>, ContainerError> {
        let Some(at_header) = layout.find(section::HEADER) else { return Ok(None) };
        let damaged =
            |offset: usize, what: String| ContainerError::Damaged { offset_bytes: offset as u64, what };
        let header: ObjectsHeader = layout.value(bytes, section::HEADER, "objects' header")?;
        let (n, n_vectors, n_runs) =
            (header.n_objects as usize, header.n_vectors as usize, header.n_runs as usize);
        if n >= usize::from(NO_OBJECT) || !(1..=MAX_VECTORS).contains(&header.n_vectors) {
            let what = format!(
                "{n} objects of {n_vectors} vectors, expected fewer than {NO_OBJECT} of 1 to {MAX_VECTORS}"
            );
            return Err(damaged(at_header.start, what));
        }
        let is_score = |score: f32| (-1.0..=1.0).contains(&score);
        if !is_score(header.score_mean)
            || !is_score(header.score_spread)
            || header.score_spread < 0.0
            || !(0.0..=MAX_ERROR).contains(&header.score_error_bound)
        {
            return Err(damaged(at_header.start, "scores of objects, or their error, are no cosines".into()));
        }
        let columns = [
            layout.column::<ObjectRecord>(section::RECORDS, "objects", n)?,
            layout.column::<i8>(section::VECTORS, "objects' vectors", n * n_vectors * m)?,
            layout.column::<f32>(section::STEPS, "objects' steps", n * n_vectors)?,
            layout.column::<u32>(section::RUN_ENDS, "ends of objects' runs", n_runs)?,
            layout.column::<u16>(section::RUN_OBJECTS, "objects of runs", n_runs)?,
            layout.column::<u8>(section::PHOTOS, "photos' names", header.photos_bytes as usize)?,
        ];
        let photos = std::str::from_utf8(&bytes[columns[5].clone()]);
        let Some(photos) = photos.ok().filter(|names| !names.chars().any(char::is_control)) else {
            return Err(damaged(columns[5].start, "photos' names are no plain UTF-8".into()));
        };
        let steps: Vec<f32> = bytemuck::pod_collect_to_vec(&bytes[columns[2].clone()]);
        if !steps.iter().all(|step| (0.0..=MAX_STEP).contains(step)) {
            return Err(damaged(columns[2].start, format!("steps of objects are not in 0..={MAX_STEP}")));
        }
        let ends: Vec<u32> = bytemuck::pod_collect_to_vec(&bytes[columns[3].clone()]);
        let of_runs: Vec<u16> = bytemuck::pod_collect_to_vec(&bytes[columns[4].clone()]);
        let ascends = ends.first().is_none_or(|end| *end > 0) && ends.windows(2).all(|w| w[0] < w[1]);
        if !ascends || ends.last().copied().unwrap_or(0) != n_gaussians {
            return Err(damaged(columns[3].start, format!("runs of objects do not ascend to {n_gaussians}")));
        }
        let mut n_here = vec![0u32; n];
        let starts = std::iter::once(&0).chain(&ends);
        for ((start, end), object) in starts.zip(&ends).zip(&of_runs).filter(|(_, o)| **o != NO_OBJECT) {
            match n_here.get_mut(usize::from(*object)) {
                Some(n_here) => *n_here += end - start,
                None => return Err(damaged(columns[4].start, format!("object {object} of {n}"))),
            }
        }
        let records: Vec<ObjectRecord> = bytemuck::pod_collect_to_vec(&bytes[columns[0].clone()]);
        for (at, (record, n_here)) in records.iter().zip(&n_here).enumerate() {
            if let Some(what) = wrong(record, *n_here, photos) {
                let offset = columns[0].start + at * size_of::<ObjectRecord>();
                return Err(damaged(offset, format!("object {at}: {what}")));
            }
        }
        Ok(Some(Self { header, columns }))
    }

    /// Returns the columns of the bytes that were checked.
    pub(crate) fn view<'a>(&self, bytes: &'a [u8]) -> Objects<'a> {
        let [records, vectors, steps, run_ends, run_objects, photos] =
            self.columns.each_ref().map(|range| &bytes[range.clone()]);
        Objects {
            header: self.header,
            records: bytemuck::cast_slice(records),
            vectors: bytemuck::cast_slice(vectors),
            steps: bytemuck::cast_slice(steps),
            run_ends: bytemuck::cast_slice(run_ends),
            run_objects: bytemuck::cast_slice(run_objects),
            photos,
        }
    }
}

/// Returns what is wrong with a record.
fn wrong(record: &ObjectRecord, n_here: u32, photos: &str) -> Option<&'static str> {
    let bounds = record.bounds();
    let is_finite = [record.position(), bounds.min, bounds.max].iter().all(|v| v.is_finite());
    let [x0, y0, x1, y1] = record.photo_box_px;
    let name = record.photo_start as usize
        ..(record.photo_start as usize).saturating_add(record.photo_bytes as usize);
    match () {
        () if !is_finite || !bounds.min.cmple(bounds.max).all() => Some("its box is empty or not finite"),
        () if n_here == 0 || record.n_gaussians_here != n_here => {
            Some("its Gaussians are not those of the runs")
        }
        () if record.n_gaussians < n_here => Some("it has fewer Gaussians than the cell has of it"),
        () if x0 > x1 || y0 > y1 => Some("its box in the photo is turned over"),
        () if name.len() > MAX_PHOTO_BYTES || photos.get(name).is_none() => Some("its photo has no name"),
        () => None,
    }
}

#[cfg(test)]
mod tests;
