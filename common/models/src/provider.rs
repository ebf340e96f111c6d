//! Execution providers: what ONNX Runtime runs a model on, as asked for, and as it turns out.

use std::{
    collections::BTreeMap,
    fmt,
    str::FromStr,
    sync::{Arc, Mutex, PoisonError},
};

use ort::{
    ep::{self, ExecutionProvider, ExecutionProviderDispatch},
    logging::LogLevel,
    session::builder::SessionBuilder,
};

use crate::session::forward_log;

/// What a model is run on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Provider {
    /// The processor.
    #[default]
    Cpu,
    /// An NVIDIA GPU.
    Cuda,
    /// An NVIDIA GPU through TensorRT, which compiles the model first.
    TensorRt,
    /// Apple's Core ML.
    CoreMl,
    /// Any GPU of Windows.
    DirectMl,
}

impl Provider {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Cpu, Self::Cuda, Self::TensorRt, Self::CoreMl, Self::DirectMl];

    /// Returns its name in lower case, as it is asked for and reported.
    pub fn name(self) -> &'static str {
        match self {
            Self::Cpu => "cpu",
            Self::Cuda => "cuda",
            Self::TensorRt => "tensorrt",
            Self::CoreMl => "coreml",
            Self::DirectMl => "directml",
        }
    }

    /// Returns its name within the runtime.
    fn runtime_name(self) -> &'static str {
        match self {
            Self::Cpu => ep::CPU::NAME,
            Self::Cuda => ep::CUDA::NAME,
            Self::TensorRt => ep::TensorRT::NAME,
            Self::CoreMl => ep::CoreML::NAME,
            Self::DirectMl => ep::DirectML::NAME,
        }
    }

    /// Has `builder` offer the model's nodes to it.
    pub(crate) fn register(self, builder: SessionBuilder) -> ort::Result<SessionBuilder> {
        let (is_built_in, dispatch): (_, ExecutionProviderDispatch) = match self {
            Self::Cpu => return Ok(builder),
            Self::Cuda => (ep::CUDA::is_available()?, ep::CUDA::default().build()),
            Self::TensorRt => (ep::TensorRT::is_available()?, ep::TensorRT::default().build()),
            Self::CoreMl => (ep::CoreML::is_available()?, ep::CoreML::default().build()),
            Self::DirectMl => (ep::DirectML::is_available()?, ep::DirectML::default().build()),
        };
        if !is_built_in {
            return Err(ort::Error::new("the library is built without it"));
        }
        // DirectML needs memory of which no pattern is recorded.
        let builder = match self {
            Self::DirectMl => builder.with_memory_pattern(false)?,
            _ => builder,
        };
        builder.with_execution_providers([dispatch.error_on_failure()]).map_err(ort::Error::<()>::from)
    }
}

impl fmt::Display for Provider {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Says that a name is no provider's.
#[derive(Debug, thiserror::Error)]
#[error("{found:?} is no execution provider; use one of cpu, cuda, tensorrt, coreml, directml")]
pub struct NoProvider {
    /// The name.
    found: String,
}

impl FromStr for Provider {
    type Err = NoProvider;

    fn from_str(name: &str) -> Result<Self, NoProvider> {
        let known = Self::ALL.into_iter().find(|provider| provider.name() == name);
        known.ok_or_else(|| NoProvider { found: name.to_owned() })
    }
}

/// What a model's nodes really run on.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Placement {
    provider: Provider,
    /// By the runtime's own names; empty where only the processor was asked for.
    nodes: BTreeMap<String, usize>,
}

impl Placement {
    /// Returns the first of what was asked for that runs any node, else the processor.
    pub fn provider(&self) -> Provider {
        self.provider
    }

    /// Returns this with [`Self::provider`] chosen among `asked`.
    pub(crate) fn of_asked(mut self, asked: &[Provider]) -> Self {
        let is_used = |provider: &Provider| self.nodes.contains_key(provider.runtime_name());
        self.provider = asked.iter().copied().find(is_used).unwrap_or_default();
        self
    }

    /// Takes in a message of the runtime, if it tells of nodes.
    fn hear(&mut self, message: &str) {
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

/// Listens to what the runtime tells of one session: it has no other way to say what runs where.
#[derive(Clone, Debug, Default)]
pub(crate) struct Listener(Arc<Mutex<Placement>>);

impl Listener {
    pub(crate) fn attach(&self, builder: SessionBuilder) -> ort::Result<SessionBuilder> {
        let placement = Arc::clone(&self.0);
        let hear = move |level: LogLevel, category: &str, id: &str, location: &str, message: &str| {
            placement.lock().unwrap_or_else(PoisonError::into_inner).hear(message);
            if !matches!(level, LogLevel::Info | LogLevel::Verbose) {
                forward_log(level, category, id, location, message);
            }
        };
        let builder = builder.with_logger(Arc::new(hear))?;
        builder.with_log_level(LogLevel::Verbose).map_err(ort::Error::<()>::from)
    }

    pub(crate) fn placement(&self) -> Placement {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Messages as ONNX Runtime 1.17 to 1.31 write them (`session_state.cc`).
    #[test]
    fn what_runs_is_what_took_nodes() {
        let cpu = Placement::default().of_asked(&[Provider::Cuda]);
        assert_eq!((cpu.to_string(), cpu.provider()), ("cpu".into(), Provider::Cpu));
        let mut placement = Placement::default();
        for message in [
            "Node placements",
            " Node(s) placed on [CPUExecutionProvider]. Number of nodes: 14",
            " Node(s) placed on [CUDAExecutionProvider]. Number of nodes: 212",
            " Node(s) placed on [NewExecutionProvider]. Number of nodes: many",
        ] {
            placement.hear(message);
        }
        assert_eq!(placement.to_string(), "cpu (14 nodes), cuda (212 nodes)");
        let asked = [Provider::TensorRt, Provider::Cuda, Provider::Cpu];
        assert_eq!(placement.of_asked(&asked).provider(), Provider::Cuda);
        let mut silent = Placement::default();
        silent.hear(" All nodes placed on [CPUExecutionProvider]. Number of nodes: 7");
        assert_eq!(silent.of_asked(&asked[..2]).provider(), Provider::Cpu);
    }

    #[test]
    fn names_are_read_back() {
        for provider in Provider::ALL {
            assert_eq!(provider.name().parse::<Provider>().expect("known"), provider);
        }
        assert!("CUDA".parse::<Provider>().expect_err("case counts").to_string().contains("cuda, tensorrt"));
    }
}
