//! Matrices and vectors from safetensors files.

use std::path::Path;

use half::f16;
use safetensors::{Dtype, SafeTensors};

use crate::ModelError;

/// Reads tensor `name` as f32, row-major; `n_rows`: `None` for a vector `[dim]`, else of a matrix `[n_rows][dim]`.
pub fn read(path: &Path, name: &str, n_rows: Option<usize>, dim: usize) -> Result<Vec<f32>, ModelError> {
    let unfit = |fault: String| ModelError::at(path, fault);
    let bytes = fs_err::read(path).map_err(|cause| ModelError::unreadable(&cause))?;
    let tensors = SafeTensors::deserialize(&bytes);
    let tensors = tensors.map_err(|cause| unfit(format!("{cause}; fetch the file again")))?;
    let tensor = tensors.tensor(name).map_err(|_| {
        let mut found = tensors.names();
        found.sort();
        unfit(format!("no tensor {name:?}, it has {}; correct the description", found.join(", ")))
    })?;
    let expected = match n_rows {
        Some(n_rows) => vec![n_rows, dim],
        None => vec![dim],
    };
    let (dtype, found) = (tensor.dtype(), tensor.shape());
    let is_f16 = dtype == Dtype::F16;
    if found != expected || !(is_f16 || dtype == Dtype::F32) {
        return Err(unfit(format!(
            "tensor {name:?} is {dtype:?} {found:?}, expected F16 or F32 {expected:?}; correct the description, or \
             fetch its files again"
        )));
    }
    let values: Vec<f32> = if is_f16 {
        tensor.data().as_chunks().0.iter().map(|&b| f16::from_le_bytes(b).to_f32()).collect()
    } else {
        tensor.data().as_chunks().0.iter().map(|&b| f32::from_le_bytes(b)).collect()
    };
    match values.iter().position(|x| !x.is_finite()) {
        Some(index) => {
            Err(unfit(format!("tensor {name:?}: element {index} is not finite; fetch the file again")))
        }
        None => Ok(values),
    }
}
