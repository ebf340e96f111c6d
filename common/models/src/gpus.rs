//! The NVIDIA GPUs that models can run on.

use std::fmt;
use std::path::Path;
use std::str::FromStr;

use crate::levels::Levels;
use crate::placement::DeviceMemory;
use crate::preprocess::{Filter, Preprocess, Resize};
use crate::{Provider, SessionOptions};

/// Where Linux's driver lists a machine's GPUs.
const DRIVER_LIST: &str = "/proc/driver/nvidia/gpus";

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum GpuChoice {
    /// All that the runtime can use.
    #[default]
    All,
    /// As CUDA numbers them.
    Numbers(Vec<u32>),
}

impl GpuChoice {
    /// Numbers of the chosen GPUs, at least one; 0, without a meaning, where there is no NVIDIA provider.
    pub fn numbers(&self, options: &SessionOptions) -> Vec<u32> {
        match self {
            Self::Numbers(numbers) => numbers.clone(),
            Self::All => {
                let nvidia = |provider: &&Provider| matches!(provider, Provider::Cuda | Provider::TensorRt);
                let Some(provider) = options.providers.iter().find(nvidia) else { return vec![0] };
                // The runtime logs GPUs that do not open, so none is tried in vain.
                let listed = std::fs::read_dir(Path::new(DRIVER_LIST)).map_or(1, Iterator::count);
                let opens = |gpu: &u32| {
                    *gpu == 0
                        || Self::opens(
                            *gpu,
                            &SessionOptions { providers: vec![*provider], ..options.clone() },
                        )
                };
                (0..listed.max(1) as u32).take_while(opens).collect()
            }
        }
    }

    fn opens(gpu: u32, options: &SessionOptions) -> bool {
        let preprocess = Preprocess::new(1, Resize::Stretch, Filter::Bilinear, [0.0; 3], [1.0; 3]);
        let options = SessionOptions { gpu, ..options.clone() };
        Levels::open(1, &preprocess, false, &DeviceMemory::of_processor(), &options).is_ok()
    }
}

impl FromStr for GpuChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "all" {
            return Ok(Self::All);
        }
        let numbers: Option<Vec<u32>> = text.split(',').map(|number| number.trim().parse().ok()).collect();
        let wrong = || format!("{text:?}: expected all, or numbers of GPUs such as 0,1");
        let numbers = numbers.ok_or_else(wrong)?;
        let mut distinct = numbers.clone();
        distinct.sort_unstable();
        distinct.dedup();
        if distinct.len() == numbers.len() { Ok(Self::Numbers(numbers)) } else { Err(wrong()) }
    }
}

impl fmt::Display for GpuChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::All => f.write_str("all"),
            Self::Numbers(numbers) => {
                f.write_str(&numbers.iter().map(ToString::to_string).collect::<Vec<_>>().join(","))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn choices_are_read_back() {
        for text in ["all", "0", "1,0,3"] {
            assert_eq!(text.parse::<GpuChoice>().expect("a choice").to_string(), text);
        }
        for wrong in ["", "none", "0,,1", "1,1", "-1"] {
            assert!(wrong.parse::<GpuChoice>().is_err(), "{wrong}");
        }
        let on_cpu = SessionOptions::new("absent".into());
        assert_eq!(GpuChoice::All.numbers(&on_cpu), [0]);
        assert_eq!(GpuChoice::Numbers(vec![2, 1]).numbers(&on_cpu), [2, 1]);
    }
}
