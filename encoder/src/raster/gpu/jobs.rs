//! The parameters of all scans and sorts.

use slag_raster::constants::{FAR_Z, NEAR_Z};

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

/// Offset of the dispatch sizes for a counter's items: one thread per item, or one workgroup per sort block.
pub(crate) fn dispatch_offset(counter: Counter, by_sort_block: bool) -> u64 {
    (counter as u64 * 2 + u64::from(by_sort_block)) * DISPATCH_BYTES
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
    let scan = |items, n_most, block, columns, total| ScanJob { items, n_most, block, columns, total };
    for (counter, most) in [
        (Counter::Visible, capacities.visible),
        (Counter::Pairs, capacities.pairs),
        (Counter::Entries, capacities.entries),
    ] {
        let job = scan(counter as u32, most, SORT_BLOCK, RADIX, NONE);
        write(Scan::Digits(counter).index(), bytemuck::bytes_of(&job));
    }
    for (kind, job) in [
        (
            Scan::Pairs,
            scan(Counter::Visible as u32, capacities.visible, WORKGROUP_SIZE, 1, Counter::Pairs as u32),
        ),
        (Scan::Entries, scan(NONE, 0, 1, 1, Counter::Entries as u32)),
        (
            Scan::Heads,
            scan(Counter::Entries as u32, capacities.entries, WORKGROUP_SIZE, 1, Counter::RegionSums as u32),
        ),
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
