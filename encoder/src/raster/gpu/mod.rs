//! The rasteriser on any GPU that wgpu knows (Vulkan, Metal, DX12).
//!
//! The stages are those of the CPU, each in a shader of the same name beside its twin. What leaves the
//! device is the sparse list of sums, sorted. Sums are whole numbers, and every order comes from a
//! stable sort, so a device gives the same bits each time.
//!
//! What is too large for a binding of the device is cut: the scene into chunks, the image into bands of
//! tile rows. Neither changes a sum, since tiles are independent and whole numbers add up exactly.

mod device;
mod layout;
mod shader;
mod workspace;

use std::sync::{Arc, Condvar, Mutex, PoisonError};

use glam::DVec3;
use slag_common::Gaussians;

use super::constants::TILE_SIZE_PX;
use super::{
    CpuRasterizer, Drawing, LoadedScene, RasterError, RasterView, Rasterizer, RegionWeight, StageTime,
    ViewWeights, WeightKind, check_regions, check_scene, check_view,
};
use crate::segment::RegionMap;
pub use device::{Adapter, AdapterReport, Device, adapters};
use layout::{Capacities, RegionSum, SceneGaussian, ViewBlock, screen_layout};
pub use shader::Precision;
use shader::{Counter, MAX_DISPATCH, TILE_FRACTION_BITS, WORKGROUP_SIZE};
use workspace::{SCENE_GAUSSIAN_BYTES, SceneChunk, Size, Workspace, band_size};

/// How a device is used.
#[derive(Clone, Copy, Debug)]
pub struct GpuOptions {
    /// Largest buffer, bytes; the device's own limit if larger.
    pub max_binding_bytes: u64,
    /// Bytes of the scene that stay on the device; the rest is uploaded for each view.
    pub max_resident_bytes: u64,
    /// Views worked on at once: while one is copied back, others compute.
    pub views_in_flight: usize,
}

impl Default for GpuOptions {
    fn default() -> Self {
        Self { max_binding_bytes: u64::MAX, max_resident_bytes: u64::MAX, views_in_flight: 3 }
    }
}

/// A GPU as a backend.
pub struct GpuRasterizer {
    device: Arc<Device>,
    options: GpuOptions,
}

impl GpuRasterizer {
    /// Uses an opened device.
    pub fn new(device: Device, options: GpuOptions) -> Self {
        Self { device: Arc::new(device), options }
    }

    /// Returns what the device is.
    pub fn report(&self) -> &AdapterReport {
        &self.device.report
    }

    /// Makes the device fail as a lost one does.
    #[doc(hidden)]
    pub fn lose(&self) {
        self.device.lose();
    }
}

impl Rasterizer for GpuRasterizer {
    fn load<'s>(&self, scene: &'s Gaussians) -> Result<Box<dyn LoadedScene + 's>, RasterError> {
        check_scene(scene)?;
        Ok(Box::new(GpuScene::new(Arc::clone(&self.device), self.options, scene)?))
    }
}

/// A scene on a device.
struct GpuScene<'s> {
    device: Arc<Device>,
    scene: &'s Gaussians,
    options: GpuOptions,
    max_binding_bytes: u64,
    /// Centre of the scene: means relative to it need fewer digits.
    origin_in_world: DVec3,
    n_unusable: usize,
    chunks: Vec<SceneChunk>,
    workspaces: Mutex<Pool>,
    returned: Condvar,
}

/// Workspaces that are not in use.
#[derive(Default)]
struct Pool {
    idle: Vec<Workspace>,
    n_made: usize,
}

/// Room that a workspace starts with; grown when a view needs more.
const FIRST_ROOM: u32 = 1 << 19;

impl<'s> GpuScene<'s> {
    fn new(device: Arc<Device>, options: GpuOptions, scene: &'s Gaussians) -> Result<Self, RasterError> {
        device.check()?;
        let usable: Vec<bool> = (0..scene.len()).map(|i| scene.is_usable(i)).collect();
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for (mean, _) in scene.means_in_world.iter().zip(&usable).filter(|(_, usable)| **usable) {
            (low, high) = (low.min(*mean), high.max(*mean));
        }
        let origin_in_world = if low.x <= high.x { low.midpoint(high) } else { DVec3::ZERO };
        let max_binding_bytes = options.max_binding_bytes.min(device.report.max_binding_bytes);
        let per_chunk = (max_binding_bytes / SCENE_GAUSSIAN_BYTES)
            .clamp(1, u64::from(MAX_DISPATCH) * u64::from(WORKGROUP_SIZE)) as usize;
        let mut loaded = Self {
            n_unusable: usable.iter().filter(|usable| !**usable).count(),
            device,
            scene,
            options,
            max_binding_bytes,
            origin_in_world,
            chunks: Vec::new(),
            workspaces: Mutex::default(),
            returned: Condvar::new(),
        };
        let mut resident_bytes = 0;
        let mut is_full = false;
        for first in (0..scene.len()).step_by(per_chunk) {
            let n = per_chunk.min(scene.len() - first);
            let mut chunk = SceneChunk::new(&loaded.device, first as u32, n as u32)
                .ok_or_else(|| loaded.device.error("no memory for the scene".into()))?;
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

    /// Copies Gaussians to the device; `None` where its memory is full.
    fn upload(&self, first: usize, n: usize) -> Option<wgpu::Buffer> {
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST;
        let buffer = self.device.buffer("Gaussians", n as u64 * SCENE_GAUSSIAN_BYTES, usage)?;
        // In pieces, so that the host holds little of the scene twice.
        const PIECE: usize = 1 << 16;
        for start in (0..n).step_by(PIECE) {
            let rows: Vec<SceneGaussian> = (start..(start + PIECE).min(n))
                .map(|i| SceneGaussian::new(self.scene, first + i, self.origin_in_world))
                .collect();
            let offset = start as u64 * SCENE_GAUSSIAN_BYTES;
            self.device.queue.write_buffer(&buffer, offset, bytemuck::cast_slice(&rows));
        }
        Some(buffer)
    }

    /// Returns the most elements of a size that one binding holds.
    fn max_elements(&self, bytes: u64) -> u32 {
        u32::try_from(self.max_binding_bytes / bytes).unwrap_or(u32::MAX)
    }

    /// Returns the most that a workspace may be made for.
    fn max_room(&self) -> Capacities {
        let (screen_bytes, _) = screen_layout(self.device.report.precision);
        Capacities {
            visible: self.max_elements(screen_bytes.into()),
            pairs: self.max_elements(8),
            entries: self.max_elements(size_of::<RegionSum>() as u64),
        }
    }

    fn take_workspace(&self) -> Option<Workspace> {
        let mut pool = self.workspaces.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            if let Some(workspace) = pool.idle.pop() {
                return Some(workspace);
            }
            if pool.n_made < self.options.views_in_flight.max(1) {
                pool.n_made += 1;
                return None;
            }
            pool = self.returned.wait(pool).unwrap_or_else(PoisonError::into_inner);
        }
    }

    fn return_workspace(&self, workspace: Option<Workspace>) {
        let mut pool = self.workspaces.lock().unwrap_or_else(PoisonError::into_inner);
        match workspace {
            Some(workspace) => pool.idle.push(workspace),
            None => pool.n_made -= 1,
        }
        self.returned.notify_one();
    }

    fn make_workspace(&self, room: Capacities, n_tiles: u32, n_px: u32) -> Result<Workspace, RasterError> {
        let n_chunk = self.chunks.iter().map(|c| c.n_gaussians).max().unwrap_or(0);
        Workspace::new(&self.device, Size { room, n_tiles, n_px, n_chunk })
            .ok_or_else(|| self.device.room_error(format!("no memory for {room:?}")))
    }

    /// Takes a view through the device, band by band.
    fn run_view(
        &self,
        workspace: &mut Option<Workspace>,
        view: &RasterView,
        regions: &RegionMap,
        kind: WeightKind,
        times: &mut Vec<StageTime>,
    ) -> Result<ViewWeights, RasterError> {
        let camera = &view.intrinsics;
        let tile = TILE_SIZE_PX as u32;
        let (width_px, height_px) = (camera.width_px, camera.height_px);
        let max = self.max_room();
        // Bands by pixels first; by what turns out to be in them below.
        let rows_of_band = (self.max_elements(4) / width_px / tile).clamp(1, MAX_DISPATCH);
        let n_rows = height_px.div_ceil(tile);
        let mut bands: Vec<[u32; 2]> = (0..n_rows.div_ceil(rows_of_band))
            .rev()
            .map(|i| [i * rows_of_band, ((i + 1) * rows_of_band).min(n_rows)])
            .collect();
        let mut weights = ViewWeights::default();
        weights.counters.unusable = self.n_unusable;
        let mut sums: Vec<RegionSum> = Vec::new();
        let mut n_bands = 0;
        while let Some(band) = bands.pop() {
            let (n_tiles, n_px) = band_size(width_px, height_px, band);
            let mut current = match workspace.take() {
                Some(current) if current.holds(n_tiles, n_px) => current,
                old => {
                    let room = old.as_ref().map_or_else(
                        || Capacities {
                            visible: FIRST_ROOM.min(self.scene.len().max(1) as u32).min(max.visible),
                            pairs: FIRST_ROOM.min(max.pairs),
                            entries: FIRST_ROOM.min(max.entries),
                        },
                        |old| old.room,
                    );
                    drop(old);
                    self.make_workspace(room, n_tiles, n_px)?
                }
            };
            let room = current.room;
            let block = ViewBlock::new(
                view,
                self.origin_in_world,
                band,
                kind == WeightKind::Falloff,
                regions.n_regions,
                room,
            );
            let first_px = (band[0] * tile * width_px) as usize;
            let of_band = &regions.region_of_pixel[first_px..first_px + n_px as usize];
            let upload = |index: usize| {
                let first = self.chunks[..index].iter().map(|c| c.n_gaussians as usize).sum();
                self.upload(first, self.chunks[index].n_gaussians as usize)
                    .ok_or_else(|| self.device.error("no memory for a part of the scene".into()))
            };
            let (counts, found) = current.run(&self.device, &self.chunks, &upload, &block, of_band, times)?;
            let count = |counter: Counter| counts[counter as usize];
            let needed = Capacities {
                visible: room.visible.max(count(Counter::Visible)),
                pairs: room.pairs.max(count(Counter::Pairs)),
                entries: room.entries.max(count(Counter::Entries)),
            };
            if needed == room {
                *workspace = Some(current);
                weights.counters.visible += count(Counter::FirstVisible) as usize;
                weights.counters.pairs += count(Counter::Pairs) as usize;
                weights.counters.unusable += count(Counter::Unrepresentable) as usize;
                sums.extend(found);
                n_bands += 1;
                continue;
            }
            drop(current);
            if needed.visible <= max.visible && needed.pairs <= max.pairs && needed.entries <= max.entries {
                // What counts for later stages is cut off with the first: a quarter more, and again.
                let grown = |needed: u32, now: u32, max: u32| {
                    if needed > now { needed.saturating_add(needed / 4).min(max) } else { now }
                };
                let room = Capacities {
                    visible: grown(needed.visible, room.visible, max.visible),
                    pairs: grown(needed.pairs, room.pairs, max.pairs),
                    entries: grown(needed.entries, room.entries, max.entries),
                };
                *workspace = Some(self.make_workspace(room, n_tiles, n_px)?);
                bands.push(band);
            } else if band[1] - band[0] > 1 {
                let middle = band[0].midpoint(band[1]);
                bands.extend([[middle, band[1]], [band[0], middle]]);
            } else {
                let what = format!("a row of tiles needs {needed:?}, the device holds {max:?}");
                return Err(self.device.room_error(what));
            }
        }
        if n_bands > 1 {
            sums.sort_unstable_by_key(|s| (s.gaussian, s.region));
        }
        let fixed = |s: &RegionSum| u64::from(s.high) << 32 | u64::from(s.low);
        weights.entries = sums
            .chunk_by(|a, b| (a.gaussian, a.region) == (b.gaussian, b.region))
            .map(|same| RegionWeight {
                gaussian: same[0].gaussian,
                region: same[0].region,
                weight: (same.iter().map(fixed).sum::<u64>() as f64 / f64::from(1u32 << TILE_FRACTION_BITS))
                    as f32,
            })
            .collect();
        Ok(weights)
    }
}

/// Regions of a view: a region and a pixel of its tile share a word.
const MAX_REGIONS: u32 = (1 << 24) - 1;

impl LoadedScene for GpuScene<'_> {
    fn weights(
        &self,
        view: &RasterView,
        regions: &RegionMap,
        kind: WeightKind,
    ) -> Result<ViewWeights, RasterError> {
        Ok(self.weights_timed(view, regions, kind)?.0)
    }

    fn weights_timed(
        &self,
        view: &RasterView,
        regions: &RegionMap,
        kind: WeightKind,
    ) -> Result<(ViewWeights, Vec<StageTime>), RasterError> {
        check_view(view)?;
        check_regions(regions, &view.intrinsics)?;
        if regions.n_regions > MAX_REGIONS {
            let what = format!("{} regions in a view, {MAX_REGIONS} at most", regions.n_regions);
            return Err(self.device.room_error(what));
        }
        if self.chunks.is_empty() {
            return Ok(Default::default());
        }
        let mut times = Vec::new();
        let mut workspace = self.take_workspace();
        let result = self.run_view(&mut workspace, view, regions, kind, &mut times);
        self.return_workspace(workspace);
        Ok((result?, times))
    }

    fn draw(&self, view: &RasterView, background: [f32; 3]) -> Result<Drawing, RasterError> {
        CpuRasterizer.load(self.scene)?.draw(view, background)
    }
}
