//! Checks the sections of a shard's objects.

use std::ops::Range;

use super::columns::{
    MAX_PHOTO_BYTES, MAX_VECTORS, NO_OBJECT, ObjectRecord, Objects, ObjectsHeader, section,
};
use crate::container::{ContainerError, Layout, damaged};

/// Largest step of a vector: components are scaled to about unit length.
const MAX_STEP: f32 = 4096.0;
/// Largest error of a score: the longest difference of two vectors of about unit length.
const MAX_ERROR: f32 = 4.0;

/// Where the columns of a shard's checked objects lie.
#[derive(Clone, Debug)]
pub(crate) struct ObjectsLayout {
    header: ObjectsHeader,
    columns: [Range<usize>; 6],
}

impl ObjectsLayout {
    /// Checks the objects of a shard of `n_gaussians` Gaussians and `m` components; returns `None` if it has none.
    pub(crate) fn check(
        bytes: &[u8],
        layout: &Layout,
        n_gaussians: u32,
        m: usize,
    ) -> Result<Option<Self>, ContainerError> {
        let Some(at_header) = layout.find(section::HEADER) else { return Ok(None) };
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
        let n_here = counted.map_err(|object| {
            damaged(columns[4].start, format!("a run belongs to object {object} of {n}"))
        })?;
        let records: Vec<ObjectRecord> = bytemuck::pod_collect_to_vec(&bytes[columns[0].clone()]);
        for (at, (record, n_here)) in records.iter().zip(&n_here).enumerate() {
            if let Some(what) = fault(record, *n_here, photos) {
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

/// Returns the Gaussians of each of `n` objects, or the object of a run that is none of them.
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
