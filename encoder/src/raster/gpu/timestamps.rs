//! The time of each stage by the device's own clock.

use wgpu::BufferUsages as Usage;

use super::device::Device;
use crate::raster::StageTime;

/// Bytes of all timestamps.
pub const TIMESTAMPS_BYTES: u64 = 2 * 8 * STAGES.len() as u64;

/// Stages that are timed.
const STAGES: [&str; 5] = ["project", "sort", "bin", "blend", "compact"];

/// The device's own clock at the ends of each stage, where it has one.
pub struct GpuTimestamps {
    queries: Option<(wgpu::QuerySet, wgpu::Buffer)>,
    period_ns: f32,
}

impl GpuTimestamps {
    /// Makes the queries where the device has a clock; `None` where memory is short.
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
        Some(Self { queries, period_ns: device.queue.get_timestamp_period() })
    }

    /// Begins a pass of a stage; `ends` says whether it is the stage's first and last.
    pub fn pass<'e>(
        &self,
        encoder: &'e mut wgpu::CommandEncoder,
        stage: u32,
        ends: (bool, bool),
    ) -> wgpu::ComputePass<'e> {
        let timestamp_writes = self.queries.as_ref().filter(|_| ends.0 || ends.1).map(|(query_set, _)| {
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

    /// Records the copy of what was measured to a place in `staging`.
    pub fn resolve(&self, encoder: &mut wgpu::CommandEncoder, staging: &wgpu::Buffer, offset: u64) {
        if let Some((queries, resolved)) = &self.queries {
            let n = 2 * STAGES.len() as u32;
            encoder.resolve_query_set(queries, 0..n, resolved, 0);
            encoder.copy_buffer_to_buffer(resolved, 0, staging, offset, u64::from(n) * 8);
        }
    }

    /// Returns the time of each stage from what was copied.
    pub fn read(&self, bytes: &[u8]) -> Vec<StageTime> {
        if self.queries.is_none() {
            return Vec::new();
        }
        let ticks = |i: usize| u64::from_le_bytes(bytes[8 * i..][..8].try_into().unwrap_or_default());
        let ms = |stage: usize| {
            ticks(2 * stage + 1).saturating_sub(ticks(2 * stage)) as f64 * f64::from(self.period_ns) * 1e-6
        };
        STAGES.iter().enumerate().map(|(i, stage)| StageTime { stage, ms: ms(i) }).collect()
    }
}
