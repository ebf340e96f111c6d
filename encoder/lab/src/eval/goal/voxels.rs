//! The voxels that a store calls free, compared with the true solids.

use std::collections::HashSet;
use std::path::Path;

use anyhow::Result;
use glam::DVec3;
use serde::Serialize;
use slag_common::occupancy::BLOCK_EDGE;
use slag_encoder::store::StoreReader;

use crate::generate::compose::Layout;

/// Distance of the surface points that are looked at.
const SPACING_M: f64 = 0.012;

/// Free voxels, and those that are not.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub(super) struct Voxels {
    pub(super) n_free: u64,
    /// Those with a true surface inside, or inside a solid.
    pub(super) n_false: u64,
    pub(super) len_bytes: u64,
}

impl Voxels {
    pub(super) fn add(&mut self, other: Self) {
        self.n_free += other.n_free;
        self.n_false += other.n_false;
        self.len_bytes += other.len_bytes;
    }
}

pub(super) fn compare(layout: &Layout, store: &Path) -> Result<Voxels> {
    let reader = StoreReader::open(store)?;
    let mut found = Voxels::default();
    let mut surfaces: Option<HashSet<[i32; 3]>> = None;
    for cell in &reader.manifest().cells {
        let Some(record) = cell.shards.values().next() else { continue };
        let shard = reader.read_shard(record)?;
        let Some(occupancy) = shard.layout.occupancy(&shard.bytes) else { continue };
        let voxel = occupancy.header.voxel;
        let surfaces = surfaces.get_or_insert_with(|| surface_voxels(layout, voxel));
        found.len_bytes += occupancy.sections().iter().map(|(_, bytes)| bytes.len() as u64).sum::<u64>();
        for run in occupancy.runs() {
            for block in run.blocks.clone() {
                let [_, free] = run.masks_of(block);
                let at = occupancy.block_at(block);
                for bit in (0..64).filter(|bit| free >> bit & 1 == 1) {
                    let offset = [bit / 16, bit / 4 % 4, bit % 4];
                    let place = [0, 1, 2].map(|axis| at[axis] * BLOCK_EDGE + offset[axis]);
                    let centre = (DVec3::from(place.map(f64::from)) + 0.5) * voxel;
                    found.n_free += 1;
                    found.n_false += u64::from(surfaces.contains(&place) || is_solid(layout, centre));
                }
            }
        }
    }
    Ok(found)
}

/// Returns the voxels with a point of a true surface.
fn surface_voxels(layout: &Layout, voxel: f64) -> HashSet<[i32; 3]> {
    let mut voxels = HashSet::new();
    for placed in &layout.placed {
        for part in &placed.object.parts {
            for surfel in part.surfels(SPACING_M) {
                let at = placed.world_from_object.transform_point3(surfel.position) / voxel;
                voxels.insert(at.floor().to_array().map(|v| v as i32));
            }
        }
    }
    voxels
}

fn is_solid(layout: &Layout, point: DVec3) -> bool {
    // A ceiling is a box around its whole room, of which only the surface is a thing.
    let things = layout.placed.iter().filter(|placed| !placed.shell);
    let near = things.filter(|placed| placed.bounds.contains(point));
    near.flat_map(|placed| placed.object.parts.iter().map(move |part| (placed, part))).any(
        |(placed, part)| {
            let world_from_part = placed.world_from_object * part.object_from_part;
            part.shape.contains(world_from_part.inverse().transform_point3(point))
        },
    )
}
