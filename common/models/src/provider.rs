//! Execution providers: the devices that ONNX Runtime can run a model on.

use std::{fmt, str::FromStr};

use ort::{
    ep::{self, ExecutionProvider, ExecutionProviderDispatch, cuda::ConvAlgorithmSearch},
    session::builder::SessionBuilder,
};

/// A device that runs models, named as in ONNX Runtime.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Provider {
    #[default]
    Cpu,
    Cuda,
    /// An NVIDIA GPU through TensorRT, which compiles the model before the first run.
    TensorRt,
    CoreMl,
    /// Any GPU under Windows.
    DirectMl,
}

impl Provider {
    pub const ALL: [Self; 5] = [Self::Cpu, Self::Cuda, Self::TensorRt, Self::CoreMl, Self::DirectMl];

    /// In options and reports, in lower case.
    pub fn name(self) -> &'static str {
        match self {
            Self::Cpu => "cpu",
            Self::Cuda => "cuda",
            Self::TensorRt => "tensorrt",
            Self::CoreMl => "coreml",
            Self::DirectMl => "directml",
        }
    }

    pub(crate) fn runtime_name(self) -> &'static str {
        match self {
            Self::Cpu => ep::CPU::NAME,
            Self::Cuda => ep::CUDA::NAME,
            Self::TensorRt => ep::TensorRT::NAME,
            Self::CoreMl => ep::CoreML::NAME,
            Self::DirectMl => ep::DirectML::NAME,
        }
    }

    /// `gpu`: the NVIDIA GPU to use, as CUDA numbers them.
    pub(crate) fn register(self, builder: SessionBuilder, gpu: u32) -> ort::Result<SessionBuilder> {
        let gpu = i32::try_from(gpu).map_err(|_| ort::Error::new("there is no GPU of that number"))?;
        let (is_built_in, dispatch): (_, ExecutionProviderDispatch) = match self {
            Self::Cpu => return Ok(builder),
            Self::Cuda => (ep::CUDA::is_available()?, cuda(gpu).build()),
            Self::TensorRt => {
                (ep::TensorRT::is_available()?, ep::TensorRT::default().with_device_id(gpu).build())
            }
            Self::CoreMl => (ep::CoreML::is_available()?, ep::CoreML::default().build()),
            Self::DirectMl => (ep::DirectML::is_available()?, ep::DirectML::default().build()),
        };
        if !is_built_in {
            return Err(ort::Error::new("the library was built without it"));
        }
        // DirectML does not support memory patterns.
        let builder = match self {
            Self::DirectMl => builder.with_memory_pattern(false)?,
            _ => builder,
        };
        builder.with_execution_providers([dispatch.error_on_failure()]).map_err(ort::Error::<()>::from)
    }
}

/// Convolutions are chosen by rule, not by timing: always the same, and faster for CLIP's patches on an H100.
fn cuda(gpu: i32) -> ep::CUDA {
    ep::CUDA::default().with_device_id(gpu).with_conv_algorithm_search(ConvAlgorithmSearch::Heuristic)
}

impl fmt::Display for Provider {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

pub(crate) fn names(providers: &[Provider]) -> String {
    providers.iter().map(|provider| provider.name()).collect::<Vec<_>>().join(", ")
}

impl FromStr for Provider {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let known = Self::ALL.into_iter().find(|provider| provider.name() == name);
        let wrong = || format!("{name:?} is not an execution provider; use one of {}", names(&Self::ALL));
        known.ok_or_else(wrong)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_back() {
        for provider in Provider::ALL {
            assert_eq!(provider.name().parse::<Provider>().expect("known"), provider);
        }
        assert!("CUDA".parse::<Provider>().expect_err("case counts").contains("cuda, tensorrt"));
    }
}
