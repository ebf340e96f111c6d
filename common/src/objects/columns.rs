//! The columns that describe a shard's objects.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use glam::DVec3;

use crate::container;
use crate::frames::Aabb;

/// Marks a run of Gaussians that belong to no object.
pub const NO_OBJECT: u16 = u16::MAX;
/// Largest number of vectors of an object.
pub const MAX_VECTORS: u32 = 16;
/// Longest photo name, bytes.
pub const MAX_PHOTO_BYTES: usize = 1024;

/// Section ids.
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

/// The fixed-size header of the objects.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct ObjectsHeader {
    /// Objects with Gaussians in the cell, n.
    pub n_objects: u32,
    pub n_vectors: u32,
    pub n_runs: u32,
    /// Total length of the photo names, bytes.
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
    /// Start of the photo's name.
    pub photo_start: u32,
    /// Length of the photo's name.
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
    /// Names of photos, UTF-8.
    pub photos: &'a [u8],
}

impl<'a> Objects<'a> {
    /// Returns the sections, to be written after the shard's own.
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

    /// Returns each run of Gaussians, as indices in the shard, with the index of its object.
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
