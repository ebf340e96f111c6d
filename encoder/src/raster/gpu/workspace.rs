//! One view in flight: submits the stages and reads the results back.

use bytemuck::Zeroable;
use slag_raster::constants::TILE_SIZE_PX;
use wgpu::BufferUsages as Usage;

use super::device::Device;
use super::jobs::{
    Buffers, COUNTERS_BYTES, Size, SortKey, VIEW_BYTES, bits_of, depth_keys, regions_bytes, write_sort_jobs,
};
use super::layout::{Background, Capacities, RegionSum, ViewBlock};
use super::shader::{Counter, Counts};
use super::stages::{SceneChunk, Stages, bind, dispatch, number, whole};
use crate::raster::RasterError;

pub(crate) const PIXEL_BYTES: u64 = 20;

pub struct Workspace {
    pub(crate) capacities: Capacities,
    n_tiles: u32,
    n_px: u32,
    stages: Stages,
    /// A band's view, then its regions. Mapped between bands.
    uploads: wgpu::Buffer,
    staging: wgpu::Buffer,
    /// Contributions that are copied back together with the counters.
    n_copied: u32,
    /// Bits of a region in the entries' sort records.
    region_bits: u32,
}

impl Workspace {
    /// `None` if the device memory does not suffice.
    pub fn new(device: &Device, size: Size) -> Option<Self> {
        let Size { capacities, n_tiles, n_px, .. } = size;
        let uploads_bytes = VIEW_BYTES + regions_bytes(n_px as usize);
        let n_copied = (capacities.entries / 4).clamp(1, 1 << 16);
        Some(Self {
            capacities,
            n_tiles,
            n_px,
            stages: Stages::new(Buffers::new(device, size)?),
            uploads: device.buffer("uploads", uploads_bytes, Usage::MAP_WRITE | Usage::COPY_SRC)?,
            staging: Self::staging(device, n_copied)?,
            n_copied,
            region_bits: u32::MAX,
        })
    }

    fn staging(device: &Device, n_copied: u32) -> Option<wgpu::Buffer> {
        let bytes = COUNTERS_BYTES + u64::from(n_copied) * size_of::<RegionSum>() as u64;
        device.buffer("staging", bytes, Usage::MAP_READ | Usage::COPY_DST)
    }

    pub fn holds(&self, n_tiles: u32, n_px: u32) -> bool {
        n_tiles <= self.n_tiles && n_px <= self.n_px
    }

    /// Runs all stages on a band and returns its counts. `take` gets the contributions once, unless a count exceeds its
    /// capacity and makes them incomplete.
    pub fn contributions(
        &mut self,
        band: &Band<'_>,
        regions: &[u32],
        n_regions: u32,
        take: &mut dyn FnMut(&[RegionSum]),
    ) -> Result<Counts, RasterError> {
        let device = band.device;
        self.set_region_bits(device, bits_of(n_regions));
        let mut encoder = self.bin(band, regions)?;
        let mut pass = encoder.begin_compute_pass(&Default::default());
        self.stages.blend(device, &mut pass, band.tiles());
        drop(pass);
        let mut pass = encoder.begin_compute_pass(&Default::default());
        let bits = bits_of(self.capacities.visible) + self.region_bits;
        let entry_order = self.stages.sort(device, &mut pass, (SortKey::MemberRegion, bits));
        self.stages.compact(device, &mut pass, entry_order);
        drop(pass);
        self.copy_back(&mut encoder);
        let submission = device.queue.submit([encoder.finish()]);
        self.uploads.map_async(wgpu::MapMode::Write, .., |_| {});
        let counts = self.read_back(device, submission, take)?;
        let n_contributions = counts[Counter::RegionSums as usize];
        if !self.fits(&counts) || n_contributions <= self.n_copied {
            return Ok(counts);
        }
        // More than expected: copies again, with a larger staging buffer from now on.
        self.n_copied = n_contributions.saturating_add(n_contributions / 4).min(self.capacities.entries);
        self.staging = Self::staging(device, self.n_copied)
            .ok_or_else(|| device.capacity_error("out of memory for the copy back".into()))?;
        let mut encoder = device.device.create_command_encoder(&Default::default());
        self.copy_back(&mut encoder);
        let submission = device.queue.submit([encoder.finish()]);
        self.read_back(device, submission, take)
    }

    /// Writes the entries' sort records, unless they are for as many bits.
    fn set_region_bits(&mut self, device: &Device, region_bits: u32) {
        if self.region_bits != region_bits {
            self.region_bits = region_bits;
            let key = (SortKey::MemberRegion, region_bits);
            write_sort_jobs(device, &self.stages.buffers.jobs, self.capacities, key);
        }
    }

    /// Draws a band and returns its counts and pixels: red, green, blue, depth, coverage.
    pub fn draw(
        &mut self,
        band: &Band<'_>,
        background: [f32; 3],
        colours: &wgpu::Buffer,
    ) -> Result<(Counts, Vec<f32>), RasterError> {
        let device = band.device;
        let mut encoder = self.bin(band, &[])?;
        let n_bytes = u64::from(self.n_px) * PIXEL_BYTES;
        let no_memory = || device.capacity_error("out of memory for a picture".into());
        let make = |label: &str, size, usage| device.buffer(label, size, usage).ok_or_else(no_memory);
        // Drawings are rare, so their buffers are not kept.
        let over = make("background", 16, Usage::STORAGE | Usage::COPY_DST)?;
        let pixels = make("pixels", n_bytes, Usage::STORAGE | Usage::COPY_SRC)?;
        let staging = make("staging", COUNTERS_BYTES + n_bytes, Usage::MAP_READ | Usage::COPY_DST)?;
        let value = Background { rgb: background, padding: 0 };
        device.queue.write_buffer(&over, 0, bytemuck::bytes_of(&value));
        let bound = [
            &self.stages.buffers.view,
            &over,
            &self.stages.buffers.screen,
            &self.stages.buffers.members,
            &self.stages.buffers.ranges,
            colours,
            &pixels,
        ]
        .map(whole);
        let kernel = &device.kernels.draw;
        let group = bind(device, kernel, &number(&bound));
        dispatch(&mut encoder.begin_compute_pass(&Default::default()), kernel, &group, band.tiles());
        encoder.copy_buffer_to_buffer(&self.stages.buffers.counters, 0, &staging, 0, COUNTERS_BYTES);
        encoder.copy_buffer_to_buffer(&pixels, 0, &staging, COUNTERS_BYTES, n_bytes);
        let submission = device.queue.submit([encoder.finish()]);
        self.uploads.map_async(wgpu::MapMode::Write, .., |_| {});
        staging.map_async(wgpu::MapMode::Read, .., |_| {});
        device.wait(submission)?;
        let bytes = staging.get_mapped_range(..).map_err(|e| device.error(e.to_string()))?;
        let (counts, pixels) = counts_and_rest(&bytes);
        Ok((counts, bytemuck::cast_slice(pixels).to_vec()))
    }

    fn upload(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        band: &Band<'_>,
        regions: &[u32],
    ) -> Result<(), RasterError> {
        let device = band.device;
        let mut bytes = band.view.to_bytes(device.report.precision);
        bytes.resize(VIEW_BYTES as usize, 0);
        // Two per word; `NO_REGION` stays the largest number.
        bytes.extend(regions.iter().flat_map(|region| (*region as u16).to_le_bytes()));
        bytes.resize((VIEW_BYTES + regions_bytes(regions.len())) as usize, 0);
        let mut mapped = self
            .uploads
            .get_mapped_range_mut(..bytes.len() as u64)
            .map_err(|e| device.error(e.to_string()))?;
        mapped.copy_from_slice(&bytes);
        drop(mapped);
        self.uploads.unmap();
        let Buffers { view, regions, .. } = &self.stages.buffers;
        encoder.copy_buffer_to_buffer(&self.uploads, 0, view, 0, VIEW_BYTES);
        let n_bytes = bytes.len() as u64 - VIEW_BYTES;
        encoder.copy_buffer_to_buffer(&self.uploads, VIEW_BYTES, regions, 0, n_bytes);
        Ok(())
    }

    /// Records the stages up to each tile's list of Gaussians.
    fn bin(&mut self, band: &Band<'_>, regions: &[u32]) -> Result<wgpu::CommandEncoder, RasterError> {
        let Band { device, chunks, upload, .. } = *band;
        let mut encoder = device.device.create_command_encoder(&Default::default());
        self.upload(&mut encoder, band, regions)?;
        encoder.clear_buffer(&self.stages.buffers.counters, 0, None);
        encoder.clear_buffer(&self.stages.buffers.ranges, 0, None);
        let record = |encoder: &mut wgpu::CommandEncoder, chunk, gaussians: &wgpu::Buffer| {
            let mut pass = encoder.begin_compute_pass(&Default::default());
            self.stages.project(device, &mut pass, chunk, gaussians);
        };
        for (index, chunk) in chunks.iter().enumerate() {
            if let Some(gaussians) = &chunk.gaussians {
                record(&mut encoder, chunk, gaussians);
                continue;
            }
            record(&mut encoder, chunk, &upload(index)?);
            // Waits before the next upload, so that at most one such chunk is on the device.
            let next = device.device.create_command_encoder(&Default::default());
            let full = std::mem::replace(&mut encoder, next);
            device.wait(device.queue.submit([full.finish()]))?;
        }
        let [columns, rows] = band.tiles();
        let mut pass = encoder.begin_compute_pass(&Default::default());
        let depth_order = self.stages.sort(device, &mut pass, (SortKey::Depth, depth_keys().1));
        drop(pass);
        let mut pass = encoder.begin_compute_pass(&Default::default());
        self.stages.pair(device, &mut pass, depth_order);
        let pair_order = self.stages.sort(device, &mut pass, (SortKey::Tile, bits_of(columns * rows)));
        self.stages.find_ranges(device, &mut pass, pair_order);
        drop(pass);
        Ok(encoder)
    }

    fn fits(&self, counts: &Counts) -> bool {
        self.capacities.hold(&Capacities::needed(counts))
    }

    fn copy_back(&self, encoder: &mut wgpu::CommandEncoder) {
        let n_bytes = u64::from(self.n_copied) * size_of::<RegionSum>() as u64;
        let Buffers { counters, region_sums, .. } = &self.stages.buffers;
        encoder.copy_buffer_to_buffer(counters, 0, &self.staging, 0, COUNTERS_BYTES);
        encoder.copy_buffer_to_buffer(region_sums, 0, &self.staging, COUNTERS_BYTES, n_bytes);
    }

    fn read_back(
        &self,
        device: &Device,
        submission: wgpu::SubmissionIndex,
        take: &mut dyn FnMut(&[RegionSum]),
    ) -> Result<Counts, RasterError> {
        self.staging.map_async(wgpu::MapMode::Read, .., |_| {});
        device.wait(submission)?;
        let bytes = self.staging.get_mapped_range(..).map_err(|e| device.error(e.to_string()))?;
        let (counts, rest) = counts_and_rest(&bytes);
        let n_contributions = counts[Counter::RegionSums as usize];
        if self.fits(&counts) && n_contributions <= self.n_copied {
            take(&bytemuck::cast_slice(rest)[..n_contributions as usize]);
        }
        drop(bytes);
        self.staging.unmap();
        Ok(counts)
    }
}

/// What a staging buffer has: the counters, then what was copied behind them.
fn counts_and_rest(staged: &[u8]) -> (Counts, &[u8]) {
    let (head, rest) = staged.split_at(COUNTERS_BYTES as usize);
    let mut counts: Counts = Zeroable::zeroed();
    counts.copy_from_slice(&bytemuck::cast_slice::<u8, u32>(head)[..Counter::ALL.len()]);
    (counts, rest)
}

pub(crate) struct Band<'a> {
    pub device: &'a Device,
    pub chunks: &'a [SceneChunk],
    pub(crate) upload: &'a dyn Fn(usize) -> Result<wgpu::Buffer, RasterError>,
    pub view: &'a ViewBlock,
}

impl Band<'_> {
    pub fn tiles(&self) -> [u32; 2] {
        let [_, _, first_row, end_row, columns, ..] = self.view.words;
        [columns, end_row - first_row]
    }
}

pub(crate) fn band_size(width_px: u32, height_px: u32, tile_rows: [u32; 2]) -> (u32, u32) {
    let tile = TILE_SIZE_PX as u32;
    let rows_px = (tile_rows[1] * tile).min(height_px) - tile_rows[0] * tile;
    ((tile_rows[1] - tile_rows[0]) * width_px.div_ceil(tile), rows_px * width_px)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::raster::gpu::jobs::Scan;
    use crate::raster::gpu::tests::first_gpu;

    fn opened(capacities: Capacities) -> Option<(Device, Workspace)> {
        let device = first_gpu()?;
        let size = Size { capacities, n_tiles: 1, n_px: 1, n_chunk: 1 };
        let workspace = Workspace::new(&device, size).expect("there is memory");
        Some((device, workspace))
    }

    fn read_back(
        device: &Device,
        mut recorded: wgpu::CommandEncoder,
        buffer: &wgpu::Buffer,
        len_bytes: u64,
    ) -> Vec<u32> {
        let staging =
            device.buffer("staging", len_bytes, Usage::MAP_READ | Usage::COPY_DST).expect("there is memory");
        recorded.copy_buffer_to_buffer(buffer, 0, &staging, 0, len_bytes);
        let submission = device.queue.submit([recorded.finish()]);
        staging.map_async(wgpu::MapMode::Read, .., |_| {});
        device.wait(submission).expect("no error");
        let bytes = staging.get_mapped_range(..).expect("mapped");
        bytemuck::cast_slice::<u8, u32>(&bytes)[..(len_bytes / 4) as usize].to_vec()
    }

    /// 40 blocks of 2^27 pairs exceed 2^32: the total saturates at the largest number, which no buffer holds.
    #[test]
    fn counts_that_would_wrap_stay_at_the_largest() {
        let counts = Capacities { visible: 10_000, pairs: 1, entries: 1 };
        let Some((device, workspace)) = opened(counts) else { return };
        for (of_block, expected) in [(1 << 20, 40 << 20), (1 << 27, u32::MAX)] {
            let Buffers { counters, block_counts, .. } = &workspace.stages.buffers;
            let mut counts: Counts = Zeroable::zeroed();
            counts[Counter::Visible as usize] = 10_000;
            device.queue.write_buffer(counters, 0, bytemuck::bytes_of(&counts));
            device.queue.write_buffer(block_counts, 0, bytemuck::cast_slice(&[of_block; 40]));
            let mut encoder = device.device.create_command_encoder(&Default::default());
            let mut pass = encoder.begin_compute_pass(&Default::default());
            workspace.stages.scan(&device, &mut pass, Scan::Pairs);
            drop(pass);
            let counters = &workspace.stages.buffers.counters;
            let found = read_back(&device, encoder, counters, COUNTERS_BYTES)[Counter::Pairs as usize];
            assert_eq!(found, expected, "{of_block} a block");
        }
    }

    /// Sorts by (member, region) on device and host, at sizes around a workgroup's and a block's. Half of the keys
    /// repeat, which reveals an unstable sort.
    #[test]
    fn the_sort_is_stable_at_every_size() {
        let counts = Capacities { visible: 1, pairs: 1, entries: 70_000 };
        let Some((device, mut workspace)) = opened(counts) else { return };
        workspace.set_region_bits(&device, bits_of(300));
        for n in [0, 1, 2, 255, 256, 257, 2047, 2048, 2049, 4096, 70_000] {
            let key = |i: u32, salt: u32| (i ^ salt).wrapping_mul(0x9e37_79b9) >> 8;
            let entries: Vec<[u32; 4]> =
                (0..n).map(|i| [key(i / 2, 1) % 5000, key(i / 3, 2) % 300, i, 0]).collect();
            let mut counts: Counts = Zeroable::zeroed();
            counts[Counter::Entries as usize] = n;
            device.queue.write_buffer(&workspace.stages.buffers.counters, 0, bytemuck::bytes_of(&counts));
            device.queue.write_buffer(&workspace.stages.buffers.entries, 0, bytemuck::cast_slice(&entries));
            let mut encoder = device.device.create_command_encoder(&Default::default());
            let mut pass = encoder.begin_compute_pass(&Default::default());
            workspace.stages.scan(&device, &mut pass, Scan::Entries);
            let last = workspace.stages.sort(&device, &mut pass, (SortKey::MemberRegion, 32 + bits_of(300)));
            drop(pass);
            let order = &workspace.stages.buffers.entry_order[last];
            let found = read_back(&device, encoder, order, u64::from(n) * 4);
            let mut expected: Vec<u32> = (0..n).collect();
            expected.sort_by_key(|i| (entries[*i as usize][0], entries[*i as usize][1]));
            assert!(found == expected, "{n} items");
        }
    }
}
