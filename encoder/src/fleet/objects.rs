//! The binary objects in a bucket. A scene's has the columns that an encode reads, in the world of the poses. A view's has
//! its record, the outlines of its masks, and its contributions as they are in a file:
//!
//! | bytes | content |
//! |---|---|
//! | 0..8 | `SLAGVIEW` |
//! | 8..12 | version, u32 |
//! | 12..16 | length of the record, u32 |
//! | 16..24 | length of the outlines, u64 |
//! | 24..32 | length of the contributions, u64 |
//! | 32.. | record (JSON), outlines, contributions |

use std::ops::Range;

use slag_common::Gaussians;
use slag_common::container::{self, AlignedBytes, ContainerError, Layout};

use crate::encode::fleet_parts::ViewRecord;

const VIEW_MAGIC: [u8; 8] = *b"SLAGVIEW";
const SCENE_MAGIC: [u8; 8] = *b"SLAGSCEN";
const VERSION: u32 = 1;
const HEAD_BYTES: usize = 32;

/// Returns the object of a view.
pub(super) fn pack_view(
    record: ViewRecord,
    outlines: &[u8],
    contributions: &[u8],
) -> std::io::Result<Vec<u8>> {
    let record = serde_json::to_vec(&record)?;
    let mut bytes = Vec::with_capacity(HEAD_BYTES + record.len() + outlines.len() + contributions.len());
    bytes.extend(VIEW_MAGIC);
    bytes.extend(VERSION.to_le_bytes());
    bytes.extend((record.len() as u32).to_le_bytes());
    bytes.extend((outlines.len() as u64).to_le_bytes());
    bytes.extend((contributions.len() as u64).to_le_bytes());
    bytes.extend(record);
    bytes.extend(outlines);
    bytes.extend(contributions);
    Ok(bytes)
}

/// The places of a view's parts in its object.
pub(super) struct ViewParts {
    pub(super) record: ViewRecord,
    pub(super) outlines: Range<usize>,
    pub(super) contributions: Range<usize>,
}

/// Finds the parts of a view's object.
///
/// # Errors
/// What is wrong with it.
pub(super) fn unpack_view(bytes: &[u8]) -> Result<ViewParts, String> {
    let u64_at = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight bytes"));
    let u32_at = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"));
    if bytes.len() < HEAD_BYTES || bytes[..8] != VIEW_MAGIC || u32_at(8) != VERSION {
        return Err(format!("no view object of version {VERSION}"));
    }
    let ends = [u64::from(u32_at(12)), u64_at(16), u64_at(24)];
    let ends = ends.iter().try_fold(vec![HEAD_BYTES as u64], |mut ends, len| {
        ends.push(ends.last()?.checked_add(*len)?);
        Some(ends)
    });
    match ends.filter(|ends| ends[3] == bytes.len() as u64) {
        Some(ends) => {
            let part = |i: usize| ends[i] as usize..ends[i + 1] as usize;
            let record = serde_json::from_slice(&bytes[part(0)]).map_err(|e| e.to_string())?;
            Ok(ViewParts { record, outlines: part(1), contributions: part(2) })
        }
        None => Err(format!("{} bytes, the head states other lengths", bytes.len())),
    }
}

/// Returns the object of a scene. Coefficients of higher degree are left out: an encode does not read them.
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

/// Reads the object of a scene.
///
/// # Errors
/// [`ContainerError`], naming the byte.
pub(super) fn unpack_scene(bytes: &[u8]) -> Result<Gaussians, ContainerError> {
    let bytes = AlignedBytes::copy_of(bytes);
    let layout = Layout::check(&bytes, SCENE_MAGIC, VERSION)?;
    let n = usize::try_from(layout.value::<u64>(&bytes, 1, "number of Gaussians")?).unwrap_or(usize::MAX);
    Ok(Gaussians {
        means_in_world: bytemuck::pod_collect_to_vec(&bytes[layout.column::<[f64; 3]>(2, "means", n)?]),
        rotations_wxyz: bytemuck::pod_collect_to_vec(&bytes[layout.column::<[f32; 4]>(3, "rotations", n)?]),
        scales: bytemuck::pod_collect_to_vec(&bytes[layout.column::<[f32; 3]>(4, "scales", n)?]),
        opacities: bytemuck::pod_collect_to_vec(&bytes[layout.column::<f32>(5, "opacities", n)?]),
        sh_dc: bytemuck::pod_collect_to_vec(&bytes[layout.column::<[f32; 3]>(6, "colours", n)?]),
        sh_rest: Vec::new(),
        sh_degree: 0,
    })
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    #[test]
    fn parts_come_back_and_a_cut_object_is_refused() {
        let record = ViewRecord { raster_width_px: 640, secs: 0.25 };
        let bytes = pack_view(record, b"outlines", b"contributions").expect("packs");
        let found = unpack_view(&bytes).expect("whole");
        assert_eq!(found.record, record);
        assert_eq!(
            (&bytes[found.outlines], &bytes[found.contributions]),
            (&b"outlines"[..], &b"contributions"[..])
        );
        for cut in 0..bytes.len() {
            assert!(unpack_view(&bytes[..cut]).is_err(), "{cut}");
        }
        let mut huge = bytes.clone();
        huge[24..32].fill(0xff);
        assert!(unpack_view(&huge).is_err());
    }

    #[test]
    fn a_scene_comes_back_bit_by_bit() {
        let scene = Gaussians {
            means_in_world: vec![DVec3::new(0.1, f64::NAN, -1e300), DVec3::splat(1.0 / 3.0)],
            rotations_wxyz: vec![[1.0, 0.0, 0.0, -0.0], [0.5; 4]],
            scales: vec![[0.1; 3], [f32::INFINITY; 3]],
            opacities: vec![0.25, 1.0],
            sh_dc: vec![[0.5; 3], [-0.5; 3]],
            sh_rest: Vec::new(),
            sh_degree: 0,
        };
        let bytes = pack_scene(&scene).expect("packs");
        // NaN differs from itself, so the columns are compared by their bytes.
        assert_eq!(pack_scene(&unpack_scene(&bytes).expect("reads")).expect("packs"), bytes);
        unpack_scene(&bytes[..bytes.len() - 1]).expect_err("cut");
    }
}
