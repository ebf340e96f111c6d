//! The duration of each stage, measured by the device.

use wgpu::BufferUsages as Usage;

use super::device::Device;
use crate::raster::weights::StageTime;

/// Size of all timestamps, bytes.
pub const TIMESTAMPS_BYTES: u64 = 2 * 8 * STAGES.len() as u64;

/// Timed stages.
const STAGES: [&str; 5] = ["project", "sort", "bin", "blend", "compact"];

/// Timestamps at the start and end of each stage, if the device supports them.
pub struct GpuTimestamps {
    queries: Option<(wgpu::QuerySet, wgpu::Buffer)>,
    period_ns: f32,
    /// Whether passes are timed; each timestamp keeps the device from going on for a while.
    pub is_asked: bool,
}

impl GpuTimestamps {
    /// Creates the queries, if the device supports them; `None` if the memory does not suffice.
    pub fn new(device: &Device) -> Option<Self> {
        let n = 2 * STAGES.len() as u32;
        let queries = if device.device.features().contains(wgpu::Features::TIMESTAMP_QUERY) {
            let descriptor =
                wgpu::QuerySetDescriptor { label: None, ty: wgpu::QueryType::Timestamp, count: n };
            let usage = Usage::QUERY_RESOLVE | Usage::COPY_SRC;
            let resolved = device.buffer("timestamps", u64::from(n) * 8, usage)?;
            Some((device.device.create_query_set(&descriptor), resolved))
        } else {
            None
        };
        Some(Self { queries, period_ns: device.queue.get_timestamp_period(), is_asked: false })
    }

    fn asked(&self) -> Option<&(wgpu::QuerySet, wgpu::Buffer)> {
        self.queries.as_ref().filter(|_| self.is_asked)
    }

    /// Begins a pass of a stage. `ends` states whether it is the first and the last pass of the stage.
    pub fn pass<'e>(
        &self,
        encoder: &'e mut wgpu::CommandEncoder,
        stage: u32,
        ends: (bool, bool),
    ) -> wgpu::ComputePass<'e> {
        let timestamp_writes = self.asked().filter(|_| ends.0 || ends.1).map(|(query_set, _)| {
            wgpu::ComputePassTimestampWrites {
                query_set,
                beginning_of_pass_write_index: ends.0.then_some(2 * stage),
                end_of_pass_write_index: ends.1.then_some(2 * stage + 1),
            }
        });
        encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
            label: Some(STAGES[stage as usize]),
            timestamp_writes,
        })
    }

    /// Records the copy of the timestamps to `staging`.
    pub fn resolve(&self, encoder: &mut wgpu::CommandEncoder, staging: &wgpu::Buffer, offset: u64) {
        if let Some((queries, resolved)) = self.asked() {
            let n = 2 * STAGES.len() as u32;
            encoder.resolve_query_set(queries, 0..n, resolved, 0);
            encoder.copy_buffer_to_buffer(resolved, 0, staging, offset, u64::from(n) * 8);
        }
    }

    /// Converts the copied timestamps to the duration of each stage.
    pub fn read(&self, bytes: &[u8]) -> Vec<StageTime> {
        if self.asked().is_none() {
            return Vec::new();
        }
        let ticks = |i: usize| u64::from_le_bytes(bytes[8 * i..][..8].try_into().unwrap_or_default());
        let ms = |stage: usize| {
            ticks(2 * stage + 1).saturating_sub(ticks(2 * stage)) as f64 * f64::from(self.period_ns) * 1e-6
        };
        STAGES.iter().enumerate().map(|(i, stage)| StageTime { stage, ms: ms(i) }).collect()
    }
}
