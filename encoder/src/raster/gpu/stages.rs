//! The commands of each stage.

use std::cell::RefCell;
use std::collections::HashMap;

use wgpu::BufferUsages as Usage;

use super::device::Device;
use super::jobs::{Buffers, DIGIT_BITS, DISPATCH_BYTES, JOB_STRIDE_BYTES, Scan, SortKey, part, sort_job};
use super::layout::{Chunk, ScanJob, SceneGaussian};
use super::shader::{Counter, NONE, WORKGROUP_SIZE};

type Pass<'p> = wgpu::ComputePass<'p>;

/// Numbers of bindings, and what is bound.
type Bound<'b> = [(u32, wgpu::BufferBinding<'b>)];

/// How many workgroups run.
enum Groups {
    /// Along x and y.
    Given([u32; 2]),
    /// A thread for each item that shaders counted.
    OfItems(Counter),
    /// A workgroup for each sort block of them.
    OfBlocks(Counter),
}

pub(crate) struct Stages {
    pub buffers: Buffers,
    /// By kernel and number, made at first use.
    groups: RefCell<HashMap<(wgpu::ComputePipeline, u32), wgpu::BindGroup>>,
}

impl Stages {
    pub fn new(buffers: Buffers) -> Self {
        Self { buffers, groups: RefCell::default() }
    }

    /// `number`: tells bind groups of a kernel apart.
    fn run(
        &self,
        device: &Device,
        pass: &mut Pass<'_>,
        (kernel, number): (&wgpu::ComputePipeline, u32),
        bound: &Bound<'_>,
        groups: Groups,
    ) {
        let mut known = self.groups.borrow_mut();
        let group = known.entry((kernel.clone(), number)).or_insert_with(|| bind(device, kernel, bound));
        let (counter, by_block) = match groups {
            Groups::Given(n) => return dispatch(pass, kernel, group, n),
            Groups::OfItems(counter) => (counter, 0),
            Groups::OfBlocks(counter) => (counter, 1),
        };
        pass.set_pipeline(kernel);
        pass.set_bind_group(0, &*group, &[]);
        let offset = (counter as u64 * 2 + by_block) * DISPATCH_BYTES;
        pass.dispatch_workgroups_indirect(&self.buffers.dispatches, offset);
    }

    pub fn project(
        &self,
        device: &Device,
        pass: &mut Pass<'_>,
        chunk: &SceneChunk,
        gaussians: &wgpu::Buffer,
    ) {
        let kernels = &device.kernels;
        let Buffers { view, counters, dispatches, block_counts, screen, tile_counts, .. } = &self.buffers;
        let n_blocks = [chunk.n_gaussians.div_ceil(WORKGROUP_SIZE), 1];
        let job = || part(&chunk.jobs, 0);
        let mut run = |kernel: &wgpu::ComputePipeline, bound: &Bound<'_>, n| {
            dispatch(pass, kernel, &bind(device, kernel, bound), n);
        };
        let bound = [whole(view), whole(counters), job(), whole(gaussians), whole(block_counts)];
        run(&kernels.count_visible, &number(&bound), n_blocks);
        let bound = [part(&chunk.jobs, 1), whole(counters), whole(block_counts), whole(dispatches)];
        run(&kernels.scan, &number(&bound), [1, 1]);
        let bound = [
            (0, whole(view)),
            (2, job()),
            (3, whole(gaussians)),
            (4, whole(block_counts)),
            (5, whole(screen)),
            (6, whole(tile_counts)),
        ];
        run(&kernels.write_visible, &bound, n_blocks);
    }

    pub fn scan(&self, device: &Device, pass: &mut Pass<'_>, scan: Scan) {
        let Buffers { jobs, counters, dispatches, histogram, block_counts, .. } = &self.buffers;
        let values = match scan {
            Scan::Digits(_) => histogram,
            Scan::Pairs | Scan::Entries | Scan::Heads => block_counts,
        };
        let bound = [part(jobs, scan.index()), whole(counters), whole(values), whole(dispatches)];
        let kernel = (&device.kernels.scan, scan.index() as u32);
        self.run(device, pass, kernel, &number(&bound), Groups::Given([1, 1]));
    }

    /// Sorts by a key of `bits` bits; returns the index of the buffer with the order.
    pub fn sort(&self, device: &Device, pass: &mut Pass<'_>, (key, bits): (SortKey, u32)) -> usize {
        let n_passes = bits.div_ceil(DIGIT_BITS).max(1);
        let (kernels, buffers) = (&device.kernels, &self.buffers);
        let (values, order) = match key {
            SortKey::Depth => (&buffers.screen, &buffers.visible_order),
            SortKey::Tile => (&buffers.pairs, &buffers.pair_order),
            SortKey::MemberRegion => (&buffers.entries, &buffers.entry_order),
        };
        for digit in 0..n_passes {
            let (from, to) = (digit as usize % 2, 1 - digit as usize % 2);
            let job = sort_job(key, digit);
            let bound = number(&[
                part(&buffers.jobs, job),
                whole(&buffers.counters),
                whole(values),
                whole(&order[from]),
                whole(&buffers.histogram),
                whole(&order[to]),
            ]);
            let blocks = || Groups::OfBlocks(key.counter());
            self.run(device, pass, (&kernels.count_digits, job as u32), &bound[..5], blocks());
            self.scan(device, pass, Scan::Digits(key.counter()));
            self.run(device, pass, (&kernels.scatter, job as u32), &bound, blocks());
        }
        n_passes as usize % 2
    }

    pub fn pair(&self, device: &Device, pass: &mut Pass<'_>, depth_order: usize) {
        let (kernels, buffers) = (&device.kernels, &self.buffers);
        let bound = [
            (0, whole(&buffers.view)),
            (1, whole(&buffers.counters)),
            (3, whole(&buffers.tile_counts)),
            (4, whole(&buffers.visible_order[depth_order])),
            (5, whole(&buffers.block_counts)),
            (2, whole(&buffers.screen)),
            (6, whole(&buffers.pairs)),
        ];
        let (number, items) = (depth_order as u32, || Groups::OfItems(Counter::Visible));
        self.run(device, pass, (&kernels.count_pairs, number), &bound[..5], items());
        self.scan(device, pass, Scan::Pairs);
        self.run(device, pass, (&kernels.write_pairs, number), &bound, items());
    }

    pub(crate) fn find_ranges(&self, device: &Device, pass: &mut Pass<'_>, pair_order: usize) {
        let (kernels, buffers) = (&device.kernels, &self.buffers);
        let bound = [
            (0, whole(&buffers.view)),
            (1, whole(&buffers.counters)),
            (4, whole(&buffers.pair_order[pair_order])),
            (7, whole(&buffers.pairs)),
            (8, whole(&buffers.ranges)),
            (9, whole(&buffers.members)),
        ];
        let items = Groups::OfItems(Counter::Pairs);
        self.run(device, pass, (&kernels.find_ranges, pair_order as u32), &bound, items);
        let bound =
            [(0, whole(&buffers.view)), (10, whole(&buffers.ranges)), (11, whole(&buffers.tile_order))];
        self.run(device, pass, (&kernels.order_tiles, 0), &bound, Groups::Given([1, 1]));
    }

    pub(crate) fn blend(&self, device: &Device, pass: &mut Pass<'_>, tiles: [u32; 2]) {
        let Buffers { view, counters, screen, members, ranges, regions, entries, tile_order, .. } =
            &self.buffers;
        let bound = [view, counters, screen, members, ranges, regions, entries, tile_order].map(whole);
        self.run(device, pass, (&device.kernels.sum_regions, 0), &number(&bound), Groups::Given(tiles));
        self.scan(device, pass, Scan::Entries);
    }

    pub fn compact(&self, device: &Device, pass: &mut Pass<'_>, entry_order: usize) {
        let (kernels, buffers) = (&device.kernels, &self.buffers);
        let bound = [
            (2, whole(&buffers.screen)),
            (0, whole(&buffers.view)),
            (1, whole(&buffers.counters)),
            (3, whole(&buffers.entries)),
            (4, whole(&buffers.entry_order[entry_order])),
            (5, whole(&buffers.block_counts)),
            (6, whole(&buffers.region_sums)),
        ];
        let (number, items) = (entry_order as u32, || Groups::OfItems(Counter::Entries));
        self.run(device, pass, (&kernels.count_heads, number), &bound[1..], items());
        self.scan(device, pass, Scan::Heads);
        self.run(device, pass, (&kernels.add_up, number), &bound, items());
    }
}

pub fn whole(buffer: &wgpu::Buffer) -> wgpu::BufferBinding<'_> {
    buffer.as_entire_buffer_binding()
}

pub fn number<'a>(bindings: &[wgpu::BufferBinding<'a>]) -> Vec<(u32, wgpu::BufferBinding<'a>)> {
    (0..).zip(bindings.iter().cloned()).collect()
}

pub fn bind<'b>(device: &Device, kernel: &wgpu::ComputePipeline, bound: &Bound<'b>) -> wgpu::BindGroup {
    let entry = |(binding, buffer): &(u32, wgpu::BufferBinding<'b>)| {
        let resource = wgpu::BindingResource::Buffer(buffer.clone());
        wgpu::BindGroupEntry { binding: *binding, resource }
    };
    device.device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &kernel.get_bind_group_layout(0),
        entries: &bound.iter().map(entry).collect::<Vec<_>>(),
    })
}

/// `n` workgroups, along x and y.
pub(crate) fn dispatch(
    pass: &mut Pass<'_>,
    kernel: &wgpu::ComputePipeline,
    group: &wgpu::BindGroup,
    n: [u32; 2],
) {
    pass.set_pipeline(kernel);
    pass.set_bind_group(0, group, &[]);
    pass.dispatch_workgroups(n[0], n[1], 1);
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
