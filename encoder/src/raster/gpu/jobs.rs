//! The parameters of all scans and sorts.

use slag_raster::constants::{FAR_Z, NEAR_Z};
use wgpu::BufferUsages as Usage;

use super::device::Device;
use super::layout::{Capacities, ScanJob, SortPass, screen_layout};
use super::shader::{Counter, NONE, RADIX, REGION_BITS, SORT_BLOCK, WORKGROUP_SIZE};

/// Bytes between records; bindings must be aligned.
pub(crate) const JOB_STRIDE_BYTES: u64 = 256;
pub(crate) const DISPATCH_BYTES: u64 = 16;
pub(crate) const PAIR_WORDS: u32 = 2;
pub(crate) const ENTRY_WORDS: u32 = 4;

#[derive(Clone, Copy)]
pub enum Scan {
    Digits(Counter),
    Pairs,
    /// Only dispatch sizes; there is no array.
    Entries,
    Heads,
}

#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum SortKey {
    Depth,
    Tile,
    /// Visible Gaussian of an entry, then its region.
    MemberRegion,
}

pub(crate) const DIGIT_BITS: u32 = RADIX.ilog2();
pub(crate) const MAX_PASSES: u32 = (u32::BITS + REGION_BITS).div_ceil(DIGIT_BITS);

impl SortKey {
    pub fn counter(self) -> Counter {
        match self {
            Self::Depth => Counter::Visible,
            Self::Tile => Counter::Pairs,
            Self::MemberRegion => Counter::Entries,
        }
    }
}

/// Least key of a depth, and the bits of keys after subtracting it. A key is the bits of a float between near and far
/// plane: positive floats and their bits have the same order.
pub(crate) fn depth_keys() -> (u32, u32) {
    let [least, most] = [NEAR_Z, FAR_Z].map(|z| (z as f32).to_bits());
    (least, bits_of(most - least + 1))
}

pub(crate) const SCAN_JOBS: u64 = 6;

impl Scan {
    pub fn index(self) -> u64 {
        match self {
            Self::Digits(Counter::Visible) => 0,
            Self::Digits(Counter::Pairs) => 1,
            Self::Digits(_) => 2,
            Self::Pairs => 3,
            Self::Entries => 4,
            Self::Heads => 5,
        }
    }
}

pub(crate) fn sort_job(key: SortKey, pass: u32) -> u64 {
    SCAN_JOBS + key as u64 * u64::from(MAX_PASSES) + u64::from(pass)
}

pub(crate) fn bits_of(n: u32) -> u32 {
    u32::BITS - n.saturating_sub(1).leading_zeros()
}

pub fn part(buffer: &wgpu::Buffer, index: u64) -> wgpu::BufferBinding<'_> {
    wgpu::BufferBinding {
        buffer,
        offset: index * JOB_STRIDE_BYTES,
        size: std::num::NonZeroU64::new(JOB_STRIDE_BYTES),
    }
}

/// Writes the records of all scans, and of the sorts by depth and tile.
pub(crate) fn write_jobs(device: &Device, jobs: &wgpu::Buffer, capacities: Capacities) {
    let write = |index: u64, bytes: &[u8]| {
        device.queue.write_buffer(jobs, index * JOB_STRIDE_BYTES, bytes);
    };
    let scan = |items: Counter, n_most, block, columns, total: u32| {
        let items = items as u32;
        ScanJob { items, n_most, block, columns, total }
    };
    let Capacities { visible, pairs, entries } = capacities;
    let digits = |counter, most| (Scan::Digits(counter), scan(counter, most, SORT_BLOCK, RADIX, NONE));
    let of_threads = |items, most, total| scan(items, most, WORKGROUP_SIZE, 1, total as u32);
    for (kind, job) in [
        digits(Counter::Visible, visible),
        digits(Counter::Pairs, pairs),
        digits(Counter::Entries, entries),
        (Scan::Pairs, of_threads(Counter::Visible, visible, Counter::Pairs)),
        (
            Scan::Entries,
            ScanJob { items: NONE, n_most: 0, block: 1, columns: 1, total: Counter::Entries as u32 },
        ),
        (Scan::Heads, of_threads(Counter::Entries, entries, Counter::RegionSums)),
    ] {
        write(kind.index(), bytemuck::bytes_of(&job));
    }
    write_sort_jobs(device, jobs, capacities, (SortKey::Depth, 0));
    write_sort_jobs(device, jobs, capacities, (SortKey::Tile, 0));
}

/// `low_bits` of the key lie in its second word; 0 if it has one word.
pub(crate) fn write_sort_jobs(
    device: &Device,
    jobs: &wgpu::Buffer,
    capacities: Capacities,
    (key, low_bits): (SortKey, u32),
) {
    let (screen_bytes, depth_word) = screen_layout(device.report.precision);
    let (stride, offset, capacity) = match key {
        SortKey::Depth => (screen_bytes / 4, depth_word, capacities.visible),
        SortKey::Tile => (PAIR_WORDS, 0, capacities.pairs),
        SortKey::MemberRegion => (ENTRY_WORDS, 0, capacities.entries),
    };
    for pass in 0..MAX_PASSES {
        let job = SortPass {
            items: key.counter() as u32,
            stride,
            offset,
            least: if key == SortKey::Depth { depth_keys().0 } else { 0 },
            low_bits,
            shift: pass * DIGIT_BITS,
            capacity,
        };
        device.queue.write_buffer(jobs, sort_job(key, pass) * JOB_STRIDE_BYTES, bytemuck::bytes_of(&job));
    }
}

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
