//! Output values of a model, copied only where the processor cannot read the runtime's memory.

use std::fmt::Debug;
use std::ops::Deref;

use half::f16;
use ort::memory::AllocationDevice;
use ort::value::{DynTensor, PrimitiveTensorElementType, TensorElementType};

/// Output values: a copy, or the runtime's memory while this lives.
pub struct Floats(Memory);

enum Memory {
    Own(Vec<f32>),
    /// A tensor of f32 that [`read`] has read before.
    Runtime(DynTensor),
}

impl Floats {
    /// Shape and values of a tensor of f32 or f16.
    pub(crate) fn of(tensor: DynTensor) -> ort::Result<(Vec<i64>, Self)> {
        let shape = tensor.shape().to_vec();
        let memory = match tensor.data_type() {
            TensorElementType::Float16 => {
                Memory::Own(read::<f16>(&tensor)?.iter().map(|x| x.to_f32()).collect())
            }
            _ => {
                read::<f32>(&tensor)?;
                Memory::Runtime(tensor)
            }
        };
        Ok((shape, Self(memory)))
    }

    /// Copies values that the runtime holds.
    pub(crate) fn into_vec(self) -> Vec<f32> {
        match self.0 {
            Memory::Own(values) => values,
            Memory::Runtime(_) => self.to_vec(),
        }
    }
}

/// Values of a tensor in the processor's memory or in page-locked memory.
fn read<T: PrimitiveTensorElementType>(tensor: &DynTensor) -> ort::Result<&[T]> {
    match tensor.try_extract_tensor::<T>() {
        Ok((_, values)) => Ok(values),
        Err(refusal) => page_locked::read(tensor).ok_or(refusal),
    }
}

/// The same of u8, to be written.
pub(crate) fn bytes_mut(tensor: &mut DynTensor) -> ort::Result<&mut [u8]> {
    if page_locked::is_of::<u8>(tensor) {
        return Ok(page_locked::bytes_mut(tensor));
    }
    tensor.try_extract_tensor_mut::<u8>().map(|(_, values)| values)
}

#[expect(unsafe_code, reason = "the processor can reach page-locked memory, but ort sees a GPU's allocator")]
mod page_locked {
    use super::*;

    pub(super) fn is_of<T: PrimitiveTensorElementType>(tensor: &DynTensor) -> bool {
        tensor.memory_info().allocation_device() == AllocationDevice::CUDA_PINNED
            && *tensor.data_type() == T::into_tensor_element_type()
            && !tensor.data_ptr().is_null()
    }

    pub(super) fn read<T: PrimitiveTensorElementType>(tensor: &DynTensor) -> Option<&[T]> {
        let n = tensor.shape().num_elements();
        // SAFETY: cudaHostAlloc maps the memory for the processor, the runtime has allocated as many elements of T
        // as the shape says, and nothing writes to them while the tensor is borrowed: runs that fill it have
        // ended.
        is_of::<T>(tensor).then(|| unsafe { std::slice::from_raw_parts(tensor.data_ptr().cast::<T>(), n) })
    }

    /// `tensor` must be u8 in page-locked memory.
    pub(super) fn bytes_mut(tensor: &mut DynTensor) -> &mut [u8] {
        let n = tensor.shape().num_elements();
        // SAFETY: as above, and the tensor is borrowed mutably. The runtime copies bound inputs before it returns.
        unsafe { std::slice::from_raw_parts_mut(tensor.data_ptr_mut().cast::<u8>(), n) }
    }
}

impl Deref for Floats {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        match &self.0 {
            Memory::Own(values) => values,
            // Cannot fail: it was read when it was made.
            Memory::Runtime(tensor) => read(tensor).unwrap_or_default(),
        }
    }
}

impl From<Vec<f32>> for Floats {
    fn from(values: Vec<f32>) -> Self {
        Self(Memory::Own(values))
    }
}

impl Default for Floats {
    fn default() -> Self {
        Vec::new().into()
    }
}

impl Clone for Floats {
    fn clone(&self) -> Self {
        self.to_vec().into()
    }
}

impl Debug for Floats {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        (**self).fmt(f)
    }
}
