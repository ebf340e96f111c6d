//! Providers that run a model's nodes, read from ONNX Runtime's log.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

use ort::logging::LogLevel;
use ort::memory::{AllocationDevice, Allocator, AllocatorType, MemoryInfo, MemoryType};
use ort::session::Session;
use ort::session::builder::SessionBuilder;
use ort::value::{DynTensor, TensorElementType};

use crate::floats::bytes_mut;
use crate::provider::Provider;

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Placement {
    provider: Provider,
    /// Nodes by the runtime's provider name; empty if only the CPU was requested.
    nodes: BTreeMap<String, usize>,
}

impl Placement {
    /// The first requested provider that runs a node, else the CPU.
    pub fn provider(&self) -> Provider {
        self.provider
    }

    /// Chooses [`Self::provider`] among `asked`.
    pub(crate) fn of_asked(mut self, asked: &[Provider]) -> Self {
        let is_used = |provider: &Provider| self.nodes.contains_key(provider.runtime_name());
        self.provider = asked.iter().copied().find(is_used).unwrap_or_default();
        self
    }

    /// Records the placement in a log message of the runtime; ignores other messages.
    fn record(&mut self, message: &str) {
        let placed = || {
            let (_, placed) = message.split_once("placed on [")?;
            let (name, rest) = placed.split_once("]. Number of nodes: ")?;
            Some((name.to_owned(), rest.trim().parse().ok()?))
        };
        self.nodes.extend(placed());
    }
}

impl fmt::Display for Placement {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.nodes.is_empty() {
            return f.write_str(Provider::Cpu.name());
        }
        for (i, (name, n)) in self.nodes.iter().enumerate() {
            let known = Provider::ALL.into_iter().find(|provider| provider.runtime_name() == name);
            let separator = if i == 0 { "" } else { ", " };
            write!(f, "{separator}{} ({n} nodes)", known.map_or(name.as_str(), |provider| provider.name()))?;
        }
        Ok(())
    }
}

/// Collects the placement from a session's log; the runtime reports it nowhere else.
#[derive(Clone, Debug, Default)]
pub(crate) struct Listener(Arc<Mutex<Placement>>);

impl Listener {
    pub(crate) fn attach(&self, builder: SessionBuilder) -> ort::Result<SessionBuilder> {
        let placement = Arc::clone(&self.0);
        let record = move |level: LogLevel, category: &str, id: &str, location: &str, message: &str| {
            placement.lock().unwrap_or_else(PoisonError::into_inner).record(message);
            if !matches!(level, LogLevel::Info | LogLevel::Verbose) {
                forward_log(level, category, id, location, message);
            }
        };
        let builder = builder.with_logger(Arc::new(record))?;
        builder.with_log_level(LogLevel::Verbose).map_err(ort::Error::<()>::from)
    }

    pub(crate) fn placement(&self) -> Placement {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

/// Forwards the runtime's messages, which it would print, to `tracing`.
pub(crate) fn forward_log(level: LogLevel, category: &str, _id: &str, _location: &str, message: &str) {
    match level {
        LogLevel::Error | LogLevel::Fatal => tracing::error!(category, "ONNX Runtime: {message}"),
        LogLevel::Warning => tracing::warn!(category, "ONNX Runtime: {message}"),
        LogLevel::Info | LogLevel::Verbose => tracing::debug!(category, "ONNX Runtime: {message}"),
    }
}

/// Memory of a GPU, and host memory for its copies.
#[derive(Debug)]
pub(crate) struct DeviceMemory {
    pub(crate) device: MemoryInfo<'static>,
    /// Page-locked where the runtime offers it.
    pub(crate) host: MemoryInfo<'static>,
}

impl DeviceMemory {
    /// Memory of the NVIDIA GPU that runs `session`.
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
        // Runtimes offer page-locked memory under the GPU's number or under 0.
        let host = pinned(gpu).or_else(|| pinned(0)).unwrap_or_default();
        Ok(Self { device, host })
    }

    pub(crate) fn of_processor() -> Self {
        Self { device: MemoryInfo::default(), host: MemoryInfo::default() }
    }

    /// A tensor of u8, zeros, in memory from which the GPU copies.
    pub(crate) fn bytes(&self, session: &Session, shape: &[i64]) -> ort::Result<DynTensor> {
        let allocator = Allocator::new(session, self.host.clone())?;
        let mut tensor = DynTensor::new(&allocator, TensorElementType::Uint8, shape.to_vec())?;
        bytes_mut(&mut tensor)?.fill(0);
        Ok(tensor)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Wording of ONNX Runtime 1.17 to 1.31 (`session_state.cc`).
    #[test]
    fn placement_is_read_from_the_log() {
        let cpu = Placement::default().of_asked(&[Provider::Cuda]);
        assert_eq!((cpu.to_string(), cpu.provider()), ("cpu".into(), Provider::Cpu));
        let mut placement = Placement::default();
        for message in [
            "Node placements",
            " Node(s) placed on [CPUExecutionProvider]. Number of nodes: 14",
            " Node(s) placed on [CUDAExecutionProvider]. Number of nodes: 212",
            " Node(s) placed on [NewExecutionProvider]. Number of nodes: many",
        ] {
            placement.record(message);
        }
        assert_eq!(placement.to_string(), "cpu (14 nodes), cuda (212 nodes)");
        let asked = [Provider::TensorRt, Provider::Cuda, Provider::Cpu];
        assert_eq!(placement.of_asked(&asked).provider(), Provider::Cuda);
        let mut silent = Placement::default();
        silent.record(" All nodes placed on [CPUExecutionProvider]. Number of nodes: 7");
        assert_eq!(silent.of_asked(&asked[..2]).provider(), Provider::Cpu);
    }
}
