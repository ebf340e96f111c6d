//! The small records that tell scans and sorts what to work on.

use super::device::Device;
use super::layout::{Capacities, ScanJob, SortPass, screen_layout};
use super::shader::{Counter, NONE, SORT_BLOCK, WORKGROUP_SIZE};

/// Bytes from record to record, as bindings must be aligned.
pub const JOB_STRIDE_BYTES: u64 = 256;
/// Bytes of a record of dispatch sizes.
pub const DISPATCH_BYTES: u64 = 16;
/// Words of a pair.
pub const PAIR_WORDS: u32 = 2;
/// Words of an entry.
pub const ENTRY_WORDS: u32 = 4;

/// Scans that are the same for every view.
#[derive(Clone, Copy)]
pub enum Scan {
    Digits(Counter),
    Pairs,
    /// No array: only the dispatch sizes.
    Entries,
    Heads,
}

/// What is sorted by what.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub enum SortKey {
    Depth,
    Tile,
    Region,
    Member,
}

const SORT_KEYS: [SortKey; 4] = [SortKey::Depth, SortKey::Tile, SortKey::Region, SortKey::Member];
/// Bits that a pass sorts by.
pub const DIGIT_BITS: u32 = 4;
/// Passes for a key of 32 bits.
pub const MAX_PASSES: u32 = 8;

impl SortKey {
    /// Returns the counter with the number of items.
    pub fn counter(self) -> Counter {
        match self {
            Self::Depth => Counter::Visible,
            Self::Tile => Counter::Pairs,
            Self::Region | Self::Member => Counter::Entries,
        }
    }
}

/// Scans that are the same for every view.
pub const SCAN_JOBS: u64 = 6;

impl Scan {
    /// Returns the index of its record.
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

/// Returns the index of a pass's record.
pub fn sort_job(key: SortKey, pass: u32) -> u64 {
    SCAN_JOBS + key as u64 * u64::from(MAX_PASSES) + u64::from(pass)
}

/// Returns where the dispatch sizes for a counter's items lie: a thread an item, or a sort block each.
pub fn dispatch_offset(counter: Counter, by_sort_block: bool) -> u64 {
    (counter as u64 * 2 + u64::from(by_sort_block)) * DISPATCH_BYTES
}

/// Returns the bits of the numbers below `n`.
pub fn bits_of(n: u32) -> u32 {
    u32::BITS - n.saturating_sub(1).leading_zeros()
}

/// Returns one of the small records of a buffer.
pub fn part(buffer: &wgpu::Buffer, index: u64) -> wgpu::BufferBinding<'_> {
    wgpu::BufferBinding {
        buffer,
        offset: index * JOB_STRIDE_BYTES,
        size: std::num::NonZeroU64::new(JOB_STRIDE_BYTES),
    }
}

/// Writes the records of all scans and sorts for a room.
pub fn write_jobs(device: &Device, jobs: &wgpu::Buffer, room: Capacities) {
    let (screen_bytes, depth_word) = screen_layout(device.report.precision);
    let write = |index: u64, bytes: &[u8]| {
        device.queue.write_buffer(jobs, index * JOB_STRIDE_BYTES, bytes);
    };
    let scan = |items, n_most, block, columns, total| ScanJob { items, n_most, block, columns, total };
    for (counter, most) in
        [(Counter::Visible, room.visible), (Counter::Pairs, room.pairs), (Counter::Entries, room.entries)]
    {
        let job = scan(counter as u32, most, SORT_BLOCK, 16, NONE);
        write(Scan::Digits(counter).index(), bytemuck::bytes_of(&job));
    }
    for (kind, job) in [
        (Scan::Pairs, scan(Counter::Visible as u32, room.visible, WORKGROUP_SIZE, 1, Counter::Pairs as u32)),
        (Scan::Entries, scan(NONE, 0, 1, 1, Counter::Entries as u32)),
        (
            Scan::Heads,
            scan(Counter::Entries as u32, room.entries, WORKGROUP_SIZE, 1, Counter::RegionSums as u32),
        ),
    ] {
        write(kind.index(), bytemuck::bytes_of(&job));
    }
    for key in SORT_KEYS {
        let (stride, offset, capacity) = match key {
            SortKey::Depth => (screen_bytes / 4, depth_word, room.visible),
            SortKey::Tile => (PAIR_WORDS, 0, room.pairs),
            SortKey::Region => (ENTRY_WORDS, 1, room.entries),
            SortKey::Member => (ENTRY_WORDS, 0, room.entries),
        };
        for pass in 0..MAX_PASSES {
            let job = SortPass {
                items: key.counter() as u32,
                stride,
                offset,
                shift: pass * DIGIT_BITS,
                is_first: u32::from(pass == 0 && key != SortKey::Member),
                capacity,
            };
            write(sort_job(key, pass), bytemuck::bytes_of(&job));
        }
    }
}
