//! The columns that describe a shard's objects.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use glam::DVec3;

use super::thumbnails::{self, Thumbnails};
use crate::container::{self, ContainerError, Layout, damaged};
use crate::frames::Aabb;
use crate::quantise::quantise;

/// Marks a run of Gaussians that belong to no object.
pub const NO_OBJECT: u16 = u16::MAX;
pub const MAX_VECTORS: u32 = 16;
pub const MAX_PHOTO_BYTES: usize = 1024;

pub mod section {
    /// [`super::ObjectsHeader`].
    pub const HEADER: u32 = 20;
    /// `[n]` [`super::ObjectRecord`].
    pub const RECORDS: u32 = 21;
    /// `[n][n_vectors][m]` i8, in the basis of the shard's centroids.
    pub const VECTORS: u32 = 22;
    /// `[n][n_vectors]` f32: the factor of each vector's components.
    pub const STEPS: u32 = 23;
    /// `[n_runs]` u32: the end of each run of Gaussians.
    pub const RUN_ENDS: u32 = 24;
    /// `[n_runs]` u16: the run's object, or [`super::NO_OBJECT`].
    pub const RUN_OBJECTS: u32 = 25;
    /// UTF-8: the names of photos, concatenated.
    pub const PHOTOS: u32 = 26;
}

#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct ObjectsHeader {
    /// Objects with Gaussians in the cell, n.
    pub n_objects: u32,
    pub n_vectors: u32,
    pub n_runs: u32,
    pub photos_bytes: u32,
    /// Mean score over a bank of texts and all objects of the scene.
    pub score_mean: f32,
    /// Standard deviation of the same scores.
    pub score_spread: f32,
    /// Largest error of an object's score: the largest distance of a vector from its stored form.
    pub score_error_bound: f32,
}

/// An object; every shard that holds part of it carries the same record, except for `n_gaussians_here`.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct ObjectRecord {
    /// Derived from the object's Gaussians: equal in all shards, and across generations while they stay the same.
    pub id: u64,
    /// Mean of the object's Gaussians that lie inside the box, world frame.
    pub position_in_world: [f64; 3],
    /// Smallest corner: 2nd percentile of the Gaussians' means along each axis.
    pub box_min: [f64; 3],
    /// Largest corner: 98th percentile.
    pub box_max: [f64; 3],
    /// Gaussians of the object in all cells.
    pub n_gaussians: u32,
    /// Gaussians of the object in this cell.
    pub n_gaussians_here: u32,
    /// Box of the object in the photo that shows it best: x0, y0, x1, y1 in pixels; x1 and y1 are exclusive.
    pub photo_box_px: [u32; 4],
    pub photo_start: u32,
    pub photo_bytes: u32,
}

impl ObjectRecord {
    pub fn bounds(&self) -> Aabb {
        Aabb { min: self.box_min.into(), max: self.box_max.into() }
    }

    pub fn position(&self) -> DVec3 {
        self.position_in_world.into()
    }
}

/// The objects' columns, borrowed from a shard's bytes or from the data to be written.
#[derive(Clone, Copy, Debug)]
pub struct Objects<'a> {
    pub header: ObjectsHeader,
    /// `[n]`.
    pub records: &'a [ObjectRecord],
    /// `[n][n_vectors][m]`: components in the basis of the shard's centroids.
    pub vectors: &'a [i8],
    /// `[n][n_vectors]`.
    pub steps: &'a [f32],
    /// `[n_runs]`, ascending; the last equals N.
    pub run_ends: &'a [u32],
    /// `[n_runs]`.
    pub run_objects: &'a [u16],
    pub photos: &'a [u8],
    pub thumbnails: Option<Thumbnails<'a>>,
}

impl<'a> Objects<'a> {
    /// Returns the objects in a shard's checked bytes.
    pub(crate) fn of(bytes: &'a [u8], layout: &Layout) -> Option<Self> {
        layout.find(section::HEADER).map(|header| Self {
            header: bytemuck::pod_read_unaligned(&bytes[header]),
            records: layout.slice(bytes, section::RECORDS),
            vectors: layout.slice(bytes, section::VECTORS),
            steps: layout.slice(bytes, section::STEPS),
            run_ends: layout.slice(bytes, section::RUN_ENDS),
            run_objects: layout.slice(bytes, section::RUN_OBJECTS),
            photos: layout.slice(bytes, section::PHOTOS),
            thumbnails: Thumbnails::of(bytes, layout),
        })
    }

    /// Returns the sections, to be written after the shard's own.
    pub fn sections(&self) -> impl Iterator<Item = (u32, &[u8])> {
        let columns = [
            (section::HEADER, bytemuck::bytes_of(&self.header)),
            (section::RECORDS, container::bytes_of(self.records)),
            (section::VECTORS, container::bytes_of(self.vectors)),
            (section::STEPS, container::bytes_of(self.steps)),
            (section::RUN_ENDS, container::bytes_of(self.run_ends)),
            (section::RUN_OBJECTS, container::bytes_of(self.run_objects)),
            (section::PHOTOS, self.photos),
        ];
        columns.into_iter().chain(self.thumbnails.iter().flat_map(Thumbnails::sections))
    }

    pub fn photo(&self, record: &ObjectRecord) -> &'a str {
        let start = record.photo_start as usize;
        let name = self.photos.get(start..start + record.photo_bytes as usize);
        name.and_then(|name| std::str::from_utf8(name).ok()).unwrap_or_default()
    }

    /// Returns the indices of a run's Gaussians in the shard.
    pub fn run(&self, run: usize) -> Range<u32> {
        run.checked_sub(1).map_or(0, |before| self.run_ends[before])..self.run_ends[run]
    }

    /// Returns the runs of Gaussians, as indices in the shard, each with the index of its object.
    pub fn runs(&self) -> impl Iterator<Item = (Range<u32>, Option<usize>)> + 'a {
        let starts = std::iter::once(&0).chain(self.run_ends);
        let object = |object: u16| (object != NO_OBJECT).then_some(usize::from(object));
        starts.zip(self.run_ends).zip(self.run_objects).map(move |((s, e), o)| (*s..*e, object(*o)))
    }
}

/// Returns the score of an object from the cosines of its vectors: the average of the first (the mean of its
/// masks) and the best of the others (its sides).
///
/// The mean alone blends sides into a vector that no text describes; the best side alone lets one odd crop among
/// hundreds match anything.
pub fn object_score(cosines: &[f32]) -> f32 {
    match cosines {
        [] => f32::NAN,
        [mean] => *mean,
        [mean, sides @ ..] => 0.5 * (mean + sides.iter().copied().fold(f32::NEG_INFINITY, f32::max)),
    }
}

/// Largest step of a vector: components are scaled to about unit length.
const MAX_STEP: f32 = 4096.0;
/// Largest error of a score: the longest difference of two vectors of about unit length.
const MAX_ERROR: f32 = 4.0;

/// Checks the objects of a shard of `n_gaussians` Gaussians and `m` components; without any there is nothing to check.
pub(crate) fn check(bytes: &[u8], layout: &Layout, n_gaussians: u32, m: usize) -> Result<(), ContainerError> {
    let Some(at_header) = layout.find(section::HEADER) else { return Ok(()) };
    let header: ObjectsHeader = layout.value(bytes, section::HEADER, "header of the objects")?;
    if let Some(what) = header_fault(&header) {
        return Err(damaged(at_header.start, what));
    }
    let (n, n_vectors, n_runs) =
        (header.n_objects as usize, header.n_vectors as usize, header.n_runs as usize);
    let columns = [
        layout.column::<ObjectRecord>(section::RECORDS, "objects", n)?,
        layout.column::<i8>(section::VECTORS, "vectors of the objects", n * n_vectors * m)?,
        layout.column::<f32>(section::STEPS, "steps of the objects", n * n_vectors)?,
        layout.column::<u32>(section::RUN_ENDS, "ends of the runs", n_runs)?,
        layout.column::<u16>(section::RUN_OBJECTS, "objects of the runs", n_runs)?,
        layout.column::<u8>(section::PHOTOS, "names of the photos", header.photos_bytes as usize)?,
    ];
    let photos = std::str::from_utf8(&bytes[columns[5].clone()]);
    let Some(photos) = photos.ok().filter(|names| !names.chars().any(char::is_control)) else {
        let what = "the names of the photos are not UTF-8 without control characters";
        return Err(damaged(columns[5].start, what));
    };
    let steps: Vec<f32> = bytemuck::pod_collect_to_vec(&bytes[columns[2].clone()]);
    if !steps.iter().all(|step| (0.0..=MAX_STEP).contains(step)) {
        let what = format!("the steps of the objects are not all within 0..={MAX_STEP}");
        return Err(damaged(columns[2].start, what));
    }
    let ends: Vec<u32> = bytemuck::pod_collect_to_vec(&bytes[columns[3].clone()]);
    let ascends = ends.first().is_none_or(|end| *end > 0) && ends.windows(2).all(|w| w[0] < w[1]);
    if !ascends || ends.last().copied().unwrap_or(0) != n_gaussians {
        let what = format!("the ends of the runs do not ascend to {n_gaussians}");
        return Err(damaged(columns[3].start, what));
    }
    let of_runs: Vec<u16> = bytemuck::pod_collect_to_vec(&bytes[columns[4].clone()]);
    let counted = n_by_object(&ends, &of_runs, n);
    let n_here = counted
        .map_err(|object| damaged(columns[4].start, format!("a run belongs to object {object} of {n}")))?;
    let records: Vec<ObjectRecord> = bytemuck::pod_collect_to_vec(&bytes[columns[0].clone()]);
    for (at, (record, n_here)) in records.iter().zip(&n_here).enumerate() {
        if let Some(what) = fault(record, *n_here, photos) {
            let offset = columns[0].start + at * size_of::<ObjectRecord>();
            return Err(damaged(offset, format!("object {at}: {what}")));
        }
    }
    thumbnails::check(bytes, layout, n)
}

fn header_fault(header: &ObjectsHeader) -> Option<String> {
    let ObjectsHeader { n_objects: n, n_vectors, score_mean, score_spread, score_error_bound, .. } = *header;
    if n >= u32::from(NO_OBJECT) || !(1..=MAX_VECTORS).contains(&n_vectors) {
        return Some(format!(
            "{n} objects of {n_vectors} vectors each, expected fewer than {NO_OBJECT} of 1 to {MAX_VECTORS}"
        ));
    }
    let are_scores = (-1.0..=1.0).contains(&score_mean)
        && (0.0..=1.0).contains(&score_spread)
        && (0.0..=MAX_ERROR).contains(&score_error_bound);
    (!are_scores).then(|| {
        format!(
            "score_mean {score_mean}, score_spread {score_spread} and score_error_bound {score_error_bound} are not cosines: expected -1..=1, 0..=1 and 0..={MAX_ERROR}"
        )
    })
}

/// Counts the Gaussians of each of `n` objects; the error is the object of a run that is out of range.
fn n_by_object(ends: &[u32], of_runs: &[u16], n: usize) -> Result<Vec<u32>, u16> {
    let mut n_here = vec![0u32; n];
    let starts = std::iter::once(&0).chain(ends);
    for ((start, end), object) in starts.zip(ends).zip(of_runs).filter(|(_, object)| **object != NO_OBJECT) {
        *n_here.get_mut(usize::from(*object)).ok_or(*object)? += end - start;
    }
    Ok(n_here)
}

fn fault(record: &ObjectRecord, n_here: u32, photos: &str) -> Option<&'static str> {
    let bounds = record.bounds();
    let is_finite = [record.position(), bounds.min, bounds.max].iter().all(|v| v.is_finite());
    let [x0, y0, x1, y1] = record.photo_box_px;
    let name = record.photo_start as usize
        ..(record.photo_start as usize).saturating_add(record.photo_bytes as usize);
    match () {
        () if !is_finite || !bounds.min.cmple(bounds.max).all() => Some("its box is empty or not finite"),
        () if n_here == 0 || record.n_gaussians_here != n_here => {
            Some("its n_gaussians_here differs from the runs, or is 0")
        }
        () if record.n_gaussians < n_here => Some("it has fewer Gaussians than it has in this cell"),
        () if x0 > x1 || y0 > y1 => Some("its box in the photo is inverted"),
        () if name.len() > MAX_PHOTO_BYTES || photos.get(name).is_none() => {
            Some("the name of its photo lies outside the names, or is longer than 1024 bytes")
        }
        () => None,
    }
}

/// Rounds the vectors of an object (`[n][m]`, components) to 8 bits; pads them to `n_vectors` by repeating the last,
/// which changes no score. Returns components and steps; a step is 1/127 of its vector's largest component.
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

/// Collects runs of consecutive Gaussians of one object. `objects`: per Gaussian, [`NO_OBJECT`] for none. Returns the
/// end and the object of each run.
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
