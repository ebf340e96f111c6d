//! The buffers of one view in flight, and the commands that take it through all stages.

use std::collections::HashMap;
use std::time::Instant;

use bytemuck::Zeroable;
use wgpu::BufferUsages as Usage;

use super::device::Device;
use super::jobs::{
    DIGIT_BITS, DISPATCH_BYTES, ENTRY_WORDS, JOB_STRIDE_BYTES, MAX_PASSES, PAIR_WORDS, SCAN_JOBS, Scan,
    SortKey, bits_of, dispatch_offset, part, sort_job, write_jobs,
};
use super::layout::{
    Background, Capacities, Chunk, RegionSum, ScanJob, SceneGaussian, ViewBlock, screen_layout,
};
use super::shader::{Counter, NONE, SORT_BLOCK, WORKGROUP_SIZE};
use super::timestamps::{GpuTimestamps, TIMESTAMPS_BYTES};
use crate::raster::constants::TILE_SIZE_PX;
use crate::raster::{RasterError, StageTime};

/// Counts of a band's run.
pub type Counts = [u32; Counter::ALL.len()];

/// A piece of the scene on the device.
pub struct SceneChunk {
    /// How many Gaussians it has.
    pub n_gaussians: u32,
    /// Its [`Chunk`] and the [`ScanJob`] of its blocks, [`JOB_STRIDE_BYTES`] apart.
    jobs: wgpu::Buffer,
    /// Its Gaussians; `None` where they are uploaded for each view.
    pub gaussians: Option<wgpu::Buffer>,
}

impl SceneChunk {
    /// Makes the small buffers of a piece; `None` where memory is short.
    pub fn new(device: &Device, first_gaussian: u32, n_gaussians: u32) -> Option<Self> {
        let jobs = device.buffer("chunk jobs", 2 * JOB_STRIDE_BYTES, Usage::STORAGE | Usage::COPY_DST)?;
        let chunk = Chunk { first_gaussian, n_gaussians };
        let scan = ScanJob {
            items: NONE,
            n_most: n_gaussians,
            block: WORKGROUP_SIZE,
            columns: 1,
            total: Counter::Visible as u32,
        };
        device.queue.write_buffer(&jobs, 0, bytemuck::bytes_of(&chunk));
        device.queue.write_buffer(&jobs, JOB_STRIDE_BYTES, bytemuck::bytes_of(&scan));
        Some(Self { n_gaussians, jobs, gaussians: None })
    }
}

/// A band of a view of a scene.
pub struct Band<'a> {
    /// Where it is worked on.
    pub device: &'a Device,
    /// The scene.
    pub chunks: &'a [SceneChunk],
    /// Uploads a chunk that is not on the device.
    pub upload: &'a dyn Fn(usize) -> Result<wgpu::Buffer, RasterError>,
    /// The view and its rows of tiles.
    pub view: &'a ViewBlock,
}

impl Band<'_> {
    /// Returns the columns and rows of tiles.
    fn tiles(&self) -> [u32; 2] {
        let [_, _, first_row, end_row, columns, ..] = self.view.words;
        [columns, end_row - first_row]
    }
}

/// The buffers of one view in flight.
pub struct Workspace {
    /// What there is room for.
    pub room: Capacities,
    n_tiles: u32,
    n_px: u32,
    view: wgpu::Buffer,
    counters: wgpu::Buffer,
    dispatches: wgpu::Buffer,
    jobs: wgpu::Buffer,
    block_counts: wgpu::Buffer,
    histogram: wgpu::Buffer,
    screen: wgpu::Buffer,
    tile_counts: wgpu::Buffer,
    visible_order: [wgpu::Buffer; 2],
    pairs: wgpu::Buffer,
    pair_order: [wgpu::Buffer; 2],
    members: wgpu::Buffer,
    ranges: wgpu::Buffer,
    regions: wgpu::Buffer,
    entries: wgpu::Buffer,
    entry_order: [wgpu::Buffer; 2],
    region_sums: wgpu::Buffer,
    staging: wgpu::Buffer,
    /// Region sums that are copied back with the counters.
    n_copied: u32,
    groups: HashMap<(&'static str, u32), wgpu::BindGroup>,
    timestamps: GpuTimestamps,
}

/// Sizes that a workspace is made for.
#[derive(Clone, Copy)]
pub struct Size {
    /// Room for what the shaders produce.
    pub room: Capacities,
    /// Tiles of a band.
    pub n_tiles: u32,
    /// Pixels of a band.
    pub n_px: u32,
    /// Gaussians of the largest chunk.
    pub n_chunk: u32,
}

const COUNTERS_BYTES: u64 = 64;
/// What precedes the sums in the copy back: counters and timestamps.
const HEAD_BYTES: u64 = (COUNTERS_BYTES + TIMESTAMPS_BYTES).next_multiple_of(256);

/// Bytes of a pixel of a picture.
pub const PIXEL_BYTES: u64 = 20;

impl Workspace {
    /// Makes the buffers; `None` where the device's memory does not hold them.
    pub fn new(device: &Device, size: Size) -> Option<Self> {
        let Size { room, n_tiles, n_px, n_chunk } = size;
        let storage = |label: &str, words: u64| {
            device.buffer(label, words * 4, Usage::STORAGE | Usage::COPY_DST | Usage::COPY_SRC)
        };
        let (screen_bytes, _) = screen_layout(device.report.precision);
        let (visible, pairs, entries) =
            (u64::from(room.visible), u64::from(room.pairs), u64::from(room.entries));
        let largest = visible.max(pairs).max(entries);
        let n_copied = (room.entries / 4).clamp(1, 1 << 16);
        let workspace = Self {
            room,
            n_tiles,
            n_px,
            view: storage("view", 64)?,
            counters: storage("counters", COUNTERS_BYTES / 4)?,
            dispatches: device.buffer(
                "dispatches",
                2 * Counter::ALL.len() as u64 * DISPATCH_BYTES,
                Usage::STORAGE | Usage::INDIRECT,
            )?,
            jobs: storage("jobs", (SCAN_JOBS + 4 * u64::from(MAX_PASSES)) * JOB_STRIDE_BYTES / 4)?,
            block_counts: storage(
                "block counts",
                largest.max(n_chunk.into()).div_ceil(WORKGROUP_SIZE.into()),
            )?,
            histogram: storage("histogram", 16 * largest.div_ceil(SORT_BLOCK.into()))?,
            screen: storage("screen", visible * u64::from(screen_bytes / 4))?,
            tile_counts: storage("tile counts", visible)?,
            visible_order: [storage("order of visible", visible)?, storage("order of visible", visible)?],
            pairs: storage("pairs", pairs * u64::from(PAIR_WORDS))?,
            pair_order: [storage("order of pairs", pairs)?, storage("order of pairs", pairs)?],
            members: storage("members", pairs)?,
            ranges: storage("ranges", 2 * u64::from(n_tiles))?,
            regions: storage("regions", n_px.into())?,
            entries: storage("entries", entries * u64::from(ENTRY_WORDS))?,
            entry_order: [storage("order of entries", entries)?, storage("order of entries", entries)?],
            region_sums: storage("region sums", entries * 4)?,
            staging: Self::staging(device, n_copied)?,
            n_copied,
            groups: HashMap::new(),
            timestamps: GpuTimestamps::new(device)?,
        };
        write_jobs(device, &workspace.jobs, room);
        Some(workspace)
    }

    fn staging(device: &Device, n_copied: u32) -> Option<wgpu::Buffer> {
        let bytes = HEAD_BYTES + u64::from(n_copied) * size_of::<RegionSum>() as u64;
        device.buffer("staging", bytes, Usage::MAP_READ | Usage::COPY_DST)
    }

    /// Returns whether a band fits.
    pub fn holds(&self, n_tiles: u32, n_px: u32) -> bool {
        n_tiles <= self.n_tiles && n_px <= self.n_px
    }

    /// Takes a band of a view through all stages and returns its counts. `take` gets the sums, once,
    /// where they are complete: where a count is beyond the room, they are not.
    pub fn sum(
        &mut self,
        band: &Band<'_>,
        regions: &[u32],
        times: &mut Vec<StageTime>,
        take: &mut dyn FnMut(&[RegionSum]),
    ) -> Result<Counts, RasterError> {
        let start = Instant::now();
        let device = band.device;
        device.queue.write_buffer(&self.regions, 0, bytemuck::cast_slice(regions));
        let mut encoder = self.bin(band)?;
        let [columns, rows] = band.tiles();
        let mut pass = self.timestamps.pass(&mut encoder, 3, (true, true));
        self.blend(device, &mut pass, columns, rows);
        drop(pass);
        let mut pass = self.timestamps.pass(&mut encoder, 4, (true, true));
        let n_regions = band.view.words[6];
        let keys = [(SortKey::Region, bits_of(n_regions)), (SortKey::Member, bits_of(self.room.visible))];
        let entry_order = self.sort(device, &mut pass, &keys);
        self.compact(device, &mut pass, entry_order);
        drop(pass);
        self.timestamps.resolve(&mut encoder, &self.staging, COUNTERS_BYTES);
        self.copy_back(&mut encoder);
        let submission = device.queue.submit([encoder.finish()]);
        times.push(StageTime { stage: "submit", ms: start.elapsed().as_secs_f64() * 1e3 });
        let counts = self.read_back(device, submission, times, take)?;
        let n_sums = counts[Counter::RegionSums as usize];
        if !self.fits(&counts) || n_sums <= self.n_copied {
            return Ok(counts);
        }
        // More than expected: a second copy, but from now on one that is large enough.
        self.n_copied = n_sums.saturating_add(n_sums / 4).min(self.room.entries);
        self.staging = Self::staging(device, self.n_copied)
            .ok_or_else(|| device.room_error("no memory for the copy back".into()))?;
        let mut encoder = device.device.create_command_encoder(&Default::default());
        self.copy_back(&mut encoder);
        let submission = device.queue.submit([encoder.finish()]);
        self.read_back(device, submission, &mut Vec::new(), take)
    }

    /// Draws a band and returns its counts and pixels: red, green, blue, depth, coverage.
    pub fn draw(
        &mut self,
        band: &Band<'_>,
        background: [f32; 3],
        colours: &wgpu::Buffer,
    ) -> Result<(Counts, Vec<f32>), RasterError> {
        let device = band.device;
        let mut encoder = self.bin(band)?;
        let [columns, rows] = band.tiles();
        let n_bytes = u64::from(self.n_px) * PIXEL_BYTES;
        let no_room = || device.room_error("no memory for a picture".into());
        let make = |label: &str, size, usage| device.buffer(label, size, usage).ok_or_else(no_room);
        // Pictures are rare: their buffers do not stay.
        let over = make("background", 16, Usage::STORAGE | Usage::COPY_DST)?;
        let pixels = make("pixels", n_bytes, Usage::STORAGE | Usage::COPY_SRC)?;
        let staging = make("staging", COUNTERS_BYTES + n_bytes, Usage::MAP_READ | Usage::COPY_DST)?;
        let value = Background { rgb: background, padding: 0 };
        device.queue.write_buffer(&over, 0, bytemuck::bytes_of(&value));
        let bound =
            [&self.view, &over, &self.screen, &self.members, &self.ranges, colours, &pixels].map(whole);
        let kernel = &device.kernels.draw;
        let group = bind(device, kernel, &number(&bound));
        dispatch(&mut encoder.begin_compute_pass(&Default::default()), kernel, &group, [columns, rows]);
        encoder.copy_buffer_to_buffer(&self.counters, 0, &staging, 0, COUNTERS_BYTES);
        encoder.copy_buffer_to_buffer(&pixels, 0, &staging, COUNTERS_BYTES, n_bytes);
        let submission = device.queue.submit([encoder.finish()]);
        staging.map_async(wgpu::MapMode::Read, .., |_| {});
        device.wait(submission)?;
        let bytes = staging.get_mapped_range(..).map_err(|e| device.error(e.to_string()))?;
        let (head, rest) = bytes.split_at(COUNTERS_BYTES as usize);
        let mut counts: Counts = Zeroable::zeroed();
        counts.copy_from_slice(&bytemuck::cast_slice::<u8, u32>(head)[..Counter::ALL.len()]);
        Ok((counts, bytemuck::cast_slice(rest).to_vec()))
    }

    /// Records all stages up to the lists of each tile's Gaussians.
    fn bin(&mut self, band: &Band<'_>) -> Result<wgpu::CommandEncoder, RasterError> {
        let Band { device, chunks, upload, view } = *band;
        device.queue.write_buffer(&self.view, 0, &view.to_bytes(device.report.precision));
        let mut encoder = device.device.create_command_encoder(&Default::default());
        encoder.clear_buffer(&self.counters, 0, None);
        encoder.clear_buffer(&self.ranges, 0, None);
        for (index, chunk) in chunks.iter().enumerate() {
            let ends = (index == 0, index + 1 == chunks.len());
            match &chunk.gaussians {
                Some(gaussians) => self.project(device, &mut encoder, chunk, gaussians, ends),
                None => {
                    let gaussians = upload(index)?;
                    self.project(device, &mut encoder, chunk, &gaussians, ends);
                    // Before the next piece, so that no more than one lies on the device.
                    let next = device.device.create_command_encoder(&Default::default());
                    let full = std::mem::replace(&mut encoder, next);
                    let submission = device.queue.submit([full.finish()]);
                    device.wait(submission)?;
                }
            }
        }
        let [columns, rows] = band.tiles();
        let mut pass = self.timestamps.pass(&mut encoder, 1, (true, true));
        let depth_order = self.sort(device, &mut pass, &[(SortKey::Depth, 32)]);
        drop(pass);
        let mut pass = self.timestamps.pass(&mut encoder, 2, (true, true));
        self.pair(device, &mut pass, depth_order);
        let pair_order = self.sort(device, &mut pass, &[(SortKey::Tile, bits_of(columns * rows))]);
        self.find_ranges(device, &mut pass, pair_order);
        drop(pass);
        Ok(encoder)
    }

    /// Returns whether all that a band produces fits the room.
    pub fn fits(&self, counts: &Counts) -> bool {
        counts[Counter::Visible as usize] <= self.room.visible
            && counts[Counter::Pairs as usize] <= self.room.pairs
            && counts[Counter::Entries as usize] <= self.room.entries
    }

    fn copy_back(&self, encoder: &mut wgpu::CommandEncoder) {
        let sum_bytes = u64::from(self.n_copied) * size_of::<RegionSum>() as u64;
        encoder.copy_buffer_to_buffer(&self.counters, 0, &self.staging, 0, COUNTERS_BYTES);
        encoder.copy_buffer_to_buffer(&self.region_sums, 0, &self.staging, HEAD_BYTES, sum_bytes);
    }

    fn read_back(
        &self,
        device: &Device,
        submission: wgpu::SubmissionIndex,
        times: &mut Vec<StageTime>,
        take: &mut dyn FnMut(&[RegionSum]),
    ) -> Result<Counts, RasterError> {
        let start = Instant::now();
        self.staging.map_async(wgpu::MapMode::Read, .., |_| {});
        device.wait(submission)?;
        let waited_ms = start.elapsed().as_secs_f64() * 1e3;
        let bytes = self.staging.get_mapped_range(..).map_err(|e| device.error(e.to_string()))?;
        let mut counts: Counts = Zeroable::zeroed();
        counts.copy_from_slice(
            &bytemuck::cast_slice::<u8, u32>(&bytes[..COUNTERS_BYTES as usize])[..Counter::ALL.len()],
        );
        let stages = self.timestamps.read(&bytes[COUNTERS_BYTES as usize..HEAD_BYTES as usize]);
        let on_device_ms: f64 = stages.iter().map(|stage| stage.ms).sum();
        times.extend(stages);
        times.push(StageTime { stage: "copy", ms: (waited_ms - on_device_ms).max(0.0) });
        let n_sums = counts[Counter::RegionSums as usize];
        if self.fits(&counts) && n_sums <= self.n_copied {
            let start = Instant::now();
            take(&bytemuck::cast_slice(&bytes[HEAD_BYTES as usize..])[..n_sums as usize]);
            times.push(StageTime { stage: "read", ms: start.elapsed().as_secs_f64() * 1e3 });
        }
        drop(bytes);
        self.staging.unmap();
        Ok(counts)
    }

    fn project(
        &mut self,
        device: &Device,
        encoder: &mut wgpu::CommandEncoder,
        chunk: &SceneChunk,
        gaussians: &wgpu::Buffer,
        ends: (bool, bool),
    ) {
        let mut pass = self.timestamps.pass(encoder, 0, ends);
        let kernels = &device.kernels;
        let n_blocks = chunk.n_gaussians.div_ceil(WORKGROUP_SIZE);
        let chunk_job = part(&chunk.jobs, 0);
        let bound = [&self.view, &self.counters].map(whole).into_iter().chain([chunk_job, whole(gaussians)]);
        let bound: Vec<_> = bound.chain([whole(&self.block_counts)]).collect();
        let group = bind(device, &kernels.count_visible, &number(&bound));
        dispatch(&mut pass, &kernels.count_visible, &group, [n_blocks, 1]);
        let scan =
            [part(&chunk.jobs, 1), whole(&self.counters), whole(&self.block_counts), whole(&self.dispatches)];
        let group = bind(device, &kernels.scan, &number(&scan));
        dispatch(&mut pass, &kernels.scan, &group, [1, 1]);
        let bound = [
            (0, whole(&self.view)),
            (2, part(&chunk.jobs, 0)),
            (3, whole(gaussians)),
            (4, whole(&self.block_counts)),
            (5, whole(&self.screen)),
            (6, whole(&self.tile_counts)),
        ];
        let group = bind(device, &kernels.write_visible, &bound);
        dispatch(&mut pass, &kernels.write_visible, &group, [n_blocks, 1]);
    }

    fn scan(&mut self, device: &Device, pass: &mut wgpu::ComputePass<'_>, scan: Scan) {
        let values = match scan {
            Scan::Digits(_) => &self.histogram,
            Scan::Pairs | Scan::Entries | Scan::Heads => &self.block_counts,
        };
        let bound =
            [part(&self.jobs, scan.index()), whole(&self.counters), whole(values), whole(&self.dispatches)];
        let group = cached(&mut self.groups, ("scan", scan.index() as u32), || {
            bind(device, &device.kernels.scan, &number(&bound))
        });
        dispatch(pass, &device.kernels.scan, group, [1, 1]);
    }

    /// Sorts by several keys, the least first, and returns which buffer holds the order.
    fn sort(&mut self, device: &Device, pass: &mut wgpu::ComputePass<'_>, keys: &[(SortKey, u32)]) -> usize {
        let mut current = 0;
        for &(key, bits) in keys {
            for digit in 0..bits.div_ceil(DIGIT_BITS).max(1) {
                let (values, order) = match key {
                    SortKey::Depth => (&self.screen, &self.visible_order),
                    SortKey::Tile => (&self.pairs, &self.pair_order),
                    SortKey::Region | SortKey::Member => (&self.entries, &self.entry_order),
                };
                let job = sort_job(key, digit);
                let bound = number(&[
                    part(&self.jobs, job),
                    whole(&self.counters),
                    whole(values),
                    whole(&order[current]),
                    whole(&self.histogram),
                    whole(&order[1 - current]),
                ]);
                let name = job as u32 * 2 + current as u32;
                let kernels = &device.kernels;
                let count = cached(&mut self.groups, ("count_digits", name), || {
                    bind(device, &kernels.count_digits, &bound[..5])
                })
                .clone();
                let scatter =
                    cached(&mut self.groups, ("scatter", name), || bind(device, &kernels.scatter, &bound))
                        .clone();
                let offset = dispatch_offset(key.counter(), true);
                dispatch_indirect(pass, &kernels.count_digits, &count, (&self.dispatches, offset));
                self.scan(device, pass, Scan::Digits(key.counter()));
                dispatch_indirect(pass, &kernels.scatter, &scatter, (&self.dispatches, offset));
                current = 1 - current;
            }
        }
        current
    }

    fn pair(&mut self, device: &Device, pass: &mut wgpu::ComputePass<'_>, depth_order: usize) {
        let offset = dispatch_offset(Counter::Visible, false);
        let order = &self.visible_order[depth_order];
        let counted = [
            (0, whole(&self.view)),
            (1, whole(&self.counters)),
            (3, whole(&self.tile_counts)),
            (4, whole(order)),
            (5, whole(&self.block_counts)),
        ];
        let written = [(2, whole(&self.screen)), (6, whole(&self.pairs))];
        let written: Vec<_> = counted.iter().chain(&written).cloned().collect();
        let kernels = &device.kernels;
        let key = depth_order as u32;
        let group =
            cached(&mut self.groups, ("count_pairs", key), || bind(device, &kernels.count_pairs, &counted));
        dispatch_indirect(pass, &kernels.count_pairs, group, (&self.dispatches, offset));
        let group =
            cached(&mut self.groups, ("write_pairs", key), || bind(device, &kernels.write_pairs, &written))
                .clone();
        self.scan(device, pass, Scan::Pairs);
        dispatch_indirect(pass, &kernels.write_pairs, &group, (&self.dispatches, offset));
    }

    fn find_ranges(&mut self, device: &Device, pass: &mut wgpu::ComputePass<'_>, pair_order: usize) {
        let bound = [
            (0, whole(&self.view)),
            (1, whole(&self.counters)),
            (4, whole(&self.pair_order[pair_order])),
            (7, whole(&self.pairs)),
            (8, whole(&self.ranges)),
            (9, whole(&self.members)),
        ];
        let kernel = &device.kernels.find_ranges;
        let group =
            cached(&mut self.groups, ("find_ranges", pair_order as u32), || bind(device, kernel, &bound));
        dispatch_indirect(pass, kernel, group, (&self.dispatches, dispatch_offset(Counter::Pairs, false)));
    }

    fn blend(&mut self, device: &Device, pass: &mut wgpu::ComputePass<'_>, columns: u32, rows: u32) {
        let bound = [
            &self.view,
            &self.counters,
            &self.screen,
            &self.members,
            &self.ranges,
            &self.regions,
            &self.entries,
        ]
        .map(whole);
        let kernel = &device.kernels.sum_regions;
        let group = cached(&mut self.groups, ("sum_regions", 0), || bind(device, kernel, &number(&bound)));
        dispatch(pass, kernel, group, [columns, rows]);
        self.scan(device, pass, Scan::Entries);
    }

    fn compact(&mut self, device: &Device, pass: &mut wgpu::ComputePass<'_>, entry_order: usize) {
        let order = &self.entry_order[entry_order];
        let bound = [
            (0, whole(&self.view)),
            (1, whole(&self.counters)),
            (2, whole(&self.screen)),
            (3, whole(&self.entries)),
            (4, whole(order)),
            (5, whole(&self.block_counts)),
            (6, whole(&self.region_sums)),
        ];
        let kernels = &device.kernels;
        let offset = dispatch_offset(Counter::Entries, false);
        let key = entry_order as u32;
        let counted: Vec<_> = bound.iter().filter(|b| b.0 != 2).cloned().collect();
        let add_up =
            cached(&mut self.groups, ("add_up", key), || bind(device, &kernels.add_up, &bound)).clone();
        let group =
            cached(&mut self.groups, ("count_heads", key), || bind(device, &kernels.count_heads, &counted));
        dispatch_indirect(pass, &kernels.count_heads, group, (&self.dispatches, offset));
        self.scan(device, pass, Scan::Heads);
        dispatch_indirect(pass, &kernels.add_up, &add_up, (&self.dispatches, offset));
    }
}

fn whole(buffer: &wgpu::Buffer) -> wgpu::BufferBinding<'_> {
    buffer.as_entire_buffer_binding()
}

fn number<'a>(bindings: &[wgpu::BufferBinding<'a>]) -> Vec<(u32, wgpu::BufferBinding<'a>)> {
    (0..).zip(bindings.iter().cloned()).collect()
}

fn bind(
    device: &Device,
    kernel: &wgpu::ComputePipeline,
    bound: &[(u32, wgpu::BufferBinding<'_>)],
) -> wgpu::BindGroup {
    let entries: Vec<_> = bound
        .iter()
        .map(|(binding, buffer)| wgpu::BindGroupEntry {
            binding: *binding,
            resource: wgpu::BindingResource::Buffer(buffer.clone()),
        })
        .collect();
    device.device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &kernel.get_bind_group_layout(0),
        entries: &entries,
    })
}

fn cached<'g>(
    groups: &'g mut HashMap<(&'static str, u32), wgpu::BindGroup>,
    key: (&'static str, u32),
    make: impl FnOnce() -> wgpu::BindGroup,
) -> &'g wgpu::BindGroup {
    groups.entry(key).or_insert_with(make)
}

fn dispatch(
    pass: &mut wgpu::ComputePass<'_>,
    kernel: &wgpu::ComputePipeline,
    group: &wgpu::BindGroup,
    n: [u32; 2],
) {
    pass.set_pipeline(kernel);
    pass.set_bind_group(0, group, &[]);
    pass.dispatch_workgroups(n[0], n[1], 1);
}

fn dispatch_indirect(
    pass: &mut wgpu::ComputePass<'_>,
    kernel: &wgpu::ComputePipeline,
    group: &wgpu::BindGroup,
    (sizes, offset): (&wgpu::Buffer, u64),
) {
    pass.set_pipeline(kernel);
    pass.set_bind_group(0, group, &[]);
    pass.dispatch_workgroups_indirect(sizes, offset);
}

/// Returns the tiles and pixels of a band.
pub fn band_size(width_px: u32, height_px: u32, tile_rows: [u32; 2]) -> (u32, u32) {
    let tile = TILE_SIZE_PX as u32;
    let rows_px = (tile_rows[1] * tile).min(height_px) - tile_rows[0] * tile;
    ((tile_rows[1] - tile_rows[0]) * width_px.div_ceil(tile), rows_px * width_px)
}

/// Bytes of a Gaussian in the device's memory.
pub const SCENE_GAUSSIAN_BYTES: u64 = size_of::<SceneGaussian>() as u64;

#[cfg(test)]
mod tests {
    use super::super::device::adapters;
    use super::*;

    /// Sorts entries by (member, region) on the device and on the host, at sizes about a workgroup and a
    /// block. Half of the keys repeat, so that an unstable sort shows.
    #[test]
    fn the_sort_is_stable_at_every_size() {
        let Some(adapter) = adapters().into_iter().next() else {
            println!("skipped: no GPU");
            return;
        };
        let device = adapter.open(adapter.report.precision).expect("opens");
        let room = Capacities { visible: 1, pairs: 1, entries: 70_000 };
        let size = Size { room, n_tiles: 1, n_px: 1, n_chunk: 1 };
        let mut workspace = Workspace::new(&device, size).expect("there is memory");
        for n in [0, 1, 2, 255, 256, 257, 2047, 2048, 2049, 4096, 70_000] {
            let key = |i: u32, salt: u32| (i ^ salt).wrapping_mul(0x9e37_79b9) >> 8;
            let entries: Vec<[u32; 4]> =
                (0..n).map(|i| [key(i / 2, 1) % 5000, key(i / 3, 2) % 300, i, 0]).collect();
            let mut counts: Counts = Zeroable::zeroed();
            counts[Counter::Entries as usize] = n;
            device.queue.write_buffer(&workspace.counters, 0, bytemuck::bytes_of(&counts));
            device.queue.write_buffer(&workspace.entries, 0, bytemuck::cast_slice(&entries));
            let mut encoder = device.device.create_command_encoder(&Default::default());
            let mut pass = encoder.begin_compute_pass(&Default::default());
            workspace.scan(&device, &mut pass, Scan::Entries);
            let keys = [(SortKey::Region, bits_of(300)), (SortKey::Member, 32)];
            let last = workspace.sort(&device, &mut pass, &keys);
            drop(pass);
            let staging = device
                .buffer("staging", u64::from(n) * 4, Usage::MAP_READ | Usage::COPY_DST)
                .expect("there is memory");
            encoder.copy_buffer_to_buffer(&workspace.entry_order[last], 0, &staging, 0, u64::from(n) * 4);
            let submission = device.queue.submit([encoder.finish()]);
            staging.map_async(wgpu::MapMode::Read, .., |_| {});
            device.wait(submission).expect("no error");
            let bytes = staging.get_mapped_range(..).expect("mapped");
            let found = bytemuck::cast_slice::<u8, u32>(&bytes)[..n as usize].to_vec();
            let mut expected: Vec<u32> = (0..n).collect();
            expected.sort_by_key(|i| (entries[*i as usize][0], entries[*i as usize][1]));
            assert!(found == expected, "{n} items");
        }
    }
}
