//! The places of a checked shard's columns.

use std::ops::Range;

use bytemuck::Pod;

use super::columns::{Basis, ExactColumns, Fine, Positions, Residuals, ShardView};
use super::format::{PositionForm, ScoreErrors, ShardHeader};
use super::indices::{IndicesHeader, PackedIndices};
use crate::appearance::Appearance;
use crate::objects::{Objects, ObjectsLayout};
use crate::occupancy::{Occupancy, OccupancyLayout};
use crate::photo_poses::{PhotoPoses, PhotoPosesLayout};

/// The header of a checked shard and the places of its columns; [`ShardLayout::view`] gives the columns.
#[derive(Clone, Debug)]
pub struct ShardLayout {
    /// The header.
    pub header: ShardHeader,
    pub(super) positions: Range<usize>,
    pub(super) centroid_starts: Range<usize>,
    pub(super) centroids: Range<usize>,
    pub(super) radii: Range<usize>,
    pub(super) basis: Option<[Range<usize>; 3]>,
    pub(super) residuals: Option<[Range<usize>; 5]>,
    pub(super) exact: Option<[Range<usize>; 2]>,
    pub(super) fine: Option<(ScoreErrors, [Range<usize>; 3])>,
    pub(super) packed_indices: Option<(IndicesHeader, Range<usize>)>,
    pub(super) objects: Option<ObjectsLayout>,
    pub(super) appearance: Option<[Range<usize>; 3]>,
    pub(super) occupancy: Option<OccupancyLayout>,
    pub(super) photo_poses: Option<PhotoPosesLayout>,
}

impl ShardLayout {
    /// Returns the objects in the checked bytes, if the shard has any.
    ///
    /// # Panics
    /// As [`ShardLayout::view`], with an 8-byte aligned address.
    pub fn objects<'a>(&self, bytes: &'a [u8]) -> Option<Objects<'a>> {
        self.objects.as_ref().map(|objects| objects.view(bytes))
    }

    /// Returns how the Gaussians look, if the checked shard tells.
    ///
    /// # Panics
    /// If `bytes` are shorter than those checked.
    pub fn appearance<'a>(&self, bytes: &'a [u8]) -> Option<Appearance<'a>> {
        let [colours, sizes, rotations] = self.appearance.clone()?.map(|range| &bytes[range]);
        Some(Appearance {
            colours: bytemuck::cast_slice(colours),
            sizes: bytemuck::cast_slice(sizes),
            rotations: bytemuck::cast_slice(rotations),
        })
    }

    /// Returns which places of the checked bytes' cell are free, if the shard says so.
    ///
    /// # Panics
    /// As [`ShardLayout::objects`].
    pub fn occupancy<'a>(&self, bytes: &'a [u8]) -> Option<Occupancy<'a>> {
        self.occupancy.as_ref().map(|occupancy| occupancy.view(bytes))
    }

    /// Returns where the photos of the checked bytes' cell were taken, if the shard says so.
    ///
    /// # Panics
    /// As [`ShardLayout::objects`].
    pub fn photo_poses<'a>(&self, bytes: &'a [u8]) -> Option<PhotoPoses<'a>> {
        self.photo_poses.as_ref().map(|photos| photos.view(bytes))
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
