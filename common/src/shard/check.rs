//! Checks the bytes of a shard before anything is read from them.

use std::ops::Range;

use half::f16;

use super::format::{
    BLOCK, CODEWORDS, MAGIC, MAX_DIM, MAX_SUBSPACES, PositionForm, ScoreErrors, ShardHeader, VERSION, section,
};
use super::indices::{self, IndicesHeader, PackedIndices};
use super::layout::ShardLayout;
use crate::container::{ContainerError, Layout};
use crate::objects::ObjectsLayout;
use crate::occupancy::OccupancyLayout;
use crate::photo_poses::PhotoPosesLayout;

/// Largest length accepted: embeddings have unit length, and components are scaled to about that.
const MAX_LENGTH: f32 = 4096.0;

impl ShardLayout {
    /// Checks a whole shard: container, sizes, order of centroids, finite numbers within their ranges.
    ///
    /// # Errors
    /// [`ContainerError`], naming the byte.
    pub fn check(bytes: &[u8]) -> Result<Self, ContainerError> {
        let layout = Layout::check(bytes, MAGIC, VERSION)?;
        let header: ShardHeader = layout.value(bytes, section::HEADER, "header")?;
        let at_header = layout.find(section::HEADER).map_or(0, |range| range.start);
        check_header(&header).map_err(|what| damaged(at_header, what))?;
        let (n, k, dim) = (header.n_gaussians as usize, header.n_centroids as usize, header.dim as usize);
        let (m, n_subspaces) = (header.n_components as usize, header.n_subspaces as usize);
        let centroid_starts = layout.column::<u32>(section::CENTROID_STARTS, "centroid starts", k + 1)?;
        let starts: Vec<u32> = bytemuck::pod_collect_to_vec(&bytes[centroid_starts.clone()]);
        // Every centroid has members: an empty one would cost time, and K <= N bounds memory.
        if starts[0] != 0 || starts.windows(2).any(|w| w[0] >= w[1]) || starts[k] as usize > n {
            let what = format!("centroid starts do not ascend from 0 to at most {n}");
            return Err(damaged(centroid_starts.start, what));
        }
        let n_with_evidence = starts[k] as usize;
        let centroids = layout.column::<i8>(section::CENTROIDS, "centroids", k * m)?;
        let radii = lengths(&layout, bytes, section::RADII, "radii", k)?;
        let basis = match layout.find(section::BASIS) {
            None if m != dim => {
                return Err(damaged(
                    at_header,
                    format!("{m} components of {dim} without a basis, expected {dim}"),
                ));
            }
            None => None,
            Some(_) => {
                let mean = halves(&layout, bytes, section::MEAN, "mean", dim)?;
                let vectors = layout.column::<i8>(section::BASIS, "basis", m * dim)?;
                Some([mean, vectors, lengths(&layout, bytes, section::BASIS_STEPS, "basis steps", m)?])
            }
        };
        let residuals = match n_subspaces {
            0 => None,
            _ => {
                let subspace_starts =
                    layout.column::<u32>(section::SUBSPACE_STARTS, "subspace starts", n_subspaces + 1)?;
                let of_subspaces: Vec<u32> = bytemuck::pod_collect_to_vec(&bytes[subspace_starts.clone()]);
                let end = of_subspaces[n_subspaces] as usize;
                if of_subspaces[0] != 0 || of_subspaces.windows(2).any(|w| w[0] >= w[1]) || end > m {
                    let what = format!("subspace starts do not ascend from 0 to at most {m}");
                    return Err(damaged(subspace_starts.start, what));
                }
                let codewords = halves(&layout, bytes, section::CODEWORDS, "codewords", CODEWORDS * end)?;
                let residual_scales =
                    lengths(&layout, bytes, section::RESIDUAL_SCALES, "residual scales", k)?;
                let residual_norms = lengths(&layout, bytes, section::RESIDUAL_NORMS, "residual norms", k)?;
                let n_codes = n_with_evidence.div_ceil(BLOCK) * BLOCK * n_subspaces / 2;
                let codes = layout.column::<u8>(section::CODES, "codes", n_codes)?;
                Some([subspace_starts, codewords, residual_scales, residual_norms, codes])
            }
        };
        let exact = match layout.find(section::EMBEDDINGS) {
            None => None,
            Some(_) => {
                let indices = layout.column::<u32>(section::INPUT_INDICES, "input indices", n)?;
                Some([
                    indices,
                    halves(&layout, bytes, section::EMBEDDINGS, "embeddings", n_with_evidence * dim)?,
                ])
            }
        };
        let fine = match layout.find(section::FINE) {
            None => None,
            Some(_) => {
                let errors: ScoreErrors =
                    layout.value(bytes, section::FINE_ERRORS, "errors of fine residuals")?;
                check_errors(&errors).map_err(|what| damaged(at_header, what))?;
                let steps = lengths(&layout, bytes, section::FINE_STEPS, "fine steps", m)?;
                let scales = lengths(&layout, bytes, section::FINE_SCALES, "fine scales", k)?;
                let values = layout.column::<i8>(section::FINE, "fine residuals", n_with_evidence * m)?;
                Some((errors, [steps, scales, values]))
            }
        };
        let positions = match PositionForm::of(header.position_bits) {
            PositionForm::Packed => layout.column::<u32>(section::POSITIONS, "positions", n)?,
            PositionForm::Wide => layout.column::<[u16; 3]>(section::POSITIONS, "positions", n)?,
            PositionForm::Full => layout.column::<[u32; 3]>(section::POSITIONS, "positions", n)?,
        };
        let packed_indices = match layout.find(section::PACKED_INDICES) {
            None => None,
            Some(_) => Some(packed_indices(&layout, bytes, n)?),
        };
        let objects = ObjectsLayout::check(bytes, &layout, header.n_gaussians, m)?;
        let appearance = match layout.find(section::COLOURS) {
            None => None,
            Some(_) => Some([
                layout.column::<[u8; 4]>(section::COLOURS, "colours", n)?,
                layout.column::<[u8; 3]>(section::SIZES, "sizes", n)?,
                layout.column::<[u8; 3]>(section::ROTATIONS, "rotations", n)?,
            ]),
        };
        let occupancy = OccupancyLayout::check(bytes, &layout)?;
        let photo_poses = PhotoPosesLayout::check(bytes, &layout)?;
        Ok(Self {
            header,
            positions,
            centroid_starts,
            centroids,
            radii,
            basis,
            residuals,
            exact,
            fine,
            packed_indices,
            objects,
            appearance,
            occupancy,
            photo_poses,
        })
    }
}

fn damaged(offset: usize, what: String) -> ContainerError {
    ContainerError::Damaged { offset_bytes: offset as u64, what }
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

/// Returns the place of a column of lengths after checking that each is within `0..=MAX_LENGTH`.
fn lengths(
    layout: &Layout,
    bytes: &[u8],
    id: u32,
    name: &'static str,
    len: usize,
) -> Result<Range<usize>, ContainerError> {
    let range = layout.column::<f32>(id, name, len)?;
    let values = bytes[range.clone()].chunks_exact(4);
    let mut values = values.map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]));
    if values.any(|v| !(0.0..=MAX_LENGTH).contains(&v)) {
        return Err(damaged(range.start, format!("a value of the {name} is not within 0..={MAX_LENGTH}")));
    }
    Ok(range)
}

/// Returns the place of the packed indices of `n` Gaussians after checking each.
fn packed_indices(
    layout: &Layout,
    bytes: &[u8],
    n: usize,
) -> Result<(IndicesHeader, Range<usize>), ContainerError> {
    let header: IndicesHeader =
        layout.value(bytes, section::PACKED_INDICES_HEADER, "header of packed indices")?;
    let at_header = layout.find(section::PACKED_INDICES_HEADER).map_or(0, |range| range.start);
    let Some(n_words) = indices::n_words(n, header.width_bits) else {
        return Err(damaged(
            at_header,
            format!("input indices of {} bits, expected 0..=32", header.width_bits),
        ));
    };
    let range = layout.column::<u32>(section::PACKED_INDICES, "packed indices", n_words)?;
    let words: Vec<u32> = bytemuck::pod_collect_to_vec(&bytes[range.clone()]);
    PackedIndices { header, words: &words }.check(n).map_err(|what| damaged(range.start, what))?;
    Ok((header, range))
}

/// Returns the place of a column of half floats after checking that each is finite.
fn halves(
    layout: &Layout,
    bytes: &[u8],
    id: u32,
    name: &'static str,
    len: usize,
) -> Result<Range<usize>, ContainerError> {
    let range = layout.column::<f16>(id, name, len)?;
    // Exponent bits all set is infinity or NaN (IEEE 754 binary16).
    let is_finite = |b: &[u8]| u16::from_le_bytes([b[0], b[1]]) & 0x7c00 != 0x7c00;
    if !bytes[range.clone()].chunks_exact(2).all(is_finite) {
        return Err(damaged(range.start, format!("a value of the {name} is not finite")));
    }
    Ok(range)
}
