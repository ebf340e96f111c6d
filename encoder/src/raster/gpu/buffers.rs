//! The device buffers of one view in flight.

use wgpu::BufferUsages as Usage;

use super::device::Device;
use super::jobs::{
    DISPATCH_BYTES, ENTRY_WORDS, JOB_STRIDE_BYTES, MAX_PASSES, PAIR_WORDS, SCAN_JOBS, write_jobs,
};
use super::layout::{Capacities, screen_layout};
use super::shader::{Counter, RADIX, REGION_BITS, SORT_BLOCK, WORKGROUP_SIZE};

pub(crate) const COUNTERS_BYTES: u64 = 64;

/// Bytes for a band's parameters, with room to spare.
pub(crate) const VIEW_BYTES: u64 = 256;

pub(crate) const REGION_BYTES: u64 = REGION_BITS as u64 / 8;

/// Bytes of the regions of `n_px` pixels, in whole words.
pub(crate) fn regions_bytes(n_px: usize) -> u64 {
    (n_px as u64 * REGION_BYTES).next_multiple_of(4)
}

#[derive(Clone, Copy)]
pub struct Size {
    pub(crate) capacities: Capacities,
    pub(crate) n_tiles: u32,
    /// Of a band.
    pub n_px: u32,
    /// Of the largest chunk.
    pub(crate) n_chunk: u32,
}

pub struct Buffers {
    pub view: wgpu::Buffer,
    pub counters: wgpu::Buffer,
    pub(crate) dispatches: wgpu::Buffer,
    pub jobs: wgpu::Buffer,
    pub(crate) block_counts: wgpu::Buffer,
    pub(crate) histogram: wgpu::Buffer,
    pub(crate) screen: wgpu::Buffer,
    pub(crate) tile_counts: wgpu::Buffer,
    pub(crate) visible_order: [wgpu::Buffer; 2],
    pub pairs: wgpu::Buffer,
    pub(crate) pair_order: [wgpu::Buffer; 2],
    pub members: wgpu::Buffer,
    pub(crate) ranges: wgpu::Buffer,
    pub(crate) tile_order: wgpu::Buffer,
    pub regions: wgpu::Buffer,
    pub entries: wgpu::Buffer,
    pub(crate) entry_order: [wgpu::Buffer; 2],
    pub(crate) region_sums: wgpu::Buffer,
}

impl Buffers {
    /// `None` if the device memory does not suffice.
    pub fn new(device: &Device, size: Size) -> Option<Self> {
        let Size { capacities, n_tiles, n_px, n_chunk } = size;
        let storage = |label: &str, words: u64| {
            device.buffer(label, words * 4, Usage::STORAGE | Usage::COPY_DST | Usage::COPY_SRC)
        };
        let (screen_bytes, _) = screen_layout(device.report.precision);
        let (visible, pairs, entries) =
            (u64::from(capacities.visible), u64::from(capacities.pairs), u64::from(capacities.entries));
        let largest = visible.max(pairs).max(entries);
        let buffers = Self {
            view: storage("view", VIEW_BYTES / 4)?,
            counters: storage("counters", COUNTERS_BYTES / 4)?,
            dispatches: device.buffer(
                "dispatches",
                2 * Counter::ALL.len() as u64 * DISPATCH_BYTES,
                Usage::STORAGE | Usage::INDIRECT,
            )?,
            jobs: storage("jobs", (SCAN_JOBS + 3 * u64::from(MAX_PASSES)) * JOB_STRIDE_BYTES / 4)?,
            block_counts: storage(
                "block counts",
                largest.max(n_chunk.into()).div_ceil(WORKGROUP_SIZE.into()),
            )?,
            histogram: storage("histogram", u64::from(RADIX) * largest.div_ceil(SORT_BLOCK.into()))?,
            screen: storage("screen", visible * u64::from(screen_bytes / 4))?,
            tile_counts: storage("tile counts", visible)?,
            visible_order: [storage("order of visible", visible)?, storage("order of visible", visible)?],
            pairs: storage("pairs", pairs * u64::from(PAIR_WORDS))?,
            pair_order: [storage("order of pairs", pairs)?, storage("order of pairs", pairs)?],
            members: storage("members", pairs)?,
            ranges: storage("ranges", 2 * u64::from(n_tiles))?,
            tile_order: storage("order of tiles", n_tiles.into())?,
            regions: storage("regions", regions_bytes(n_px as usize) / 4)?,
            entries: storage("entries", entries * u64::from(ENTRY_WORDS))?,
            entry_order: [storage("order of entries", entries)?, storage("order of entries", entries)?],
            region_sums: storage("region sums", entries * 4)?,
        };
        write_jobs(device, &buffers.jobs, capacities);
        Some(buffers)
    }
}
