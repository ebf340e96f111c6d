//! Descriptions of GPU adapters, and options of their use; also in builds without the GPU backend.

use serde::Serialize;

#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// Double precision, like the reference.
    F64,
    /// Single precision, for devices without `f64`. Gaussians far from the image centre, and needles, lose digits.
    F32,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct AdapterReport {
    pub name: String,
    pub driver: String,
    /// Graphics interface: Vulkan, Metal, Dx12.
    pub backend: String,
    /// `discrete`, `integrated`, `virtual`, `software` or `other`.
    pub kind: &'static str,
    pub precision: Precision,
    /// Largest buffer that a shader can access, bytes.
    pub max_binding_bytes: u64,
}

impl AdapterReport {
    /// Software adapters (llvmpipe, WARP) run on the CPU.
    pub fn is_software(&self) -> bool {
        self.kind == "software"
    }
}

#[derive(Clone, Copy, Debug)]
pub struct GpuOptions {
    /// Largest buffer, bytes; the device's own limit applies as well.
    pub max_binding_bytes: u64,
    /// Most bytes of the scene that stay on the device; the rest is uploaded for each view.
    pub max_resident_bytes: u64,
    /// Initial capacity for visible Gaussians, pairs and contributions; grows as needed.
    pub first_capacity: u32,
    /// Concurrent views, fewer if the device's memory does not suffice: while one is copied back, others compute.
    pub views_in_flight: usize,
}

impl Default for GpuOptions {
    fn default() -> Self {
        Self {
            max_binding_bytes: u64::MAX,
            max_resident_bytes: u64::MAX,
            first_capacity: 1 << 19,
            views_in_flight: 12,
        }
    }
}
