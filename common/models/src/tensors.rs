//! Matrices and vectors from safetensors files.

use std::path::{Path, PathBuf};

use half::f16;
use safetensors::{Dtype, SafeTensors};

#[derive(Debug, thiserror::Error)]
pub enum TensorsError {
    #[error("{cause}; put the file there or correct the description")]
    Read { cause: std::io::Error },
    #[error("{}: {cause}; fetch the file again", path.display())]
    Format { path: PathBuf, cause: safetensors::SafeTensorError },
    #[error("{}: no tensor {name:?}, it has {}; correct the description", path.display(), found.join(", "))]
    Missing { path: PathBuf, name: String, found: Vec<String> },
    #[error("{}: tensor {name:?} is {dtype:?} {found:?}, expected F16 or F32 {expected}; correct the description, or fetch its files again", path.display())]
    Shape { path: PathBuf, name: String, dtype: Dtype, found: Vec<usize>, expected: String },
    #[error("{}: tensor {name:?}: element {index} is not finite; fetch the file again", path.display())]
    NotFinite {
        path: PathBuf,
        name: String,
        /// Row-major.
        index: usize,
    },
}

/// Reads tensor `name` as f32, row-major; `n_rows`: `None` for a vector `[dim]`, else of a matrix `[n_rows][dim]`.
pub fn read(path: &Path, name: &str, n_rows: Option<usize>, dim: usize) -> Result<Vec<f32>, TensorsError> {
    let bytes = fs_err::read(path).map_err(|cause| TensorsError::Read { cause })?;
    let tensors = SafeTensors::deserialize(&bytes)
        .map_err(|cause| TensorsError::Format { path: path.to_owned(), cause })?;
    let tensor = tensors.tensor(name).map_err(|_| {
        let mut found: Vec<_> = tensors.names().into_iter().map(str::to_owned).collect();
        found.sort();
        TensorsError::Missing { path: path.to_owned(), name: name.to_owned(), found }
    })?;
    let expected = match n_rows {
        Some(n_rows) => vec![n_rows, dim],
        None => vec![dim],
    };
    let is_f16 = tensor.dtype() == Dtype::F16;
    if tensor.shape() != expected || !(is_f16 || tensor.dtype() == Dtype::F32) {
        return Err(TensorsError::Shape {
            path: path.to_owned(),
            name: name.to_owned(),
            dtype: tensor.dtype(),
            found: tensor.shape().to_vec(),
            expected: format!("{expected:?}"),
        });
    }
    let values: Vec<f32> = if is_f16 {
        tensor.data().as_chunks().0.iter().map(|&b| f16::from_le_bytes(b).to_f32()).collect()
    } else {
        tensor.data().as_chunks().0.iter().map(|&b| f32::from_le_bytes(b)).collect()
    };
    match values.iter().position(|x| !x.is_finite()) {
        Some(index) => Err(TensorsError::NotFinite { path: path.to_owned(), name: name.to_owned(), index }),
        None => Ok(values),
    }
}
