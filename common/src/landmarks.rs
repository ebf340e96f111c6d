//! Scene points with feature codes, from which a robot finds the camera of a photo. Byte table: `docs/formats.md`.

use bytemuck::{Pod, Zeroable};
use glam::DVec3;

use crate::container::{ContainerError, Layout, damaged};

pub mod section {
    /// One [`super::LandmarksHeader`].
    pub const HEADER: u32 = 70;
    /// `[n]` records of 24 bytes.
    pub const LANDMARKS: u32 = 71;
}

/// Steps of a position along each axis.
const STEPS: f64 = u16::MAX as f64;

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Landmark {
    pub position_in_world: DVec3,
    pub code: u128,
    /// Number of a mapping photo that shows it, by sorted name; those beyond 65,535 share numbers.
    pub view: u16,
}

/// The common header of a shard's landmarks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct LandmarksHeader {
    /// Smallest corner of the landmarks, world frame.
    pub origin_in_world: [f64; 3],
    /// World units per step of a position, per axis.
    pub step: [f64; 3],
    /// Version of the codes; other versions cannot be matched.
    pub code_version: u32,
    pub reserved: u32,
}

#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
struct Record {
    position: [u16; 3],
    view: u16,
    /// Little-endian, the lowest first.
    code: [u32; 4],
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Landmarks<'a> {
    pub header: &'a LandmarksHeader,
    records: &'a [Record],
}

impl<'a> Landmarks<'a> {
    /// Returns the landmarks in a shard's checked bytes.
    pub(crate) fn of(bytes: &'a [u8], layout: &Layout) -> Option<Self> {
        let header = bytemuck::from_bytes(&bytes[layout.find(section::HEADER)?]);
        Some(Self { header, records: layout.slice(bytes, section::LANDMARKS) })
    }

    #[expect(clippy::len_without_is_empty, reason = "a shard without landmarks has no such sections")]
    pub fn len(&self) -> usize {
        self.records.len()
    }

    pub fn iter(&self) -> impl Iterator<Item = Landmark> + use<'a> {
        let (origin, step) = (DVec3::from(self.header.origin_in_world), DVec3::from(self.header.step));
        self.records.iter().map(move |record| Landmark {
            position_in_world: origin + step * DVec3::from(record.position.map(f64::from)),
            code: record.code.iter().rev().fold(0, |code, word| code << 32 | u128::from(*word)),
            view: record.view,
        })
    }

    pub(crate) fn sections(&self) -> [(u32, &'a [u8]); 2] {
        let records = bytemuck::cast_slice(self.records);
        [(section::HEADER, bytemuck::bytes_of(self.header)), (section::LANDMARKS, records)]
    }
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct BuiltLandmarks {
    header: LandmarksHeader,
    records: Vec<Record>,
}

impl BuiltLandmarks {
    /// Packs the landmarks of a cell; those without a finite position are dropped.
    pub fn pack(code_version: u32, landmarks: &[Landmark]) -> Self {
        let finite = || landmarks.iter().filter(|landmark| landmark.position_in_world.is_finite());
        let positions = || finite().map(|landmark| landmark.position_in_world);
        let Some(min) = positions().reduce(DVec3::min) else { return Self::default() };
        let max = positions().fold(min, DVec3::max);
        // Divided before subtracting, because the difference overflows for the largest scene.
        let step = (max / STEPS - min / STEPS).max(DVec3::splat(f64::MIN_POSITIVE));
        let record = |landmark: &Landmark| Record {
            position: ((landmark.position_in_world - min) / step)
                .to_array()
                .map(|steps| steps.round() as u16),
            view: landmark.view,
            code: [0, 1, 2, 3].map(|word| (landmark.code >> (32 * word)) as u32),
        };
        let header = LandmarksHeader {
            origin_in_world: min.to_array(),
            step: step.to_array(),
            code_version,
            reserved: 0,
        };
        Self { header, records: finite().map(record).collect() }
    }

    /// Returns the columns; `None` without landmarks, because the shard then has no sections for them.
    pub fn view(&self) -> Option<Landmarks<'_>> {
        (!self.records.is_empty()).then_some(Landmarks { header: &self.header, records: &self.records })
    }

    pub fn len_bytes(&self) -> u64 {
        (size_of::<LandmarksHeader>() + size_of_val(&self.records[..])) as u64
    }
}

/// Checks the landmarks of a shard, if it has any.
pub(crate) fn check(bytes: &[u8], layout: &Layout) -> Result<(), ContainerError> {
    let Some(at) = layout.find(section::HEADER) else { return Ok(()) };
    let header: LandmarksHeader = layout.value(bytes, section::HEADER, "header of the landmarks")?;
    let is_sound = |axis: usize| {
        let (origin, step) = (header.origin_in_world[axis], header.step[axis]);
        step > 0.0 && origin.is_finite() && (origin + step * STEPS).is_finite()
    };
    if ![0, 1, 2].into_iter().all(is_sound) {
        let what = format!(
            "landmarks from {:?} in steps of {:?}, expected finite positions and steps above 0",
            header.origin_in_world, header.step
        );
        return Err(damaged(at.start, what));
    }
    let n_bytes = layout.find(section::LANDMARKS).map_or(0, |records| records.len());
    let n = n_bytes / size_of::<Record>();
    layout.column::<Record>(section::LANDMARKS, "landmarks", n).map(drop)
}

#[cfg(test)]
mod tests;
