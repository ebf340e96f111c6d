//! The binary objects in a bucket: the scene, with the columns that an encode reads, in the world of the poses,
//! and what a view leaves.

use slag_common::Gaussians;
use slag_common::container::{self, AlignedBytes, ContainerError, Layout};

use crate::encode::fleet_parts::ViewRecord;

const VIEW_MAGIC: [u8; 8] = *b"SLAGVIEW";
const SCENE_MAGIC: [u8; 8] = *b"SLAGSCEN";
const VERSION: u32 = 1;

/// A view's object: its record (JSON), the masks' outlines, and the file of contributions.
pub(super) fn pack_view(
    record: ViewRecord,
    outlines: &[u8],
    contributions: &[u8],
) -> std::io::Result<Vec<u8>> {
    let record = serde_json::to_vec(&record)?;
    let mut bytes = Vec::with_capacity(record.len() + outlines.len() + contributions.len() + 1024);
    let sections = [(1, &record[..]), (2, outlines), (3, contributions)];
    container::write(&mut bytes, VIEW_MAGIC, VERSION, &sections)?;
    Ok(bytes)
}

/// A view's record, outlines and contributions.
pub(super) fn unpack_view(bytes: &[u8]) -> Result<(ViewRecord, Vec<u8>, Vec<u8>), ContainerError> {
    let bytes = AlignedBytes::copy_of(bytes);
    let layout = Layout::check(&bytes, VIEW_MAGIC, VERSION)?;
    let find = |id: u32, name| layout.find(id).ok_or(ContainerError::Missing { id, name });
    let record = find(1, "record")?;
    let offset_bytes = record.start as u64;
    let damaged = |e: serde_json::Error| ContainerError::Damaged { offset_bytes, what: e.to_string() };
    let record = serde_json::from_slice(&bytes[record]).map_err(damaged)?;
    Ok((record, bytes[find(2, "outlines")?].to_vec(), bytes[find(3, "contributions")?].to_vec()))
}

/// Leaves out coefficients of higher degree, which an encode does not read.
pub(super) fn pack_scene(scene: &Gaussians) -> std::io::Result<Vec<u8>> {
    let n = scene.len() as u64;
    let sections = [
        (1, bytemuck::bytes_of(&n)),
        (2, bytemuck::cast_slice(&scene.means_in_world)),
        (3, bytemuck::cast_slice(&scene.rotations_wxyz)),
        (4, bytemuck::cast_slice(&scene.scales)),
        (5, bytemuck::cast_slice(&scene.opacities)),
        (6, bytemuck::cast_slice(&scene.sh_dc)),
    ];
    let mut bytes = Vec::new();
    container::write(&mut bytes, SCENE_MAGIC, VERSION, &sections)?;
    Ok(bytes)
}

pub(super) fn unpack_scene(bytes: &[u8]) -> Result<Gaussians, ContainerError> {
    let bytes = AlignedBytes::copy_of(bytes);
    let layout = Layout::check(&bytes, SCENE_MAGIC, VERSION)?;
    let n = usize::try_from(layout.value::<u64>(&bytes, 1, "number of Gaussians")?).unwrap_or(usize::MAX);
    Ok(Gaussians {
        means_in_world: layout.values(&bytes, 2, "means", n)?,
        rotations_wxyz: layout.values(&bytes, 3, "rotations", n)?,
        scales: layout.values(&bytes, 4, "scales", n)?,
        opacities: layout.values(&bytes, 5, "opacities", n)?,
        sh_dc: layout.values(&bytes, 6, "colours", n)?,
        sh_rest: Vec::new(),
        sh_degree: 0,
    })
}

#[cfg(test)]
mod tests;
