//! Checks the bytes of a shard before they are read, and keeps the places of its columns.

use glam::DVec3;
use half::f16;

use super::columns::{Basis, ExactColumns, Fine, Positions, Residuals, ShardView};
use super::format::{
    BLOCK, CODEWORDS, MAGIC, MAX_DIM, MAX_SUBSPACES, PositionForm, ScoreErrors, ShardHeader, VERSION, section,
};
use super::indices::{self, IndicesHeader, PackedIndices};
use super::write::Additions;
use crate::appearance::Appearance;
use crate::container::{ContainerError, Layout, damaged, section_by_start};
use crate::frames::Aabb;
use crate::landmarks::{self, Landmarks};
use crate::objects::{self, Objects};
use crate::occupancy::{self, Occupancy};
use crate::photo_poses::{self, PhotoPoses};

/// Largest length accepted: embeddings have unit length, components about that.
const MAX_LENGTH: f32 = 4096.0;

/// First bytes of a shard that hold its header: preamble and table, padded, and the header.
pub const HEADER_END_BYTES: u64 = 4096;

impl ShardHeader {
    /// Reads the header from the first [`HEADER_END_BYTES`] of a shard, unchecked; `None` if it is not there.
    pub fn of_start(start: &[u8]) -> Option<Self> {
        let at = section_by_start(start, MAGIC, section::HEADER)?;
        let header: Self = bytemuck::try_pod_read_unaligned(start.get(at)?).ok()?;
        check_header(&header).is_ok().then_some(header)
    }

    /// Whether a shard has a section, by its first [`HEADER_END_BYTES`], unchecked.
    pub fn has_section(start: &[u8], id: u32) -> bool {
        section_by_start(start, MAGIC, id).is_some()
    }

    /// Returns the box of the places that positions may have: that of the means.
    pub fn position_box(&self) -> Aabb {
        let steps = self.position_bits.map(|bits| ((1u64 << bits) - 1) as f64);
        let min = DVec3::from(self.origin_in_world);
        let size = DVec3::new(steps[0], steps[1], steps[2]) * DVec3::from(self.position_step);
        Aabb { min, max: min + size }
    }
}

/// A checked shard: its header, and the places of its sections.
#[derive(Clone, Debug)]
pub struct ShardLayout {
    pub header: ShardHeader,
    layout: Layout,
}

impl ShardLayout {
    /// Checks a whole shard: container, sizes, order of centroids, finite numbers within their ranges.
    pub fn check(bytes: &[u8]) -> Result<Self, ContainerError> {
        let layout = Layout::check(bytes, MAGIC, VERSION)?;
        let header: ShardHeader = layout.value(bytes, section::HEADER, "header")?;
        let at_header = layout.find(section::HEADER).map_or(0, |range| range.start);
        check_header(&header).map_err(|what| damaged(at_header, what))?;
        Checker { bytes, layout: &layout, header, at_header }.check()?;
        objects::check(bytes, &layout, header.n_gaussians, header.n_components as usize)?;
        occupancy::check(bytes, &layout)?;
        photo_poses::check(bytes, &layout)?;
        landmarks::check(bytes, &layout)?;
        Ok(Self { header, layout })
    }

    /// Returns the parts besides the columns of [`ShardLayout::view`]; `bytes` must be those checked.
    pub fn additions<'a>(&self, bytes: &'a [u8]) -> Additions<'a> {
        let layout = &self.layout;
        Additions {
            objects: Objects::of(bytes, layout),
            appearance: layout.find(section::COLOURS).map(|_| Appearance {
                colours: layout.slice(bytes, section::COLOURS),
                sizes: layout.slice(bytes, section::SIZES),
                rotations: layout.slice(bytes, section::ROTATIONS),
            }),
            occupancy: Occupancy::of(bytes, layout),
            photo_poses: PhotoPoses::of(bytes, layout),
            landmarks: Landmarks::of(bytes, layout),
        }
    }

    /// Returns the columns in the checked bytes.
    ///
    /// # Panics
    /// If `bytes` are shorter than those checked, or do not start at a 4-byte aligned address (mapped files and
    /// [`AlignedBytes`](crate::container::AlignedBytes) do).
    pub fn view<'a>(&self, bytes: &'a [u8]) -> ShardView<'a> {
        let (layout, header) = (&self.layout, self.header);
        let has = |id: u32| layout.find(id).is_some();
        let fine = has(section::FINE).then(|| Fine {
            errors: bytemuck::pod_read_unaligned(layout.slice(bytes, section::FINE_ERRORS)),
            steps: layout.slice(bytes, section::FINE_STEPS),
            scales: layout.slice(bytes, section::FINE_SCALES),
            values: layout.slice(bytes, section::FINE),
        });
        ShardView {
            header,
            positions: match PositionForm::of(header.position_bits) {
                PositionForm::Packed => Positions::Packed(layout.slice(bytes, section::POSITIONS)),
                PositionForm::Wide => Positions::Wide(layout.slice(bytes, section::POSITIONS)),
                PositionForm::Full => Positions::Full(layout.slice(bytes, section::POSITIONS)),
            },
            centroid_starts: layout.slice(bytes, section::CENTROID_STARTS),
            centroids: layout.slice(bytes, section::CENTROIDS),
            radii: layout.slice(bytes, section::RADII),
            basis: has(section::BASIS).then(|| Basis {
                mean: layout.slice(bytes, section::MEAN),
                vectors: layout.slice(bytes, section::BASIS),
                steps: layout.slice(bytes, section::BASIS_STEPS),
            }),
            residuals: (header.n_subspaces > 0).then(|| Residuals {
                subspace_starts: layout.slice(bytes, section::SUBSPACE_STARTS),
                codewords: layout.slice(bytes, section::CODEWORDS),
                residual_scales: layout.slice(bytes, section::RESIDUAL_SCALES),
                residual_norms: layout.slice(bytes, section::RESIDUAL_NORMS),
                codes: layout.slice(bytes, section::CODES),
            }),
            exact: has(section::EMBEDDINGS).then(|| ExactColumns {
                input_indices: layout.slice(bytes, section::INPUT_INDICES),
                embeddings: layout.slice(bytes, section::EMBEDDINGS),
                fine,
            }),
            packed_indices: has(section::PACKED_INDICES).then(|| PackedIndices {
                header: bytemuck::pod_read_unaligned(layout.slice(bytes, section::PACKED_INDICES_HEADER)),
                words: layout.slice(bytes, section::PACKED_INDICES),
            }),
        }
    }
}

fn check_header(header: &ShardHeader) -> Result<(), String> {
    let floats = [header.origin_in_world, header.position_step, header.box_min, header.box_max];
    if floats.as_flattened().iter().any(|v| !v.is_finite()) || header.position_step.iter().any(|s| *s < 0.0) {
        return Err("a coordinate of the header is not finite, or a position step is negative".into());
    }
    if (0..3).any(|axis| header.box_min[axis] > header.box_max[axis]) {
        return Err(format!("box {:?}..{:?} is empty", header.box_min, header.box_max));
    }
    let (n, k, dim, m) =
        (header.n_gaussians, header.n_centroids, header.dim as usize, header.n_components as usize);
    if k > n || dim == 0 || dim > MAX_DIM || m > dim {
        return Err(format!(
            "{k} centroids for {n} Gaussians, {m} components of {dim}: expected at most a centroid a Gaussian, at most dim components, and dim within 1..={MAX_DIM}"
        ));
    }
    if header.n_subspaces as usize > MAX_SUBSPACES.min(m) || !header.n_subspaces.is_multiple_of(2) {
        return Err(format!(
            "{} subspaces of {m} components, expected an even number of at most {}",
            header.n_subspaces,
            MAX_SUBSPACES.min(m)
        ));
    }
    let bits = header.position_bits;
    let is_packed = PositionForm::of(bits) == PositionForm::Packed;
    if bits[3] != 0 || is_packed && bits.iter().map(|b| u32::from(*b)).sum::<u32>() > 32 {
        return Err(format!(
            "positions of {bits:?} bits, expected 32 in all at most, [16, 16, 16, 0] or [32, 32, 32, 0]"
        ));
    }
    if !(0.0..=MAX_LENGTH).contains(&header.centroid_step) {
        return Err(format!(
            "the step of the centroids is {}, expected 0..={MAX_LENGTH}",
            header.centroid_step
        ));
    }
    check_errors(&header.errors)
}

fn check_errors(errors: &ScoreErrors) -> Result<(), String> {
    let ScoreErrors { mean, likely, max, spread } = *errors;
    if [mean, likely, max, spread].iter().any(|v| !(0.0..=MAX_LENGTH).contains(v)) {
        return Err(format!("errors of scores are {errors:?}, expected 0..={MAX_LENGTH} each"));
    }
    Ok(())
}

struct Checker<'a> {
    bytes: &'a [u8],
    layout: &'a Layout,
    header: ShardHeader,
    at_header: usize,
}

impl Checker<'_> {
    fn check(&self) -> Result<(), ContainerError> {
        let (layout, n) = (self.layout, self.header.n_gaussians as usize);
        let (k, m) = (self.header.n_centroids as usize, self.header.n_components as usize);
        match PositionForm::of(self.header.position_bits) {
            PositionForm::Packed => layout.column::<u32>(section::POSITIONS, "positions", n)?,
            PositionForm::Wide => layout.column::<[u16; 3]>(section::POSITIONS, "positions", n)?,
            PositionForm::Full => layout.column::<[u32; 3]>(section::POSITIONS, "positions", n)?,
        };
        // Every centroid has members: an empty one would cost time, and K <= N bounds memory.
        let n_with_evidence = self.ascending(section::CENTROID_STARTS, "centroid starts", k + 1, n)?;
        layout.column::<i8>(section::CENTROIDS, "centroids", k * m)?;
        self.lengths(section::RADII, "radii", k)?;
        self.basis()?;
        self.residuals(n_with_evidence)?;
        if self.has(section::EMBEDDINGS) {
            layout.column::<u32>(section::INPUT_INDICES, "input indices", n)?;
            let n_values = n_with_evidence * self.header.dim as usize;
            self.halves(section::EMBEDDINGS, "embeddings", n_values)?;
        }
        if self.has(section::FINE) {
            let errors: ScoreErrors =
                layout.value(self.bytes, section::FINE_ERRORS, "errors of fine residuals")?;
            check_errors(&errors).map_err(|what| damaged(self.at_header, what))?;
            self.lengths(section::FINE_STEPS, "fine steps", m)?;
            self.lengths(section::FINE_SCALES, "fine scales", k)?;
            layout.column::<i8>(section::FINE, "fine residuals", n_with_evidence * m)?;
        }
        if self.has(section::PACKED_INDICES) {
            self.packed_indices(n)?;
        }
        if self.has(section::COLOURS) {
            layout.column::<[u8; 4]>(section::COLOURS, "colours", n)?;
            layout.column::<[u8; 3]>(section::SIZES, "sizes", n)?;
            layout.column::<[u8; 3]>(section::ROTATIONS, "rotations", n)?;
        }
        Ok(())
    }

    fn has(&self, id: u32) -> bool {
        self.layout.find(id).is_some()
    }

    /// Checks numbers that ascend strictly from 0; returns the last, which is at most `most`.
    fn ascending(
        &self,
        id: u32,
        name: &'static str,
        len: usize,
        most: usize,
    ) -> Result<usize, ContainerError> {
        let range = self.layout.column::<u32>(id, name, len)?;
        let starts: Vec<u32> = bytemuck::pod_collect_to_vec(&self.bytes[range.clone()]);
        let last = starts[len - 1] as usize;
        if starts[0] != 0 || starts.windows(2).any(|w| w[0] >= w[1]) || last > most {
            return Err(damaged(range.start, format!("{name} do not ascend from 0 to at most {most}")));
        }
        Ok(last)
    }

    fn basis(&self) -> Result<(), ContainerError> {
        let (m, dim) = (self.header.n_components as usize, self.header.dim as usize);
        if !self.has(section::BASIS) {
            let what = format!("{m} components of {dim} without a basis, expected {dim}");
            return if m == dim { Ok(()) } else { Err(damaged(self.at_header, what)) };
        }
        self.halves(section::MEAN, "mean", dim)?;
        self.layout.column::<i8>(section::BASIS, "basis", m * dim)?;
        self.lengths(section::BASIS_STEPS, "basis steps", m)
    }

    fn residuals(&self, n_with_evidence: usize) -> Result<(), ContainerError> {
        let (k, n_subspaces) = (self.header.n_centroids as usize, self.header.n_subspaces as usize);
        if n_subspaces == 0 {
            return Ok(());
        }
        let most = self.header.n_components as usize;
        let covered = self.ascending(section::SUBSPACE_STARTS, "subspace starts", n_subspaces + 1, most)?;
        self.halves(section::CODEWORDS, "codewords", CODEWORDS * covered)?;
        self.lengths(section::RESIDUAL_SCALES, "residual scales", k)?;
        self.lengths(section::RESIDUAL_NORMS, "residual norms", k)?;
        let n_codes = n_with_evidence.div_ceil(BLOCK) * BLOCK * n_subspaces / 2;
        self.layout.column::<u8>(section::CODES, "codes", n_codes).map(drop)
    }

    fn packed_indices(&self, n: usize) -> Result<(), ContainerError> {
        let header: IndicesHeader =
            self.layout.value(self.bytes, section::PACKED_INDICES_HEADER, "header of packed indices")?;
        let Some(n_words) = indices::n_words(n, header.width_bits) else {
            let at_header = self.layout.find(section::PACKED_INDICES_HEADER).map_or(0, |range| range.start);
            let what = format!("input indices of {} bits, expected 0..=32", header.width_bits);
            return Err(damaged(at_header, what));
        };
        let range = self.layout.column::<u32>(section::PACKED_INDICES, "packed indices", n_words)?;
        let words: Vec<u32> = bytemuck::pod_collect_to_vec(&self.bytes[range.clone()]);
        PackedIndices { header, words: &words }.check(n).map_err(|what| damaged(range.start, what))
    }

    /// Checks a column of lengths, each within `0..=MAX_LENGTH`.
    fn lengths(&self, id: u32, name: &'static str, len: usize) -> Result<(), ContainerError> {
        let range = self.layout.column::<f32>(id, name, len)?;
        let mut values = self.bytes[range.clone()].as_chunks().0.iter().map(|v| f32::from_le_bytes(*v));
        match values.all(|value| (0.0..=MAX_LENGTH).contains(&value)) {
            true => Ok(()),
            false => {
                let what = format!("a value of the {name} is not within 0..={MAX_LENGTH}");
                Err(damaged(range.start, what))
            }
        }
    }

    /// Checks a column of half floats, each finite.
    fn halves(&self, id: u32, name: &'static str, len: usize) -> Result<(), ContainerError> {
        let range = self.layout.column::<f16>(id, name, len)?;
        // Exponent bits all set is infinity or NaN (IEEE 754 binary16).
        let is_finite = |bytes: &[u8; 2]| u16::from_le_bytes(*bytes) & 0x7c00 != 0x7c00;
        match self.bytes[range.clone()].as_chunks().0.iter().all(is_finite) {
            true => Ok(()),
            false => Err(damaged(range.start, format!("a value of the {name} is not finite"))),
        }
    }
}
