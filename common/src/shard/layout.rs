//! Checks the bytes of a shard before they are read, and keeps the places of its columns.

use std::ops::Range;

use bytemuck::Pod;
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
use crate::landmarks::LandmarksLayout;
use crate::objects::ObjectsLayout;
use crate::occupancy::OccupancyLayout;
use crate::photo_poses::PhotoPosesLayout;

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

    /// Returns the box of the places that positions may have: that of the means.
    pub fn position_box(&self) -> Aabb {
        let steps = self.position_bits.map(|bits| ((1u64 << bits) - 1) as f64);
        let min = DVec3::from(self.origin_in_world);
        let size = DVec3::new(steps[0], steps[1], steps[2]) * DVec3::from(self.position_step);
        Aabb { min, max: min + size }
    }
}

#[derive(Clone, Debug)]
pub struct ShardLayout {
    pub header: ShardHeader,
    positions: Range<usize>,
    centroid_starts: Range<usize>,
    centroids: Range<usize>,
    radii: Range<usize>,
    basis: Option<[Range<usize>; 3]>,
    residuals: Option<[Range<usize>; 5]>,
    exact: Option<[Range<usize>; 2]>,
    fine: Option<(ScoreErrors, [Range<usize>; 3])>,
    packed_indices: Option<(IndicesHeader, Range<usize>)>,
    objects: Option<ObjectsLayout>,
    appearance: Option<[Range<usize>; 3]>,
    occupancy: Option<OccupancyLayout>,
    photo_poses: Option<PhotoPosesLayout>,
    landmarks: Option<LandmarksLayout>,
}

impl ShardLayout {
    /// Checks a whole shard: container, sizes, order of centroids, finite numbers within their ranges.
    pub fn check(bytes: &[u8]) -> Result<Self, ContainerError> {
        let layout = Layout::check(bytes, MAGIC, VERSION)?;
        let header: ShardHeader = layout.value(bytes, section::HEADER, "header")?;
        let at_header = layout.find(section::HEADER).map_or(0, |range| range.start);
        check_header(&header).map_err(|what| damaged(at_header, what))?;
        let check = Checker { bytes, layout: &layout, header, at_header };
        let (n, k, m) =
            (header.n_gaussians as usize, header.n_centroids as usize, header.n_components as usize);
        let (centroid_starts, n_with_evidence) = check.centroid_starts()?;
        Ok(Self {
            header,
            positions: match PositionForm::of(header.position_bits) {
                PositionForm::Packed => layout.column::<u32>(section::POSITIONS, "positions", n)?,
                PositionForm::Wide => layout.column::<[u16; 3]>(section::POSITIONS, "positions", n)?,
                PositionForm::Full => layout.column::<[u32; 3]>(section::POSITIONS, "positions", n)?,
            },
            centroid_starts,
            centroids: layout.column::<i8>(section::CENTROIDS, "centroids", k * m)?,
            radii: check.lengths(section::RADII, "radii", k)?,
            basis: check.basis()?,
            residuals: check.residuals(n_with_evidence)?,
            exact: check.exact(n_with_evidence)?,
            fine: check.fine(n_with_evidence)?,
            packed_indices: check.packed_indices()?,
            objects: ObjectsLayout::check(bytes, &layout, header.n_gaussians, m)?,
            appearance: check.appearance()?,
            occupancy: OccupancyLayout::check(bytes, &layout)?,
            photo_poses: PhotoPosesLayout::check(bytes, &layout)?,
            landmarks: LandmarksLayout::check(bytes, &layout)?,
        })
    }

    /// Returns the parts besides the columns of [`ShardLayout::view`]; `bytes` must be those checked.
    pub fn additions<'a>(&self, bytes: &'a [u8]) -> Additions<'a> {
        let appearance = self.appearance.as_ref().map(|columns| {
            let [colours, sizes, rotations] = columns.clone().map(|range| &bytes[range]);
            Appearance {
                colours: bytemuck::cast_slice(colours),
                sizes: bytemuck::cast_slice(sizes),
                rotations: bytemuck::cast_slice(rotations),
            }
        });
        Additions {
            objects: self.objects.as_ref().map(|objects| objects.view(bytes)),
            appearance,
            occupancy: self.occupancy.as_ref().map(|occupancy| occupancy.view(bytes)),
            photo_poses: self.photo_poses.as_ref().map(|photos| photos.view(bytes)),
            landmarks: self.landmarks.as_ref().map(|landmarks| landmarks.view(bytes)),
        }
    }

    /// Returns the columns in the checked bytes.
    ///
    /// # Panics
    /// If `bytes` are shorter than those checked, or do not start at a 4-byte aligned address (mapped files and
    /// [`AlignedBytes`](crate::container::AlignedBytes) do).
    pub fn view<'a>(&self, bytes: &'a [u8]) -> ShardView<'a> {
        fn cast<'a, T: Pod>(bytes: &'a [u8], range: &Range<usize>) -> &'a [T] {
            bytemuck::cast_slice(&bytes[range.clone()])
        }
        ShardView {
            header: self.header,
            positions: match PositionForm::of(self.header.position_bits) {
                PositionForm::Packed => Positions::Packed(cast(bytes, &self.positions)),
                PositionForm::Wide => Positions::Wide(cast(bytes, &self.positions)),
                PositionForm::Full => Positions::Full(cast(bytes, &self.positions)),
            },
            centroid_starts: cast(bytes, &self.centroid_starts),
            centroids: cast(bytes, &self.centroids),
            radii: cast(bytes, &self.radii),
            basis: self.basis.as_ref().map(|[mean, vectors, steps]| Basis {
                mean: cast(bytes, mean),
                vectors: cast(bytes, vectors),
                steps: cast(bytes, steps),
            }),
            residuals: self.residuals.as_ref().map(
                |[subspace_starts, codewords, residual_scales, residual_norms, codes]| Residuals {
                    subspace_starts: cast(bytes, subspace_starts),
                    codewords: cast(bytes, codewords),
                    residual_scales: cast(bytes, residual_scales),
                    residual_norms: cast(bytes, residual_norms),
                    codes: &bytes[codes.clone()],
                },
            ),
            exact: self.exact.as_ref().map(|[indices, embeddings]| ExactColumns {
                input_indices: cast(bytes, indices),
                embeddings: cast(bytes, embeddings),
                fine: self.fine.as_ref().map(|(errors, [steps, scales, values])| Fine {
                    errors: *errors,
                    steps: cast(bytes, steps),
                    scales: cast(bytes, scales),
                    values: cast(bytes, values),
                }),
            }),
            packed_indices: (self.packed_indices.as_ref())
                .map(|(header, words)| PackedIndices { header: *header, words: cast(bytes, words) }),
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

/// Errors of fine residuals; ranges of their steps, scales and values.
type FineSections = (ScoreErrors, [Range<usize>; 3]);

impl Checker<'_> {
    fn has(&self, id: u32) -> bool {
        self.layout.find(id).is_some()
    }

    /// Returns the place of the centroid starts, and the number of Gaussians with evidence.
    fn centroid_starts(&self) -> Result<(Range<usize>, usize), ContainerError> {
        // Every centroid has members: an empty one would cost time, and K <= N bounds memory.
        let (k, most) = (self.header.n_centroids as usize, self.header.n_gaussians as usize);
        self.ascending(section::CENTROID_STARTS, "centroid starts", k + 1, most)
    }

    /// Returns the place of numbers that ascend strictly from 0, and the last, which is at most `most`.
    fn ascending(
        &self,
        id: u32,
        name: &'static str,
        len: usize,
        most: usize,
    ) -> Result<(Range<usize>, usize), ContainerError> {
        let range = self.layout.column::<u32>(id, name, len)?;
        let starts: Vec<u32> = bytemuck::pod_collect_to_vec(&self.bytes[range.clone()]);
        let last = starts[len - 1] as usize;
        if starts[0] != 0 || starts.windows(2).any(|w| w[0] >= w[1]) || last > most {
            return Err(damaged(range.start, format!("{name} do not ascend from 0 to at most {most}")));
        }
        Ok((range, last))
    }

    fn basis(&self) -> Result<Option<[Range<usize>; 3]>, ContainerError> {
        let (m, dim) = (self.header.n_components as usize, self.header.dim as usize);
        if !self.has(section::BASIS) {
            let what = format!("{m} components of {dim} without a basis, expected {dim}");
            return if m == dim { Ok(None) } else { Err(damaged(self.at_header, what)) };
        }
        let mean = self.halves(section::MEAN, "mean", dim)?;
        let vectors = self.layout.column::<i8>(section::BASIS, "basis", m * dim)?;
        Ok(Some([mean, vectors, self.lengths(section::BASIS_STEPS, "basis steps", m)?]))
    }

    fn residuals(&self, n_with_evidence: usize) -> Result<Option<[Range<usize>; 5]>, ContainerError> {
        let (k, n_subspaces) = (self.header.n_centroids as usize, self.header.n_subspaces as usize);
        if n_subspaces == 0 {
            return Ok(None);
        }
        let most = self.header.n_components as usize;
        let (starts, covered) =
            self.ascending(section::SUBSPACE_STARTS, "subspace starts", n_subspaces + 1, most)?;
        let codewords = self.halves(section::CODEWORDS, "codewords", CODEWORDS * covered)?;
        let scales = self.lengths(section::RESIDUAL_SCALES, "residual scales", k)?;
        let norms = self.lengths(section::RESIDUAL_NORMS, "residual norms", k)?;
        let n_codes = n_with_evidence.div_ceil(BLOCK) * BLOCK * n_subspaces / 2;
        Ok(Some([
            starts,
            codewords,
            scales,
            norms,
            self.layout.column::<u8>(section::CODES, "codes", n_codes)?,
        ]))
    }

    fn exact(&self, n_with_evidence: usize) -> Result<Option<[Range<usize>; 2]>, ContainerError> {
        if !self.has(section::EMBEDDINGS) {
            return Ok(None);
        }
        let (n, dim) = (self.header.n_gaussians as usize, self.header.dim as usize);
        let indices = self.layout.column::<u32>(section::INPUT_INDICES, "input indices", n)?;
        Ok(Some([indices, self.halves(section::EMBEDDINGS, "embeddings", n_with_evidence * dim)?]))
    }

    fn fine(&self, n_with_evidence: usize) -> Result<Option<FineSections>, ContainerError> {
        if !self.has(section::FINE) {
            return Ok(None);
        }
        let (k, m) = (self.header.n_centroids as usize, self.header.n_components as usize);
        let errors: ScoreErrors =
            self.layout.value(self.bytes, section::FINE_ERRORS, "errors of fine residuals")?;
        check_errors(&errors).map_err(|what| damaged(self.at_header, what))?;
        let steps = self.lengths(section::FINE_STEPS, "fine steps", m)?;
        let scales = self.lengths(section::FINE_SCALES, "fine scales", k)?;
        let values = self.layout.column::<i8>(section::FINE, "fine residuals", n_with_evidence * m)?;
        Ok(Some((errors, [steps, scales, values])))
    }

    fn packed_indices(&self) -> Result<Option<(IndicesHeader, Range<usize>)>, ContainerError> {
        if !self.has(section::PACKED_INDICES) {
            return Ok(None);
        }
        let n = self.header.n_gaussians as usize;
        let header: IndicesHeader =
            self.layout.value(self.bytes, section::PACKED_INDICES_HEADER, "header of packed indices")?;
        let Some(n_words) = indices::n_words(n, header.width_bits) else {
            let at_header = self.layout.find(section::PACKED_INDICES_HEADER).map_or(0, |range| range.start);
            let what = format!("input indices of {} bits, expected 0..=32", header.width_bits);
            return Err(damaged(at_header, what));
        };
        let range = self.layout.column::<u32>(section::PACKED_INDICES, "packed indices", n_words)?;
        let words: Vec<u32> = bytemuck::pod_collect_to_vec(&self.bytes[range.clone()]);
        PackedIndices { header, words: &words }.check(n).map_err(|what| damaged(range.start, what))?;
        Ok(Some((header, range)))
    }

    fn appearance(&self) -> Result<Option<[Range<usize>; 3]>, ContainerError> {
        if !self.has(section::COLOURS) {
            return Ok(None);
        }
        let n = self.header.n_gaussians as usize;
        Ok(Some([
            self.layout.column::<[u8; 4]>(section::COLOURS, "colours", n)?,
            self.layout.column::<[u8; 3]>(section::SIZES, "sizes", n)?,
            self.layout.column::<[u8; 3]>(section::ROTATIONS, "rotations", n)?,
        ]))
    }

    /// Returns the place of a column of lengths, each checked to be within `0..=MAX_LENGTH`.
    fn lengths(&self, id: u32, name: &'static str, len: usize) -> Result<Range<usize>, ContainerError> {
        let range = self.layout.column::<f32>(id, name, len)?;
        let values = self.bytes[range.clone()].as_chunks().0;
        if values.iter().any(|bytes| !(0.0..=MAX_LENGTH).contains(&f32::from_le_bytes(*bytes))) {
            return Err(damaged(
                range.start,
                format!("a value of the {name} is not within 0..={MAX_LENGTH}"),
            ));
        }
        Ok(range)
    }

    /// Returns the place of a column of half floats, each checked to be finite.
    fn halves(&self, id: u32, name: &'static str, len: usize) -> Result<Range<usize>, ContainerError> {
        let range = self.layout.column::<f16>(id, name, len)?;
        // Exponent bits all set is infinity or NaN (IEEE 754 binary16).
        let is_finite = |bytes: &[u8; 2]| u16::from_le_bytes(*bytes) & 0x7c00 != 0x7c00;
        if !self.bytes[range.clone()].as_chunks().0.iter().all(is_finite) {
            return Err(damaged(range.start, format!("a value of the {name} is not finite")));
        }
        Ok(range)
    }
}
