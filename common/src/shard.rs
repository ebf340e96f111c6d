//! A shard: one cell's data in one file. The byte table and its reasons are in `FORMAT.md`.
//!
//! Gaussians are ordered by palette row, then along a Morton curve, so a row's members are one
//! run `row_starts[r]..row_starts[r + 1]` and no code column exists; those without evidence follow
//! the last run and have no row.

use std::io;
use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use glam::DVec3;
use half::f16;
use serde::{Deserialize, Serialize};

use crate::container::{self, ContainerError, Layout};
use crate::frames::Aabb;
use crate::hash::Hash32;

/// First bytes of a shard.
pub const MAGIC: [u8; 8] = *b"SLAGSHRD";
/// Version of the shard format that is written and read.
pub const VERSION: u32 = 1;

/// Ids of a shard's sections.
pub mod section {
    /// [`super::ShardHeader`].
    pub const HEADER: u32 = 1;
    /// `[N][3]` u16, steps of `position_step` from `origin_in_world`.
    pub const POSITIONS: u32 = 2;
    /// `[K + 1]` u32.
    pub const ROW_STARTS: u32 = 3;
    /// `[K][dim]` f16.
    pub const PALETTE: u32 = 4;
    /// `[K]` f32.
    pub const RADII: u32 = 5;
    /// `[N]` u32, index in the input splat file.
    pub const INPUT_INDICES: u32 = 6;
    /// `[row_starts[K]][dim]` f16, unit embeddings.
    pub const EMBEDDINGS: u32 = 7;
}

/// How much a shard carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Profile {
    /// Palette rows and positions.
    Compact,
    /// Also every embedding, as f16.
    Exact,
}

impl Profile {
    /// Every profile, smallest first.
    pub const ALL: [Self; 2] = [Self::Compact, Self::Exact];

    /// Returns the name used in manifests, URLs and flags.
    pub fn name(self) -> &'static str {
        match self {
            Self::Compact => "compact",
            Self::Exact => "exact",
        }
    }
}

impl std::fmt::Display for Profile {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl std::str::FromStr for Profile {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let names = || Self::ALL.map(Self::name).join(", ");
        Self::ALL
            .into_iter()
            .find(|p| p.name() == text)
            .ok_or_else(|| format!("{text:?} is no profile; there are: {}", names()))
    }
}

/// The fixed part of a shard.
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct ShardHeader {
    /// The cell.
    pub cell_id: u32,
    /// Gaussians, N.
    pub n_gaussians: u32,
    /// Palette rows, K.
    pub n_rows: u32,
    /// Components of an embedding.
    pub dim: u32,
    /// Where the shard frame's origin lies in the world frame.
    pub origin_in_world: [f64; 3],
    /// World units per step of a quantised position, per axis; the error is at most half a step.
    pub position_step: [f64; 3],
    /// Smallest corner of the box around the Gaussians' extents, world frame.
    pub box_min: [f64; 3],
    /// Largest corner.
    pub box_max: [f64; 3],
    /// The encoder whose space the rows live in.
    pub encoder_id: [u8; 32],
}

/// What a shard is written from. All columns are in shard order.
pub struct ShardParts<'a> {
    /// The fixed part.
    pub header: ShardHeader,
    /// `[N][3]`.
    pub positions: &'a [[u16; 3]],
    /// `[K + 1]`, ascending.
    pub row_starts: &'a [u32],
    /// `[K][dim]`.
    pub palette: &'a [f16],
    /// `[K]`: at least the largest `||E_k - P[row]||` of the row's members.
    pub radii: &'a [f32],
    /// `[N]` index in the input file and `[row_starts[K]][dim]` embeddings: the exact profile.
    pub exact: Option<(&'a [u32], &'a [f16])>,
}

impl ShardParts<'_> {
    /// Writes the shard.
    ///
    /// # Errors
    /// Whatever the writer gives.
    pub fn write(&self, out: impl io::Write) -> io::Result<()> {
        let mut sections = vec![
            (section::HEADER, bytemuck::bytes_of(&self.header)),
            (section::POSITIONS, container::bytes_of(self.positions)),
            (section::ROW_STARTS, container::bytes_of(self.row_starts)),
            (section::PALETTE, container::bytes_of(self.palette)),
            (section::RADII, container::bytes_of(self.radii)),
        ];
        if let Some((input_indices, embeddings)) = self.exact {
            sections.push((section::INPUT_INDICES, container::bytes_of(input_indices)));
            sections.push((section::EMBEDDINGS, container::bytes_of(embeddings)));
        }
        container::write(out, MAGIC, VERSION, &sections)
    }
}

/// A checked shard's header and where its columns lie; pair it with the bytes by [`ShardLayout::view`].
#[derive(Clone, Debug)]
pub struct ShardLayout {
    /// The fixed part.
    pub header: ShardHeader,
    positions: Range<usize>,
    row_starts: Range<usize>,
    palette: Range<usize>,
    radii: Range<usize>,
    exact: Option<(Range<usize>, Range<usize>)>,
}

impl ShardLayout {
    /// Checks a whole shard: container, sizes, row order, finite and sane numbers.
    ///
    /// # Errors
    /// [`ContainerError`], naming the byte.
    pub fn check(bytes: &[u8]) -> Result<Self, ContainerError> {
        let layout = Layout::check(bytes, MAGIC, VERSION)?;
        let at_header = layout.find(section::HEADER).map_or(0, |range| range.start as u64);
        let header: ShardHeader = layout.value(bytes, section::HEADER, "header")?;
        let damaged = |what: String| ContainerError::Damaged { offset_bytes: at_header, what };
        let floats = [header.origin_in_world, header.position_step, header.box_min, header.box_max];
        if floats.as_flattened().iter().any(|v| !v.is_finite())
            || header.position_step.iter().any(|s| *s < 0.0)
        {
            return Err(damaged("a coordinate of the header is not finite, or a step is negative".into()));
        }
        if (0..3).any(|axis| header.box_min[axis] > header.box_max[axis]) {
            return Err(damaged(format!("box {:?}..{:?} is empty", header.box_min, header.box_max)));
        }
        let (n, k, dim) = (header.n_gaussians as usize, header.n_rows as usize, header.dim as usize);
        if k > n || dim == 0 || dim > MAX_DIM {
            return Err(damaged(format!("{k} rows of {dim} components for {n} Gaussians")));
        }
        let row_starts = layout.column::<u32>(section::ROW_STARTS, "row starts", k + 1)?;
        let starts: Vec<u32> = bytemuck::pod_collect_to_vec(&bytes[row_starts.clone()]);
        // A row has members: an empty one would only cost time, and K <= N bounds memory.
        if starts[0] != 0 || starts.windows(2).any(|w| w[0] >= w[1]) || starts[k] as usize > n {
            let offset_bytes = row_starts.start as u64;
            let what = format!("row starts do not ascend from 0 to at most {n}");
            return Err(ContainerError::Damaged { offset_bytes, what });
        }
        let exact = match layout.find(section::EMBEDDINGS) {
            None => None,
            Some(_) => Some((
                layout.column::<u32>(section::INPUT_INDICES, "input indices", n)?,
                layout.column::<f16>(section::EMBEDDINGS, "embeddings", starts[k] as usize * dim)?,
            )),
        };
        let palette = layout.column::<f16>(section::PALETTE, "palette", k * dim)?;
        let radii = layout.column::<f32>(section::RADII, "radii", k)?;
        let half_columns = [Some(palette.clone()), exact.as_ref().map(|(_, embeddings)| embeddings.clone())];
        for range in half_columns.into_iter().flatten() {
            if !all_finite_f16(&bytes[range.clone()]) {
                let what = "an embedding component is not finite".into();
                return Err(ContainerError::Damaged { offset_bytes: range.start as u64, what });
            }
        }
        let radius_values: Vec<f32> = bytemuck::pod_collect_to_vec(&bytes[radii.clone()]);
        if radius_values.iter().any(|r| !(0.0..=4.0).contains(r)) {
            let what = "a radius is outside 0..=4".into();
            return Err(ContainerError::Damaged { offset_bytes: radii.start as u64, what });
        }
        let positions = layout.column::<[u16; 3]>(section::POSITIONS, "positions", n)?;
        Ok(Self { header, positions, row_starts, palette, radii, exact })
    }

    /// Returns the columns of the bytes that were checked.
    ///
    /// # Panics
    /// If `bytes` are other than those checked (shorter), or do not start at a 4-byte aligned address
    /// (mapped files and [`container::AlignedBytes`] do).
    pub fn view<'a>(&self, bytes: &'a [u8]) -> ShardView<'a> {
        ShardView {
            header: self.header,
            positions: bytemuck::cast_slice(&bytes[self.positions.clone()]),
            row_starts: bytemuck::cast_slice(&bytes[self.row_starts.clone()]),
            palette: bytemuck::cast_slice(&bytes[self.palette.clone()]),
            radii: bytemuck::cast_slice(&bytes[self.radii.clone()]),
            exact: self.exact.as_ref().map(|(indices, embeddings)| ExactColumns {
                input_indices: bytemuck::cast_slice(&bytes[indices.clone()]),
                embeddings: bytemuck::cast_slice(&bytes[embeddings.clone()]),
            }),
        }
    }
}

/// Larger than any text-image model's embedding; a larger stated `dim` is damage.
pub const MAX_DIM: usize = 8192;

fn all_finite_f16(bytes: &[u8]) -> bool {
    // Exponent bits all set is infinity or NaN (IEEE 754 binary16).
    bytes.chunks_exact(2).all(|b| u16::from_le_bytes([b[0], b[1]]) & 0x7c00 != 0x7c00)
}

/// A shard's columns, borrowed from its bytes.
#[derive(Clone, Copy, Debug)]
pub struct ShardView<'a> {
    /// The fixed part.
    pub header: ShardHeader,
    /// `[N][3]`, quantised; decode with [`ShardView::position_in_world`].
    pub positions: &'a [[u16; 3]],
    /// `[K + 1]`.
    pub row_starts: &'a [u32],
    /// `[K][dim]`.
    pub palette: &'a [f16],
    /// `[K]`.
    pub radii: &'a [f32],
    /// What only the exact profile has.
    pub exact: Option<ExactColumns<'a>>,
}

/// The exact profile's columns.
#[derive(Clone, Copy, Debug)]
pub struct ExactColumns<'a> {
    /// `[N]` index in the input splat file.
    pub input_indices: &'a [u32],
    /// `[row_starts[K]][dim]` unit embeddings.
    pub embeddings: &'a [f16],
}

impl ShardView<'_> {
    /// Returns the mean of a Gaussian, exact to half a step per axis.
    pub fn position_in_world(&self, index: usize) -> DVec3 {
        let steps = self.positions[index].map(f64::from);
        DVec3::from(self.header.origin_in_world) + DVec3::from(steps) * DVec3::from(self.header.position_step)
    }

    /// Returns the members of a row.
    pub fn members(&self, row: usize) -> Range<usize> {
        self.row_starts[row] as usize..self.row_starts[row + 1] as usize
    }

    /// Returns the number of Gaussians that have an embedding.
    pub fn n_with_evidence(&self) -> usize {
        self.row_starts[self.header.n_rows as usize] as usize
    }

    /// Returns the box around the Gaussians' extents.
    pub fn bounds(&self) -> Aabb {
        Aabb { min: self.header.box_min.into(), max: self.header.box_max.into() }
    }

    /// Returns the encoder whose space the rows live in.
    pub fn encoder_id(&self) -> Hash32 {
        Hash32(self.header.encoder_id)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use container::AlignedBytes;

    fn parts_bytes(edit: impl FnOnce(&mut ShardHeader, &mut Vec<u32>, &mut Vec<f16>)) -> Vec<u8> {
        let mut header = ShardHeader {
            cell_id: 5,
            n_gaussians: 6,
            n_rows: 2,
            dim: 3,
            origin_in_world: [1e6, -2.0, 3.0],
            position_step: [0.001, 0.002, 0.0],
            box_min: [1e6 - 1.0, -3.0, 2.0],
            box_max: [1e6 + 66.0, 130.0, 4.0],
            encoder_id: [9; 32],
        };
        let mut row_starts = vec![0, 2, 5];
        let mut palette: Vec<f16> = [1.0, 0.0, 0.0, 0.0, 0.6, 0.8].map(f16::from_f32).to_vec();
        edit(&mut header, &mut row_starts, &mut palette);
        let embeddings: Vec<f16> = (0..15).map(|i| f16::from_f32(i as f32 / 16.0)).collect();
        let mut out = Vec::new();
        ShardParts {
            header,
            positions: &[[0, 0, 0], [1, 2, 3], [65535, 65535, 65535], [4, 4, 4], [5, 5, 5], [6, 6, 6]],
            row_starts: &row_starts,
            palette: &palette,
            radii: &[0.1, 0.2],
            exact: Some((&[10, 11, 12, 13, 14, 15], &embeddings)),
        }
        .write(&mut out)
        .expect("writes to memory");
        out
    }

    #[test]
    fn round_trip() {
        let bytes = AlignedBytes::copy_of(&parts_bytes(|_, _, _| {}));
        let shard = ShardLayout::check(&bytes).expect("valid").view(&bytes);
        assert_eq!(shard.members(1), 2..5);
        assert_eq!(shard.n_with_evidence(), 5);
        let p = shard.position_in_world(2);
        assert!((p - DVec3::new(1e6 + 65.535, 129.07, 3.0)).length() < 1e-9, "{p}");
        assert_eq!(shard.exact.expect("exact").input_indices[3], 13);
    }

    /// A hostile writer computes right checksums over wrong contents: each lie is refused.
    #[test]
    fn lies_are_refused() {
        let refused = |edit: fn(&mut ShardHeader, &mut Vec<u32>, &mut Vec<f16>)| {
            ShardLayout::check(&parts_bytes(edit)).expect_err("must be refused").to_string()
        };
        assert!(refused(|h, _, _| h.n_gaussians = u32::MAX).contains("bytes"));
        assert!(refused(|h, _, _| h.n_rows = 7).contains("rows"));
        assert!(refused(|h, _, _| h.dim = 0).contains("components"));
        assert!(refused(|h, _, _| h.dim = u32::MAX).contains("components"));
        assert!(refused(|h, _, _| h.origin_in_world[1] = f64::NAN).contains("finite"));
        assert!(refused(|h, _, _| h.box_max[0] = -1.0).contains("empty"));
        assert!(refused(|_, starts, _| starts[1] = 9).contains("ascend"));
        assert!(refused(|_, starts, _| starts[2] = 7).contains("ascend"));
        assert!(refused(|_, _, palette| palette[4] = f16::INFINITY).contains("finite"));
    }
}
