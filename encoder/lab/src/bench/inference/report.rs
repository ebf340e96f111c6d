//! The figures of `bench inference`.

use std::fmt;

use serde::Serialize;
use slag_models::Provider;

use crate::bench::machine::Machine;

/// The figures.
#[derive(Clone, Debug, Serialize)]
pub struct InferenceReport {
    /// The machine.
    pub machine: Machine,
    /// The providers asked for.
    pub providers: Vec<String>,
    /// Points per run of the decoder.
    pub points_per_batch: u32,
    /// The project's own figures.
    pub measured: Vec<Measured>,
    /// Other programs, on one GPU.
    pub rivals: Vec<Rival>,
}

/// A figure.
#[derive(Clone, Debug, Serialize)]
pub struct Measured {
    /// The work.
    pub what: String,
    /// The GPUs that did it.
    pub gpus: Vec<u32>,
    /// Crops or photos a second.
    pub per_sec: f64,
    /// Crops or photos done.
    pub n: usize,
    /// In this time.
    pub secs: f64,
    /// Share of the time in which each GPU had any lane at work.
    pub busy_shares: Vec<f64>,
    /// Share of the time in which each GPU ran kernels, by `nvidia-smi`; empty without it.
    pub kernel_shares: Vec<f64>,
}

/// A figure of another program.
#[derive(Clone, Debug, Serialize)]
pub struct Rival {
    /// The program and the work.
    pub what: String,
    /// Crops or photos a second.
    pub per_sec: f64,
}

impl InferenceReport {
    pub(super) fn new(machine: Machine, providers: &[Provider], points_per_batch: u32) -> Self {
        Self {
            machine,
            providers: providers.iter().map(ToString::to_string).collect(),
            points_per_batch,
            measured: Vec::new(),
            rivals: Vec::new(),
        }
    }
}

impl fmt::Display for InferenceReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let percents =
            |shares: &[f64]| shares.iter().map(|s| format!("{:.0}", 100.0 * s)).collect::<Vec<_>>().join(" ");
        writeln!(f, "{:<44}{:>6}{:>12}{:>10}{:>12}", "work", "GPUs", "a second", "busy %", "kernels %")?;
        for measured in &self.measured {
            let Measured { what, gpus, per_sec, busy_shares, kernel_shares, .. } = measured;
            let (busy, kernels) = (percents(busy_shares), percents(kernel_shares));
            writeln!(f, "{what:<44}{:>6}{per_sec:>12.2}{busy:>10}{kernels:>12}", gpus.len())?;
        }
        for Rival { what, per_sec } in &self.rivals {
            writeln!(f, "{what:<44}{:>6}{per_sec:>12.2}", 1)?;
        }
        Ok(())
    }
}
