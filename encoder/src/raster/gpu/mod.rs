//! The GPU backend, on wgpu (Vulkan, Metal, DX12).
//!
//! The stages are those of the CPU; each shader has the name of its CPU twin. The result is the sorted sparse list of
//! contributions: integers in the order of stable sorts, so a device gives the same bits each time.
//!
//! Data beyond a binding's limit is divided: the scene into chunks, the image into bands of tile rows. This changes no
//! contribution, because tiles are independent and integers add up exactly.

mod device;
mod jobs;
mod layout;
mod shader;
mod stages;
mod workspace;

use std::ops::Range;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use glam::DVec3;
use rayon::prelude::*;
use slag_common::Gaussians;
use slag_math::stats::{Rank, quantile};
use slag_raster::constants::TILE_SIZE_PX;
use slag_raster::{Drawing, RasterView, ViewCounters, check_scene, check_view, colour};

pub(crate) use super::AdapterReport;
use super::cpu::{CpuRasterizer, check_regions};
pub use super::{GpuOptions, Precision};
use super::{LoadedScene, RasterError, Rasterizer, RegionWeight, ViewWeights};
use crate::masks::RegionMap;
pub(crate) use device::Adapter;
pub use device::{Device, adapters};
use jobs::{REGION_BYTES, Size};
use layout::{Capacities, RegionSum, SceneGaussian, ViewBlock, screen_layout};
use shader::{Counter, Counts, MAX_CAPACITY, MAX_DISPATCH, REGION_BITS, WORKGROUP_SIZE};
use stages::{SCENE_GAUSSIAN_BYTES, SceneChunk};
use workspace::{Band, PIXEL_BYTES, Workspace, band_size};

pub struct GpuRasterizer {
    device: Arc<Device>,
    options: GpuOptions,
}

impl GpuRasterizer {
    pub fn new(device: Device, options: GpuOptions) -> Self {
        Self { device: Arc::new(device), options }
    }

    pub fn report(&self) -> &AdapterReport {
        &self.device.report
    }

    /// Fails like a lost device, for tests.
    #[doc(hidden)]
    pub fn lose(&self) {
        self.device.device.destroy();
    }
}

impl Rasterizer for GpuRasterizer {
    fn identity(&self) -> String {
        let AdapterReport { name, backend, precision, .. } = self.report();
        format!("{name} {backend} {precision:?}")
    }

    fn load<'s>(&self, scene: &'s Gaussians) -> Result<Box<dyn LoadedScene + 's>, RasterError> {
        check_scene(scene)?;
        Ok(Box::new(GpuScene::new(Arc::clone(&self.device), self.options, scene)?))
    }
}

struct GpuScene<'s> {
    device: Arc<Device>,
    scene: &'s Gaussians,
    max_binding_bytes: u64,
    /// Means relative to the scene's centre need fewer digits.
    origin_in_world: DVec3,
    n_unusable: usize,
    chunks: Vec<SceneChunk>,
    workspaces: Mutex<Pool>,
    returned: Condvar,
}

struct Pool {
    idle: Vec<Workspace>,
    n_made: usize,
    /// Most workspaces; fewer once the device's memory did not suffice.
    n_most: usize,
    /// For new workspaces: the largest that any view has needed so far.
    capacities: Capacities,
}

impl<'s> GpuScene<'s> {
    fn new(device: Arc<Device>, options: GpuOptions, scene: &'s Gaussians) -> Result<Self, RasterError> {
        device.check()?;
        let usable: Vec<bool> = (0..scene.len()).map(|i| scene.is_usable(i)).collect();
        let origin_in_world = middle(scene, &usable);
        // Buffer sizes are rounded up to 16 bytes.
        let max_binding_bytes = options.max_binding_bytes.min(device.report.max_binding_bytes) & !15;
        let per_chunk = (max_binding_bytes / SCENE_GAUSSIAN_BYTES)
            .clamp(1, u64::from(MAX_DISPATCH) * u64::from(WORKGROUP_SIZE)) as usize;
        let mut loaded = Self {
            n_unusable: usable.iter().filter(|usable| !**usable).count(),
            device,
            scene,
            max_binding_bytes,
            origin_in_world,
            chunks: Vec::new(),
            workspaces: Mutex::new(Pool {
                idle: Vec::new(),
                n_made: 0,
                n_most: options.views_in_flight.max(1),
                capacities: Capacities { visible: 0, pairs: 0, entries: 0 },
            }),
            returned: Condvar::new(),
        };
        let max = loaded.max_capacities();
        loaded.pool().capacities = Capacities {
            visible: options.first_capacity.min(scene.len().max(1) as u32).min(max.visible),
            pairs: options.first_capacity.min(max.pairs),
            entries: options.first_capacity.min(max.entries),
        };
        let mut resident_bytes = 0;
        let mut is_full = false;
        for first in (0..scene.len()).step_by(per_chunk) {
            let n = per_chunk.min(scene.len() - first);
            let mut chunk = SceneChunk::new(&loaded.device, first as u32, n as u32)
                .ok_or_else(|| loaded.device.error("out of memory for the scene".into()))?;
            resident_bytes += n as u64 * SCENE_GAUSSIAN_BYTES;
            is_full |= resident_bytes > options.max_resident_bytes;
            if !is_full {
                chunk.gaussians = loaded.upload(first, n);
                is_full = chunk.gaussians.is_none();
            }
            loaded.chunks.push(chunk);
        }
        loaded.device.check()?;
        Ok(loaded)
    }

    /// `None` if the device's memory does not suffice.
    fn upload(&self, first: usize, n: usize) -> Option<wgpu::Buffer> {
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST;
        let buffer = self.device.buffer("Gaussians", n as u64 * SCENE_GAUSSIAN_BYTES, usage)?;
        // Uploads pieces and waits for each, so that the host duplicates little of the scene, and the device's
        // host-visible memory, which may be only 256 MiB, suffices.
        const PIECE: usize = 1 << 18;
        for start in (0..n).step_by(PIECE) {
            let rows: Vec<SceneGaussian> = (start..(start + PIECE).min(n))
                .map(|i| SceneGaussian::new(self.scene, first + i, self.origin_in_world))
                .collect();
            let offset = start as u64 * SCENE_GAUSSIAN_BYTES;
            self.device.queue.write_buffer(&buffer, offset, bytemuck::cast_slice(&rows));
            let submission = self.device.queue.submit([]);
            self.device.wait(submission).ok()?;
        }
        Some(buffer)
    }

    fn max_elements(&self, bytes: u64) -> u32 {
        (self.max_binding_bytes / bytes).min(u64::from(MAX_CAPACITY)) as u32
    }

    fn max_capacities(&self) -> Capacities {
        let (screen_bytes, _) = screen_layout(self.device.report.precision);
        Capacities {
            visible: self.max_elements(screen_bytes.into()),
            pairs: self.max_elements(8),
            entries: self.max_elements(size_of::<RegionSum>() as u64),
        }
    }

    fn pool(&self) -> MutexGuard<'_, Pool> {
        self.workspaces.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn take_workspace(&self) -> Option<Workspace> {
        let mut pool = self.pool();
        loop {
            if let Some(workspace) = pool.idle.pop() {
                return Some(workspace);
            }
            if pool.n_made < pool.n_most {
                pool.n_made += 1;
                return None;
            }
            pool = self.returned.wait(pool).unwrap_or_else(PoisonError::into_inner);
        }
    }

    fn return_workspace(&self, workspace: Option<Workspace>) {
        let mut pool = self.pool();
        match workspace {
            Some(workspace) => pool.idle.push(workspace),
            None => pool.n_made -= 1,
        }
        self.returned.notify_one();
    }

    /// Gives up a workspace that did not fit the memory, unless it is the only one.
    fn give_up_workspace(&self) -> bool {
        let mut pool = self.pool();
        let is_one_of_several = pool.n_made > 1;
        if is_one_of_several {
            pool.n_made -= 1;
            pool.n_most = pool.n_made;
        }
        is_one_of_several
    }

    fn make_workspace(
        &self,
        capacities: Capacities,
        n_tiles: u32,
        n_px: u32,
    ) -> Result<Workspace, RasterError> {
        let n_chunk = self.chunks.iter().map(|c| c.n_gaussians).max().unwrap_or(0);
        Workspace::new(&self.device, Size { capacities, n_tiles, n_px, n_chunk })
            .ok_or_else(|| self.device.capacity_error(format!("out of memory for {capacities:?}")))
    }

    /// Takes a workspace for a band, or makes one; `None` if memory does not suffice but another view's may be tried.
    fn workspace_for(
        &self,
        workspace: &mut Option<Workspace>,
        n_tiles: u32,
        n_px: u32,
    ) -> Result<Option<Workspace>, RasterError> {
        if let Some(current) = workspace.take().filter(|current| current.holds(n_tiles, n_px)) {
            return Ok(Some(current));
        }
        let capacities = self.pool().capacities;
        match self.make_workspace(capacities, n_tiles, n_px) {
            Ok(made) => Ok(Some(made)),
            Err(_) if self.give_up_workspace() => {
                // Waits for another view's.
                *workspace = self.take_workspace();
                Ok(None)
            }
            Err(error) => Err(error),
        }
    }

    /// Processes a view band by band. `work` does a band in a workspace and returns its counts. If a count exceeds its
    /// capacity, the band is repeated with larger capacities, or in two halves.
    fn each_band(
        &self,
        view: &RasterView,
        px_bytes: u64,
        mut work: impl FnMut(&mut Workspace, &Band<'_>, Rows) -> Result<Counts, RasterError>,
    ) -> Result<ViewCounters, RasterError> {
        let mut lent = LentWorkspace { scene: self, workspace: self.take_workspace() };
        let workspace = &mut lent.workspace;
        let tile = TILE_SIZE_PX as u32;
        let (width_px, height_px) = (view.intrinsics.width_px, view.intrinsics.height_px);
        let max = self.max_capacities();
        // By pixels first; bands with too much content are divided again below.
        let rows_of_band = (self.max_elements(px_bytes) / width_px / tile).clamp(1, MAX_DISPATCH);
        let n_rows = height_px.div_ceil(tile);
        let mut bands: Vec<[u32; 2]> = (0..n_rows.div_ceil(rows_of_band))
            .rev()
            .map(|i| [i * rows_of_band, ((i + 1) * rows_of_band).min(n_rows)])
            .collect();
        let mut counters = ViewCounters { unusable: self.n_unusable, ..ViewCounters::default() };
        let upload = |index: usize| {
            let first = self.chunks[..index].iter().map(|c| c.n_gaussians as usize).sum();
            self.upload(first, self.chunks[index].n_gaussians as usize)
                .ok_or_else(|| self.device.capacity_error("out of memory for a chunk of the scene".into()))
        };
        while let Some([first, end]) = bands.pop() {
            let (n_tiles, n_px) = band_size(width_px, height_px, [first, end]);
            let Some(mut current) = self.workspace_for(workspace, n_tiles, n_px)? else {
                bands.push([first, end]);
                continue;
            };
            let capacities = current.capacities;
            let block = ViewBlock::new(view, self.origin_in_world, [first, end], capacities);
            let band = Band { device: &self.device, chunks: &self.chunks, upload: &upload, view: &block };
            let first_px = (first * tile * width_px) as usize;
            let rows = Rows { px: first_px..first_px + n_px as usize, is_whole: end - first == n_rows };
            let counts = work(&mut current, &band, rows)?;
            let needed = Capacities::needed(&counts);
            if capacities.hold(&needed) {
                let count = |counter: Counter| counts[counter as usize];
                *workspace = Some(current);
                counters.visible += count(Counter::FirstVisible) as usize;
                counters.pairs += count(Counter::Pairs) as usize;
                counters.unusable += count(Counter::Unrepresentable) as usize;
                continue;
            }
            drop(current);
            if max.hold(&needed) {
                self.pool().capacities = capacities.grown(&needed, &max);
                bands.push([first, end]);
            } else if end - first > 1 {
                let middle = first.midpoint(end);
                bands.extend([[middle, end], [first, middle]]);
            } else {
                let what = format!("a row of tiles needs {needed:?}, but the device allows {max:?}");
                return Err(self.device.capacity_error(what));
            }
        }
        Ok(counters)
    }

    fn colours(&self, view: &RasterView) -> Result<wgpu::Buffer, RasterError> {
        let position_in_world = view.camera_from_world.inverse().translation;
        let colours: Vec<[f32; 3]> = (0..self.scene.len())
            .into_par_iter()
            .map(|index| colour(self.scene, index, position_in_world))
            .collect();
        let no_memory = || self.device.capacity_error("out of memory for the colours of the scene".into());
        let bytes: &[u8] = bytemuck::cast_slice(&colours);
        if bytes.len() as u64 > self.max_binding_bytes {
            return Err(no_memory());
        }
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST;
        let buffer = self.device.buffer("colours", bytes.len() as u64, usage).ok_or_else(no_memory)?;
        self.device.queue.write_buffer(&buffer, 0, bytes);
        Ok(buffer)
    }
}

/// A robust centre of a scene: the median of a sample along each axis, rounded to the scene's scale so that most
/// differences to it are exact.
fn middle(scene: &Gaussians, usable: &[bool]) -> DVec3 {
    const N_SAMPLES: usize = 4096;
    let sample: Vec<DVec3> = (0..scene.len())
        .step_by(scene.len() / N_SAMPLES + 1)
        .filter(|i| usable[*i])
        .map(|i| scene.means_in_world[i])
        .collect();
    if sample.is_empty() {
        return DVec3::ZERO;
    }
    DVec3::from_array(std::array::from_fn(|axis| {
        let mut values: Vec<f64> = sample.iter().map(|mean| mean[axis]).collect();
        let mut at = |per_mille| quantile(&mut values, per_mille, Rank::Between).unwrap_or_default();
        let scale = (at(900) - at(100)).max(1e-6).log2().ceil().exp2();
        (at(500) / scale).round() * scale
    }))
}

/// A workspace, or its place, that goes back in any case; after a panic it may be half used.
struct LentWorkspace<'a, 's> {
    scene: &'a GpuScene<'s>,
    workspace: Option<Workspace>,
}

impl Drop for LentWorkspace<'_, '_> {
    fn drop(&mut self) {
        let workspace = self.workspace.take().filter(|_| !std::thread::panicking());
        self.scene.return_workspace(workspace);
    }
}

struct Rows {
    /// Row-major within the image.
    px: Range<usize>,
    is_whole: bool,
}

/// Most regions in a view; the next number stands for "no region".
const MAX_REGIONS: u32 = (1 << REGION_BITS) - 1;

impl LoadedScene for GpuScene<'_> {
    fn weights(&self, view: &RasterView, regions: &RegionMap) -> Result<ViewWeights, RasterError> {
        check_view(view)?;
        check_regions(regions, &view.intrinsics)?;
        if regions.n_regions > MAX_REGIONS {
            let what = format!("the view has {} regions, expected at most {MAX_REGIONS}", regions.n_regions);
            return Err(self.device.capacity_error(what));
        }
        if self.chunks.is_empty() {
            return Ok(Default::default());
        }
        let mut entries: Vec<RegionWeight> = Vec::new();
        let mut sums: Vec<RegionSum> = Vec::new();
        let counters = self.each_band(view, REGION_BYTES, |workspace, band, rows| {
            let mut take = |found: &[RegionSum]| match rows.is_whole {
                true => entries.extend(found.iter().map(|sum| sum.weight(sum.fixed()))),
                false => sums.extend(found),
            };
            workspace.contributions(band, &regions.region_of_pixel[rows.px], regions.n_regions, &mut take)
        })?;
        sums.sort_unstable_by_key(|sum| (sum.gaussian, sum.region));
        entries.extend(
            sums.chunk_by(|a, b| (a.gaussian, a.region) == (b.gaussian, b.region))
                .map(|same| same[0].weight(same.iter().map(RegionSum::fixed).sum())),
        );
        Ok(ViewWeights { entries, counters })
    }

    fn draw(&self, view: &RasterView, background: [f32; 3]) -> Result<Drawing, RasterError> {
        check_view(view)?;
        if self.chunks.is_empty() {
            return CpuRasterizer.load(self.scene)?.draw(view, background);
        }
        let colours = self.colours(view)?;
        let (width_px, height_px) = (view.intrinsics.width_px, view.intrinsics.height_px);
        let n_px = (width_px * height_px) as usize;
        let mut drawing = Drawing {
            width_px,
            height_px,
            rgb: vec![0.0; n_px * 3],
            depth: vec![0.0; n_px],
            coverage: vec![0.0; n_px],
            ..Drawing::default()
        };
        drawing.counters = self.each_band(view, PIXEL_BYTES, |workspace, band, rows| {
            let (counts, pixels) = workspace.draw(band, background, &colours)?;
            for (i, pixel) in rows.px.zip(pixels.chunks_exact(5)) {
                drawing.rgb[3 * i..][..3].copy_from_slice(&pixel[..3]);
                drawing.depth[i] = pixel[3];
                drawing.coverage[i] = pixel[4];
            }
            Ok(counts)
        })?;
        Ok(drawing)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The first GPU; `None` without one.
    pub(super) fn first_gpu() -> Option<Device> {
        let adapter = adapters().into_iter().next();
        if adapter.is_none() {
            println!("skipped: no GPU");
        }
        adapter.map(|adapter| adapter.open(adapter.report.precision).expect("opens"))
    }

    /// A panic in one view gives its place to the next, which would wait for ever otherwise.
    #[test]
    fn a_panic_gives_its_place_back() {
        let Some(device) = first_gpu() else { return };
        let device = Arc::new(device);
        let options = GpuOptions { views_in_flight: 1, ..GpuOptions::default() };
        let gaussians = Gaussians::default();
        let scene = GpuScene::new(device, options, &gaussians).expect("loads");
        let view = RasterView {
            camera_from_world: glam::DAffine3::IDENTITY,
            intrinsics: crate::raster::pinhole([16, 16], 16.0),
        };
        let panics = || scene.each_band(&view, REGION_BYTES, |_, _, _| panic!("a broken view"));
        std::panic::catch_unwind(std::panic::AssertUnwindSafe(panics)).expect_err("it panics");
        assert_eq!(scene.pool().n_made, 0);
        scene.each_band(&view, REGION_BYTES, |_, _, _| Ok(bytemuck::Zeroable::zeroed())).expect("goes on");
        assert_eq!(scene.pool().idle.len(), 1);
    }

    /// Three views and memory for one: the places of two are given up, and none is made anew.
    #[test]
    fn fewer_views_are_in_flight_where_memory_does_not_suffice() {
        let Some(device) = first_gpu() else { return };
        let device = Arc::new(device);
        let options = GpuOptions { views_in_flight: 3, ..GpuOptions::default() };
        let gaussians = Gaussians::default();
        let scene = GpuScene::new(device, options, &gaussians).expect("loads");
        (0..3).for_each(|_| assert!(scene.take_workspace().is_none(), "to be made"));
        assert_eq!([(); 3].map(|()| scene.give_up_workspace()), [true, true, false]);
        let counts = |pool: MutexGuard<'_, Pool>| (pool.n_made, pool.n_most);
        assert_eq!(counts(scene.pool()), (1, 1));
        let small = Capacities { visible: 1, pairs: 1, entries: 1 };
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| scene.take_workspace().is_some());
            scene.return_workspace(Some(scene.make_workspace(small, 1, 1).expect("there is memory")));
            let holds = waiting.join().expect("no panic");
            assert!(holds, "the view that waited has the one that was given back");
        });
    }
}
