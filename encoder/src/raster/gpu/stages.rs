//! The commands of each stage.

use std::collections::HashMap;

use wgpu::BufferUsages as Usage;

use super::buffers::Buffers;
use super::device::Device;
use super::jobs::{DIGIT_BITS, JOB_STRIDE_BYTES, Scan, SortKey, dispatch_offset, part, sort_job};
use super::layout::{Chunk, ScanJob, SceneGaussian};
use super::shader::{Counter, NONE, WORKGROUP_SIZE};

pub(crate) struct Stages {
    pub buffers: Buffers,
    groups: HashMap<(&'static str, u32), wgpu::BindGroup>,
}

impl Stages {
    pub fn new(buffers: Buffers) -> Self {
        Self { buffers, groups: HashMap::new() }
    }

    pub fn project(
        &self,
        device: &Device,
        pass: &mut wgpu::ComputePass<'_>,
        chunk: &SceneChunk,
        gaussians: &wgpu::Buffer,
    ) {
        let kernels = &device.kernels;
        let n_blocks = chunk.n_gaussians.div_ceil(WORKGROUP_SIZE);
        let chunk_job = part(&chunk.jobs, 0);
        let bound = [&self.buffers.view, &self.buffers.counters]
            .map(whole)
            .into_iter()
            .chain([chunk_job, whole(gaussians)]);
        let bound: Vec<_> = bound.chain([whole(&self.buffers.block_counts)]).collect();
        let group = bind(device, &kernels.count_visible, &number(&bound));
        dispatch(pass, &kernels.count_visible, &group, [n_blocks, 1]);
        let scan = [
            part(&chunk.jobs, 1),
            whole(&self.buffers.counters),
            whole(&self.buffers.block_counts),
            whole(&self.buffers.dispatches),
        ];
        let group = bind(device, &kernels.scan, &number(&scan));
        dispatch(pass, &kernels.scan, &group, [1, 1]);
        let bound = [
            (0, whole(&self.buffers.view)),
            (2, part(&chunk.jobs, 0)),
            (3, whole(gaussians)),
            (4, whole(&self.buffers.block_counts)),
            (5, whole(&self.buffers.screen)),
            (6, whole(&self.buffers.tile_counts)),
        ];
        let group = bind(device, &kernels.write_visible, &bound);
        dispatch(pass, &kernels.write_visible, &group, [n_blocks, 1]);
    }

    pub fn scan(&mut self, device: &Device, pass: &mut wgpu::ComputePass<'_>, scan: Scan) {
        let values = match scan {
            Scan::Digits(_) => &self.buffers.histogram,
            Scan::Pairs | Scan::Entries | Scan::Heads => &self.buffers.block_counts,
        };
        let bound = [
            part(&self.buffers.jobs, scan.index()),
            whole(&self.buffers.counters),
            whole(values),
            whole(&self.buffers.dispatches),
        ];
        let group = cached(&mut self.groups, ("scan", scan.index() as u32), || {
            bind(device, &device.kernels.scan, &number(&bound))
        });
        dispatch(pass, &device.kernels.scan, group, [1, 1]);
    }

    /// Sorts by a key of `bits` bits; returns the index of the buffer with the order.
    pub fn sort(
        &mut self,
        device: &Device,
        pass: &mut wgpu::ComputePass<'_>,
        (key, bits): (SortKey, u32),
    ) -> usize {
        let n_passes = bits.div_ceil(DIGIT_BITS).max(1);
        let kernels = &device.kernels;
        let offset = dispatch_offset(key.counter(), true);
        for digit in 0..n_passes {
            let (values, order) = match key {
                SortKey::Depth => (&self.buffers.screen, &self.buffers.visible_order),
                SortKey::Tile => (&self.buffers.pairs, &self.buffers.pair_order),
                SortKey::MemberRegion => (&self.buffers.entries, &self.buffers.entry_order),
            };
            let (from, to) = (digit as usize % 2, 1 - digit as usize % 2);
            let job = sort_job(key, digit);
            let bound = number(&[
                part(&self.buffers.jobs, job),
                whole(&self.buffers.counters),
                whole(values),
                whole(&order[from]),
                whole(&self.buffers.histogram),
                whole(&order[to]),
            ]);
            let [count, scatter] =
                [("count_digits", &kernels.count_digits, 5), ("scatter", &kernels.scatter, 6)].map(
                    |(name, kernel, n)| {
                        cached(&mut self.groups, (name, job as u32), || bind(device, kernel, &bound[..n]))
                            .clone()
                    },
                );
            dispatch_indirect(pass, &kernels.count_digits, &count, (&self.buffers.dispatches, offset));
            self.scan(device, pass, Scan::Digits(key.counter()));
            dispatch_indirect(pass, &kernels.scatter, &scatter, (&self.buffers.dispatches, offset));
        }
        n_passes as usize % 2
    }

    pub fn pair(&mut self, device: &Device, pass: &mut wgpu::ComputePass<'_>, depth_order: usize) {
        let offset = dispatch_offset(Counter::Visible, false);
        let order = &self.buffers.visible_order[depth_order];
        let counted = [
            (0, whole(&self.buffers.view)),
            (1, whole(&self.buffers.counters)),
            (3, whole(&self.buffers.tile_counts)),
            (4, whole(order)),
            (5, whole(&self.buffers.block_counts)),
        ];
        let written = [(2, whole(&self.buffers.screen)), (6, whole(&self.buffers.pairs))];
        let written: Vec<_> = counted.iter().chain(&written).cloned().collect();
        let kernels = &device.kernels;
        let key = depth_order as u32;
        let group =
            cached(&mut self.groups, ("count_pairs", key), || bind(device, &kernels.count_pairs, &counted));
        dispatch_indirect(pass, &kernels.count_pairs, group, (&self.buffers.dispatches, offset));
        let group =
            cached(&mut self.groups, ("write_pairs", key), || bind(device, &kernels.write_pairs, &written))
                .clone();
        self.scan(device, pass, Scan::Pairs);
        dispatch_indirect(pass, &kernels.write_pairs, &group, (&self.buffers.dispatches, offset));
    }

    pub(crate) fn find_ranges(
        &mut self,
        device: &Device,
        pass: &mut wgpu::ComputePass<'_>,
        pair_order: usize,
    ) {
        let bound = [
            (0, whole(&self.buffers.view)),
            (1, whole(&self.buffers.counters)),
            (4, whole(&self.buffers.pair_order[pair_order])),
            (7, whole(&self.buffers.pairs)),
            (8, whole(&self.buffers.ranges)),
            (9, whole(&self.buffers.members)),
        ];
        let kernel = &device.kernels.find_ranges;
        let group =
            cached(&mut self.groups, ("find_ranges", pair_order as u32), || bind(device, kernel, &bound));
        dispatch_indirect(
            pass,
            kernel,
            group,
            (&self.buffers.dispatches, dispatch_offset(Counter::Pairs, false)),
        );
        let bound = [
            (0, whole(&self.buffers.view)),
            (10, whole(&self.buffers.ranges)),
            (11, whole(&self.buffers.tile_order)),
        ];
        let kernel = &device.kernels.order_tiles;
        let group = cached(&mut self.groups, ("order_tiles", 0), || bind(device, kernel, &bound));
        dispatch(pass, kernel, group, [1, 1]);
    }

    pub(crate) fn blend(
        &mut self,
        device: &Device,
        pass: &mut wgpu::ComputePass<'_>,
        (columns, rows): (u32, u32),
    ) {
        let bound = [
            &self.buffers.view,
            &self.buffers.counters,
            &self.buffers.screen,
            &self.buffers.members,
            &self.buffers.ranges,
            &self.buffers.regions,
            &self.buffers.entries,
            &self.buffers.tile_order,
        ]
        .map(whole);
        let kernel = &device.kernels.sum_regions;
        let group = cached(&mut self.groups, ("sum_regions", 0), || bind(device, kernel, &number(&bound)));
        dispatch(pass, kernel, group, [columns, rows]);
        self.scan(device, pass, Scan::Entries);
    }

    pub fn compact(&mut self, device: &Device, pass: &mut wgpu::ComputePass<'_>, entry_order: usize) {
        let order = &self.buffers.entry_order[entry_order];
        let bound = [
            (0, whole(&self.buffers.view)),
            (1, whole(&self.buffers.counters)),
            (2, whole(&self.buffers.screen)),
            (3, whole(&self.buffers.entries)),
            (4, whole(order)),
            (5, whole(&self.buffers.block_counts)),
            (6, whole(&self.buffers.region_sums)),
        ];
        let kernels = &device.kernels;
        let offset = dispatch_offset(Counter::Entries, false);
        let key = entry_order as u32;
        let counted: Vec<_> = bound.iter().filter(|b| b.0 != 2).cloned().collect();
        let add_up =
            cached(&mut self.groups, ("add_up", key), || bind(device, &kernels.add_up, &bound)).clone();
        let group =
            cached(&mut self.groups, ("count_heads", key), || bind(device, &kernels.count_heads, &counted));
        dispatch_indirect(pass, &kernels.count_heads, group, (&self.buffers.dispatches, offset));
        self.scan(device, pass, Scan::Heads);
        dispatch_indirect(pass, &kernels.add_up, &add_up, (&self.buffers.dispatches, offset));
    }
}

pub fn whole(buffer: &wgpu::Buffer) -> wgpu::BufferBinding<'_> {
    buffer.as_entire_buffer_binding()
}

pub fn number<'a>(bindings: &[wgpu::BufferBinding<'a>]) -> Vec<(u32, wgpu::BufferBinding<'a>)> {
    (0..).zip(bindings.iter().cloned()).collect()
}

pub fn bind(
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

/// Returns the bind group of this name and number, creating it on first use.
pub(crate) fn cached<'g>(
    groups: &'g mut HashMap<(&'static str, u32), wgpu::BindGroup>,
    key: (&'static str, u32),
    make: impl FnOnce() -> wgpu::BindGroup,
) -> &'g wgpu::BindGroup {
    groups.entry(key).or_insert_with(make)
}

/// `n` workgroups, along x and y.
pub(crate) fn dispatch(
    pass: &mut wgpu::ComputePass<'_>,
    kernel: &wgpu::ComputePipeline,
    group: &wgpu::BindGroup,
    n: [u32; 2],
) {
    pass.set_pipeline(kernel);
    pass.set_bind_group(0, group, &[]);
    pass.dispatch_workgroups(n[0], n[1], 1);
}

/// With the number of workgroups from a buffer.
pub(crate) fn dispatch_indirect(
    pass: &mut wgpu::ComputePass<'_>,
    kernel: &wgpu::ComputePipeline,
    group: &wgpu::BindGroup,
    (sizes, offset): (&wgpu::Buffer, u64),
) {
    pass.set_pipeline(kernel);
    pass.set_bind_group(0, group, &[]);
    pass.dispatch_workgroups_indirect(sizes, offset);
}

pub(crate) const SCENE_GAUSSIAN_BYTES: u64 = size_of::<SceneGaussian>() as u64;

pub(crate) struct SceneChunk {
    pub n_gaussians: u32,
    /// The [`Chunk`] and the [`ScanJob`] of its blocks, [`JOB_STRIDE_BYTES`] apart.
    pub jobs: wgpu::Buffer,
    /// `None` if they are uploaded for each view.
    pub gaussians: Option<wgpu::Buffer>,
}

impl SceneChunk {
    /// Without the Gaussians; `None` if the memory does not suffice.
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
