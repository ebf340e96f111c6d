//! Runs a model with its tensors bound to memory: inputs of the next model stay on the GPU, and other outputs go to
//! page-locked memory, to which a GPU copies at the full speed of its link.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use ort::logging::LogLevel;
use ort::session::RunOptions;
use ort::value::{DynTensor, DynTensorValueType};

use crate::device_memory::DeviceMemory;
use crate::session::{Model, SessionError};

/// Where an output is left.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Place {
    /// In memory that the processor reads.
    Host,
    /// On the GPU, for the next model.
    Device,
}

/// Returns the turn of a GPU: whoever holds it runs a large model there. Several at once take no less time in all, and each
/// then ends late.
pub(crate) fn turn_of(gpu: u32) -> Arc<Mutex<()>> {
    static TURNS: Mutex<BTreeMap<u32, Arc<Mutex<()>>>> = Mutex::new(BTreeMap::new());
    let mut turns = TURNS.lock().unwrap_or_else(PoisonError::into_inner);
    Arc::clone(turns.entry(gpu).or_default())
}

impl Model {
    /// Runs the model on `inputs` and returns the given outputs, each where it is wanted. Other outputs are not computed.
    pub(crate) fn run_bound(
        &mut self,
        memory: &DeviceMemory,
        inputs: &[(&str, &DynTensor)],
        outputs: &[(&str, Place)],
    ) -> Result<Vec<DynTensor>, SessionError> {
        self.try_bound(memory, inputs, outputs).map_err(|cause| self.run_error(cause))
    }

    fn try_bound(
        &mut self,
        memory: &DeviceMemory,
        inputs: &[(&str, &DynTensor)],
        outputs: &[(&str, Place)],
    ) -> ort::Result<Vec<DynTensor>> {
        let session = self.session_mut();
        // A new binding each time: a bound output is otherwise overwritten by the next run, while its reader has it.
        let mut binding = session.create_binding()?;
        for (name, value) in inputs {
            binding.bind_input(*name, *value)?;
        }
        for (name, place) in outputs {
            let info = match place {
                Place::Host => &memory.host,
                Place::Device => &memory.device,
            };
            binding.bind_output_to_device(*name, info)?;
        }
        // The session's log level shows where nodes are placed; a run would tell of every node again.
        let mut quiet = RunOptions::new()?;
        quiet.set_log_level(LogLevel::Warning)?;
        let mut found = session.run_binding_with_options(&binding, &quiet)?;
        let absent = |name: &str| ort::Error::new(format!("output {name:?} is absent"));
        let take = |(name, _): &(&str, Place)| {
            found.remove(name).ok_or_else(|| absent(name))?.downcast::<DynTensorValueType>()
        };
        outputs.iter().map(take).collect()
    }
}
