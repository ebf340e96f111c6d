//! Writes a shard.

use std::io;

use super::columns::ShardView;
use super::format::{MAGIC, VERSION, section};
use crate::appearance::Appearance;
use crate::container;
use crate::landmarks::Landmarks;
use crate::objects::Objects;
use crate::occupancy::Occupancy;
use crate::photo_poses::PhotoPoses;

/// The optional parts of a shard, which questions do not need.
#[derive(Clone, Copy, Debug, Default)]
pub struct Additions<'a> {
    pub objects: Option<Objects<'a>>,
    /// Appearance of its Gaussians.
    pub appearance: Option<Appearance<'a>>,
    pub occupancy: Option<Occupancy<'a>>,
    /// Poses of the photos taken in its cell.
    pub photo_poses: Option<PhotoPoses<'a>>,
    /// Points by which robots find their place.
    pub landmarks: Option<Landmarks<'a>>,
}

impl ShardView<'_> {
    pub fn write(&self, out: impl io::Write) -> io::Result<()> {
        self.write_with(out, Additions::default())
    }

    pub fn write_with(&self, out: impl io::Write, additions: Additions<'_>) -> io::Result<()> {
        let Additions { objects, appearance, occupancy, photo_poses, landmarks } = additions;
        let mut sections = vec![
            (section::HEADER, bytemuck::bytes_of(&self.header)),
            (section::POSITIONS, self.positions.bytes()),
            (section::CENTROID_STARTS, container::bytes_of(self.centroid_starts)),
            (section::CENTROIDS, container::bytes_of(self.centroids)),
            (section::RADII, container::bytes_of(self.radii)),
        ];
        if let Some(basis) = &self.basis {
            sections.push((section::MEAN, container::bytes_of(basis.mean)));
            sections.push((section::BASIS, container::bytes_of(basis.vectors)));
            sections.push((section::BASIS_STEPS, container::bytes_of(basis.steps)));
        }
        if let Some(residuals) = &self.residuals {
            sections.push((section::SUBSPACE_STARTS, container::bytes_of(residuals.subspace_starts)));
            sections.push((section::CODEWORDS, container::bytes_of(residuals.codewords)));
            sections.push((section::RESIDUAL_SCALES, container::bytes_of(residuals.residual_scales)));
            sections.push((section::RESIDUAL_NORMS, container::bytes_of(residuals.residual_norms)));
            sections.push((section::CODES, residuals.codes));
        }
        if let Some(exact) = &self.exact {
            sections.push((section::INPUT_INDICES, container::bytes_of(exact.input_indices)));
            sections.push((section::EMBEDDINGS, container::bytes_of(exact.embeddings)));
            if let Some(fine) = &exact.fine {
                sections.push((section::FINE_ERRORS, bytemuck::bytes_of(&fine.errors)));
                sections.push((section::FINE_STEPS, container::bytes_of(fine.steps)));
                sections.push((section::FINE_SCALES, container::bytes_of(fine.scales)));
                sections.push((section::FINE, container::bytes_of(fine.values)));
            }
        }
        if let Some(indices) = &self.packed_indices {
            sections.push((section::PACKED_INDICES_HEADER, bytemuck::bytes_of(&indices.header)));
            sections.push((section::PACKED_INDICES, container::bytes_of(indices.words)));
        }
        sections.extend(objects.iter().flat_map(|objects| objects.sections()));
        if let Some(Appearance { colours, sizes, rotations }) = &appearance {
            sections.push((section::COLOURS, container::bytes_of(colours)));
            sections.push((section::SIZES, container::bytes_of(sizes)));
            sections.push((section::ROTATIONS, container::bytes_of(rotations)));
        }
        sections.extend(occupancy.iter().flat_map(|occupancy| occupancy.sections()));
        sections.extend(photo_poses.iter().flat_map(|photos| photos.sections()));
        sections.extend(landmarks.iter().flat_map(|landmarks| landmarks.sections()));
        container::write(out, MAGIC, VERSION, &sections)
    }
}
