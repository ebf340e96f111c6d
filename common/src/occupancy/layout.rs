//! Checks the sections of a shard's occupancy.

use std::ops::Range;

use super::columns::{Occupancy, OccupancyHeader, RunKind, StoredRun, section};
use crate::container::{ContainerError, Layout, damaged};

/// Most blocks of a shard's box: readers count them in 32 bits, and a writer keeps within 512 along each axis.
const MAX_BLOCKS: u64 = 1 << 27;
/// Farthest block from the world's origin: voxels are numbered in 32 bits.
const MAX_BLOCK: i64 = 1 << 28;
/// Largest edge of a voxel.
const MAX_VOXEL: f64 = 1e6;

/// Where the columns of a shard's checked occupancy lie.
#[derive(Clone, Debug)]
pub(crate) struct OccupancyLayout {
    header: OccupancyHeader,
    columns: [Range<usize>; 2],
}

impl OccupancyLayout {
    /// Checks the occupancy; returns `None` if the shard has none.
    pub(crate) fn check(bytes: &[u8], layout: &Layout) -> Result<Option<Self>, ContainerError> {
        let Some(at_header) = layout.find(section::HEADER) else { return Ok(None) };
        let header: OccupancyHeader = layout.value(bytes, section::HEADER, "header of the occupancy")?;
        check_header(&header).map_err(|what| damaged(at_header.start, what))?;
        let runs = layout.column::<StoredRun>(section::RUNS, "runs of blocks", header.n_runs as usize)?;
        let masks = layout.column::<[u64; 2]>(section::MASKS, "masks of blocks", header.n_mixed as usize)?;
        let n_blocks: u32 = header.n_blocks.iter().product();
        let (mut end, mut n_mixed) = (0u32, 0u64);
        let stored: Vec<StoredRun> = bytemuck::pod_collect_to_vec(&bytes[runs.clone()]);
        for (at, run) in stored.iter().enumerate() {
            let stop = run.start.checked_add(run.len()).filter(|stop| *stop <= n_blocks);
            let (true, true, Some(stop), Some(kind)) = (run.start >= end, run.len() > 0, stop, run.kind())
            else {
                let what = format!(
                    "run {at} of blocks begins at {} and has {} of kind {}, expected a begin of at least {end}, an end of at most {n_blocks} and kind 1 to 3",
                    run.start,
                    run.len(),
                    run.len_and_kind & 3
                );
                return Err(damaged(runs.start + at * size_of::<StoredRun>(), what));
            };
            end = stop;
            n_mixed += if kind == RunKind::Mixed { u64::from(run.len()) } else { 0 };
        }
        if n_mixed != u64::from(header.n_mixed) {
            let what = format!("{n_mixed} mixed blocks in the runs, the header has {}", header.n_mixed);
            return Err(damaged(at_header.start, what));
        }
        for (at, pair) in bytes[masks.clone()].chunks_exact(16).enumerate() {
            if (0..8).any(|byte| pair[byte] & pair[8 + byte] != 0) {
                let what = format!("a voxel of mixed block {at} is free and occupied");
                return Err(damaged(masks.start + at * 16, what));
            }
        }
        Ok(Some(Self { header, columns: [runs, masks] }))
    }

    /// Returns the columns of the bytes that were checked.
    pub(crate) fn view<'a>(&self, bytes: &'a [u8]) -> Occupancy<'a> {
        let [runs, masks] = self.columns.each_ref().map(|range| &bytes[range.clone()]);
        Occupancy {
            header: self.header,
            runs: bytemuck::cast_slice(runs),
            masks: bytemuck::cast_slice(masks),
        }
    }
}

fn check_header(header: &OccupancyHeader) -> Result<(), String> {
    let OccupancyHeader { voxel, first_block, n_blocks, min_opacity, .. } = *header;
    if !(voxel > 0.0 && voxel <= MAX_VOXEL) {
        return Err(format!("voxels of {voxel}, expected above 0 and at most {MAX_VOXEL}"));
    }
    let product = n_blocks.iter().fold(1u64, |product, n| product.saturating_mul(u64::from(*n)));
    let is_near = (0..3).all(|axis| {
        let (first, n) = (i64::from(first_block[axis]), i64::from(n_blocks[axis]));
        n > 0 && first >= -MAX_BLOCK && first + n <= MAX_BLOCK
    });
    if product > MAX_BLOCKS || !is_near {
        return Err(format!(
            "{n_blocks:?} blocks from {first_block:?}, expected 1 to {MAX_BLOCKS} in all, within {MAX_BLOCK} of the origin"
        ));
    }
    if !(0.0..=1.0).contains(&min_opacity) {
        return Err(format!("a least opacity of {min_opacity}, expected 0 to 1"));
    }
    Ok(())
}
