//! The parts of a scene that fit one binding each.

use wgpu::BufferUsages as Usage;

use super::device::Device;
use super::jobs::JOB_STRIDE_BYTES;
use super::layout::{Chunk, ScanJob, SceneGaussian};
use super::shader::{Counter, NONE, WORKGROUP_SIZE};

/// Size of a Gaussian in device memory, bytes.
pub(crate) const SCENE_GAUSSIAN_BYTES: u64 = size_of::<SceneGaussian>() as u64;

pub(crate) struct SceneChunk {
    pub n_gaussians: u32,
    /// The [`Chunk`] and the [`ScanJob`] of its blocks, [`JOB_STRIDE_BYTES`] apart.
    pub jobs: wgpu::Buffer,
    /// The Gaussians; `None` if they are uploaded for each view.
    pub gaussians: Option<wgpu::Buffer>,
}

impl SceneChunk {
    /// Creates the buffers of a chunk without its Gaussians; `None` if the memory does not suffice.
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
