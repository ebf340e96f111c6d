//! Runs a model with bound tensors: inputs of the next model stay on the GPU, other outputs go to page-locked
//! memory, to which a GPU copies at the full speed of its link.

use std::collections::BTreeMap;
use std::sync::{Arc, Condvar, Mutex, PoisonError};

use ort::logging::LogLevel;
use ort::session::RunOptions;
use ort::value::{DynTensor, DynTensorValueType};

use crate::ModelError;
use crate::placement::DeviceMemory;
use crate::session::Model;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Place {
    /// In memory that the processor reads.
    Host,
    /// On the GPU, for the next model.
    Device,
}

/// Concurrent runs per GPU: the second fills the gaps around the first; more only end later.
const RUNS_AT_ONCE: usize = 2;

/// Permits to run a large model on a GPU.
#[derive(Debug)]
pub(crate) struct Turns {
    n_free: Mutex<usize>,
    is_free: Condvar,
}

pub(crate) struct Turn<'a>(&'a Turns);

impl Turns {
    /// `gpu`: as CUDA numbers them.
    pub(crate) fn of(gpu: u32) -> Arc<Self> {
        static TURNS: Mutex<BTreeMap<u32, Arc<Turns>>> = Mutex::new(BTreeMap::new());
        let mut turns = TURNS.lock().unwrap_or_else(PoisonError::into_inner);
        let all_free = || Arc::new(Self { n_free: Mutex::new(RUNS_AT_ONCE), is_free: Condvar::new() });
        Arc::clone(turns.entry(gpu).or_insert_with(all_free))
    }

    pub(crate) fn take(&self) -> Turn<'_> {
        let n_free = self.n_free.lock().unwrap_or_else(PoisonError::into_inner);
        let free = self.is_free.wait_while(n_free, |n_free| *n_free == 0);
        *free.unwrap_or_else(PoisonError::into_inner) -= 1;
        Turn(self)
    }
}

impl Drop for Turn<'_> {
    fn drop(&mut self) {
        *self.0.n_free.lock().unwrap_or_else(PoisonError::into_inner) += 1;
        self.0.is_free.notify_one();
    }
}

impl Model {
    /// Runs the model and returns the given outputs, each in its place; other outputs are not computed.
    pub(crate) fn run_bound(
        &mut self,
        memory: &DeviceMemory,
        inputs: &[(&str, &DynTensor)],
        outputs: &[(&str, Place)],
    ) -> Result<Vec<DynTensor>, ModelError> {
        self.try_bound(memory, inputs, outputs).map_err(|cause| self.run_error(cause))
    }

    fn try_bound(
        &mut self,
        memory: &DeviceMemory,
        inputs: &[(&str, &DynTensor)],
        outputs: &[(&str, Place)],
    ) -> ort::Result<Vec<DynTensor>> {
        let session = &mut self.session;
        // A new binding each time: the next run would overwrite a bound output while its reader has it.
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
        // The session's log level reports the placement of nodes; each run would report it again.
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

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    /// Eight threads share a GPU: never more than two run at once, and two do meet.
    #[test]
    fn a_gpu_has_two_turns() {
        let (turns, other) = (Turns::of(97), Turns::of(98));
        let (n_now, most) = (AtomicUsize::new(0), AtomicUsize::new(0));
        std::thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(|| {
                    for _ in 0..20 {
                        let _turn = turns.take();
                        most.fetch_max(n_now.fetch_add(1, Ordering::SeqCst) + 1, Ordering::SeqCst);
                        std::thread::sleep(std::time::Duration::from_micros(200));
                        n_now.fetch_sub(1, Ordering::SeqCst);
                    }
                });
            }
        });
        assert_eq!(most.into_inner(), RUNS_AT_ONCE);
        let _held = [turns.take(), turns.take()];
        drop(other.take());
    }
}
