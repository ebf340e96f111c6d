//! Descriptions of GPU adapters, and options of their use; also in builds without the GPU backend.

use serde::Serialize;

/// Precision of the projection on a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// As the reference has it.
    F64,
    /// Where the device has no more: Gaussians far from the image's centre, and needles, lose digits.
    F32,
}

/// What an adapter is.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct AdapterReport {
    /// Name of the device.
    pub name: String,
    /// Driver and its version.
    pub driver: String,
    /// Interface: Vulkan, Metal, Dx12.
    pub backend: String,
    /// `discrete`, `integrated`, `virtual`, `software` or `other`.
    pub kind: &'static str,
    /// Precision of the projection.
    pub precision: Precision,
    /// Largest piece of memory that a shader can see, bytes.
    pub max_binding_bytes: u64,
}

impl AdapterReport {
    /// Returns whether a software adapter (llvmpipe, WARP) does the work on the CPU.
    pub fn is_software(&self) -> bool {
        self.kind == "software"
    }
}

/// How a device is used.
#[derive(Clone, Copy, Debug)]
pub struct GpuOptions {
    /// Largest buffer, bytes; the device's own limit if larger.
    pub max_binding_bytes: u64,
    /// Bytes of the scene that stay on the device; the rest is uploaded for each view.
    pub max_resident_bytes: u64,
    /// Visible Gaussians, pairs and sums that there is room for at first; grown when a view needs more.
    pub first_room: u32,
    /// Views worked on at once: while one is copied back, others compute.
    pub views_in_flight: usize,
}

impl Default for GpuOptions {
    fn default() -> Self {
        Self {
            max_binding_bytes: u64::MAX,
            max_resident_bytes: u64::MAX,
            first_room: 1 << 19,
            views_in_flight: 3,
        }
    }
}
