//! Memory of a GPU, and that of the processor which it copies from and to.

use ort::memory::{AllocationDevice, Allocator, AllocatorType, MemoryInfo, MemoryType};
use ort::session::Session;
use ort::value::{DynTensor, TensorElementType};

use crate::floats::bytes_mut;

/// Memory of a GPU, and that of the processor which it copies from and to.
#[derive(Debug)]
pub(crate) struct DeviceMemory {
    pub(crate) device: MemoryInfo<'static>,
    /// Page-locked where the runtime offers it.
    pub(crate) host: MemoryInfo<'static>,
}

impl DeviceMemory {
    /// Returns the memory of an NVIDIA GPU that `session` runs on.
    pub(crate) fn of_gpu(session: &Session, gpu: u32) -> ort::Result<Self> {
        let gpu = i32::try_from(gpu).map_err(|_| ort::Error::new("there is no GPU of that number"))?;
        let device =
            MemoryInfo::new(AllocationDevice::CUDA, gpu, AllocatorType::Device, MemoryType::Default)?;
        let pinned = |id| {
            let info = MemoryInfo::new(
                AllocationDevice::CUDA_PINNED,
                id,
                AllocatorType::Device,
                MemoryType::CPUOutput,
            )
            .ok()?;
            Allocator::new(session, info.clone()).is_ok().then_some(info)
        };
        // Runtimes differ in the number under which they offer page-locked memory: the GPU's, or 0.
        let host = pinned(gpu).or_else(|| pinned(0)).unwrap_or_default();
        Ok(Self { device, host })
    }

    /// Returns the processor's memory for both.
    pub(crate) fn of_processor() -> Self {
        Self { device: MemoryInfo::default(), host: MemoryInfo::default() }
    }

    /// Returns a tensor of u8, zeros, in memory from which the GPU copies.
    pub(crate) fn bytes(&self, session: &Session, shape: &[i64]) -> ort::Result<DynTensor> {
        let allocator = Allocator::new(session, self.host.clone())?;
        let mut tensor = DynTensor::new(&allocator, TensorElementType::Uint8, shape.to_vec())?;
        bytes_mut(&mut tensor)?.fill(0);
        Ok(tensor)
    }
}
