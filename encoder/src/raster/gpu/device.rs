//! Adapters and opened devices.

use std::sync::{Arc, Mutex, PoisonError};

use pollster::block_on;

use super::shader::Kernels;
use crate::raster::{AdapterReport, Precision, RasterError};

fn report_of(adapter: &wgpu::Adapter) -> AdapterReport {
    let info = adapter.get_info();
    let has_f64 = adapter.features().contains(wgpu::Features::SHADER_F64);
    AdapterReport {
        name: info.name,
        driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
        backend: format!("{:?}", info.backend),
        kind: match info.device_type {
            wgpu::DeviceType::DiscreteGpu => "discrete",
            wgpu::DeviceType::IntegratedGpu => "integrated",
            wgpu::DeviceType::VirtualGpu => "virtual",
            wgpu::DeviceType::Cpu => "software",
            wgpu::DeviceType::Other => "other",
        },
        precision: if has_f64 { Precision::F64 } else { Precision::F32 },
        max_binding_bytes: adapter.limits().max_storage_buffer_binding_size,
    }
}

pub struct Adapter {
    pub report: AdapterReport,
    adapter: wgpu::Adapter,
}

/// Best kind first.
pub fn adapters() -> Vec<Adapter> {
    let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
    descriptor.backends = wgpu::Backends::PRIMARY;
    // Our shaders compute dispatch sizes within limits; validating them again would cost a pass each.
    descriptor.flags = wgpu::InstanceFlags::empty();
    let instance = wgpu::Instance::new(descriptor);
    let mut adapters: Vec<Adapter> = block_on(instance.enumerate_adapters(wgpu::Backends::PRIMARY))
        .into_iter()
        .map(|adapter| Adapter { report: report_of(&adapter), adapter })
        .collect();
    let rank =
        |kind| ["discrete", "integrated", "virtual", "other", "software"].iter().position(|k| *k == kind);
    adapters.sort_by_key(|a| rank(a.report.kind));
    adapters
}

pub struct Device {
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    pub(super) kernels: Kernels,
    /// With the precision in use.
    pub report: AdapterReport,
    /// First error; after it the device is no longer used.
    failure: Arc<Mutex<Option<String>>>,
}

impl Adapter {
    /// `precision` may be lower than the device's.
    pub fn open(&self, precision: Precision) -> Result<Device, RasterError> {
        let failed = |what: String| RasterError::Device { adapter: self.report.name.clone(), what };
        let limits = self.adapter.limits();
        // 256 threads and 32 KiB of workgroup memory: every desktop device has them.
        for (name, found, needed) in [
            ("threads of a workgroup", limits.max_compute_invocations_per_workgroup, 256),
            ("bytes of workgroup memory", limits.max_compute_workgroup_storage_size, 32 << 10),
            ("storage buffers of a shader", limits.max_storage_buffers_per_shader_stage, 8),
        ] {
            if found < needed {
                return Err(failed(format!("has {found} {name}, expected at least {needed}")));
            }
        }
        let mut features = wgpu::Features::empty();
        features.set(wgpu::Features::SHADER_F64, precision == Precision::F64);
        let (device, queue) = block_on(self.adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("slag"),
            required_features: features,
            required_limits: limits,
            ..Default::default()
        }))
        .map_err(|e| failed(e.to_string()))?;
        let failure = Arc::new(Mutex::new(None));
        let note = |failure: &Arc<Mutex<Option<String>>>| {
            let failure = Arc::clone(failure);
            move |what: String| {
                failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(what);
            }
        };
        let (note_error, note_loss) = (note(&failure), note(&failure));
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| note_error(error.to_string())));
        device.set_device_lost_callback(move |reason, what| note_loss(format!("lost ({reason:?}): {what}")));
        let kernels = Kernels::new(&device, precision);
        let opened = Device {
            device,
            queue,
            kernels,
            report: AdapterReport { precision, ..self.report.clone() },
            failure,
        };
        opened.check()?;
        Ok(opened)
    }
}

impl Device {
    pub(super) fn check(&self) -> Result<(), RasterError> {
        match &*self.failure.lock().unwrap_or_else(PoisonError::into_inner) {
            None => Ok(()),
            Some(what) => Err(self.error(what.clone())),
        }
    }

    pub(super) fn error(&self, what: String) -> RasterError {
        RasterError::Device { adapter: self.report.name.clone(), what }
    }

    pub(super) fn capacity_error(&self, what: String) -> RasterError {
        RasterError::DeviceCapacity { adapter: self.report.name.clone(), what }
    }

    /// Mapped if the host writes it; `None` if the device memory does not suffice.
    pub(super) fn buffer(
        &self,
        label: &str,
        size_bytes: u64,
        usage: wgpu::BufferUsages,
    ) -> Option<wgpu::Buffer> {
        let scope = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let descriptor = wgpu::BufferDescriptor {
            label: Some(label),
            size: size_bytes.next_multiple_of(16).max(256),
            usage,
            mapped_at_creation: usage.contains(wgpu::BufferUsages::MAP_WRITE),
        };
        let buffer = self.device.create_buffer(&descriptor);
        block_on(scope.pop()).is_none().then_some(buffer)
    }

    pub(super) fn wait(&self, submission: wgpu::SubmissionIndex) -> Result<(), RasterError> {
        let wait = wgpu::PollType::Wait { submission_index: Some(submission), timeout: None };
        let polled = self.device.poll(wait);
        // The failure's cause is more informative than that of the wait.
        self.check()?;
        polled.map_err(|e| self.error(e.to_string())).map(drop)
    }
}
