//! The share of time in which a GPU ran kernels, as the driver measures it.

use std::io::Read;
use std::process::{Child, Command, Stdio};

/// A running `nvidia-smi`; without the program there are no figures.
pub(super) struct Kernels {
    child: Option<Child>,
    gpus: Vec<u32>,
}

impl Kernels {
    pub(super) fn start(gpus: &[u32]) -> Self {
        let query = ["--query-gpu=index,utilization.gpu", "--format=csv,noheader,nounits", "-lms", "200"];
        let child = Command::new("nvidia-smi")
            .args(query)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn();
        Self { child: child.ok(), gpus: gpus.to_vec() }
    }

    /// Ends the reading and returns the mean of each GPU, 0 to 1; none without figures.
    pub(super) fn shares(mut self) -> Vec<f64> {
        let Some(mut child) = self.child.take() else { return Vec::new() };
        let mut text = String::new();
        let _ = child.kill();
        if let Some(stdout) = &mut child.stdout {
            let _ = stdout.read_to_string(&mut text);
        }
        let _ = child.wait();
        self.gpus.iter().filter_map(|gpu| share(&text, *gpu)).collect()
    }
}

/// Returns the mean of a GPU's readings but the first, which looks back before the start.
fn share(text: &str, gpu: u32) -> Option<f64> {
    let reading = |line: &str| {
        let (index, percent) = line.split_once(',')?;
        let is_own = index.trim().parse() == Ok(gpu);
        is_own.then(|| percent.trim().parse::<f64>().ok())?
    };
    let readings: Vec<f64> = text.lines().filter_map(reading).skip(1).collect();
    (!readings.is_empty()).then(|| readings.iter().sum::<f64>() / readings.len() as f64 / 100.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn readings_are_averaged_by_gpu() {
        let text = "0, 10\n1, 0\n0, 90\n1, 40\n0, 100\n1, [N/A]\n0, 80\n1";
        assert_eq!((share(text, 0), share(text, 1), share(text, 2)), (Some(0.9), Some(0.4), None));
    }
}
