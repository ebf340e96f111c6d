//! Times a text model without the service's cache of recent texts.

use std::time::Instant;

use serde::Serialize;
use slag_models::{InferenceError, TextEncoder};

use super::machine::Machine;
use super::times::{Percentiles, Times};

/// Parameters of the measurement.
#[derive(Clone, Debug)]
pub struct TextSettings {
    /// The texts, each measured separately.
    pub texts: Vec<String>,
    /// Timed runs of each.
    pub n_runs: usize,
    /// Untimed runs of each text before the timed ones.
    pub n_warm_up: usize,
    /// Threads of the model.
    pub model_threads: usize,
}

/// Report of the measurement.
#[derive(Clone, Debug, Serialize)]
pub struct TextReport {
    /// The machine.
    pub machine: Machine,
    /// Load average of the last minute, including this program (Linux).
    pub load_1min: Option<f64>,
    /// Name of the model's space.
    pub model: String,
    /// The execution provider in use.
    pub runs_on: Option<String>,
    /// Threads of the model.
    pub model_threads: usize,
    /// Untimed runs of each text.
    pub n_warm_up: usize,
    /// Times by text.
    pub texts: Vec<TextTimes>,
}

/// Times of one text.
#[derive(Clone, Debug, Serialize)]
pub struct TextTimes {
    /// The text.
    pub text: String,
    /// Its times.
    pub times: Percentiles,
}

/// Encodes each text repeatedly.
///
/// # Errors
/// The model refuses a text or fails.
pub fn run(encoder: &mut dyn TextEncoder, settings: &TextSettings) -> Result<TextReport, InferenceError> {
    let mut texts = Vec::with_capacity(settings.texts.len());
    for text in &settings.texts {
        for _ in 0..settings.n_warm_up {
            encoder.encode(text)?;
        }
        let mut times = Times::default();
        for _ in 0..settings.n_runs {
            let start = Instant::now();
            encoder.encode(text)?;
            times.add(start.elapsed());
        }
        texts.push(TextTimes { text: text.clone(), times: times.percentiles() });
    }
    let load = fs_err::read_to_string("/proc/loadavg").unwrap_or_default();
    Ok(TextReport {
        machine: Machine::here(),
        load_1min: load.split(' ').next().and_then(|load| load.parse().ok()),
        model: encoder.name().to_owned(),
        runs_on: encoder.placement().map(ToString::to_string),
        model_threads: settings.model_threads,
        n_warm_up: settings.n_warm_up,
        texts,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Axes;

    #[test]
    fn every_run_reaches_the_model() {
        let mut encoder = Axes::new(3);
        let n_encoded = encoder.n_encoded();
        let texts = vec!["0".to_owned(), "2".to_owned()];
        let settings = TextSettings { texts, n_runs: 7, n_warm_up: 2, model_threads: 1 };
        let report = run(&mut encoder, &settings).expect("known texts");
        assert_eq!(n_encoded.load(std::sync::atomic::Ordering::SeqCst), 2 * (7 + 2));
        assert_eq!(report.texts.iter().map(|text| text.times.n).collect::<Vec<_>>(), [7, 7]);
        assert!(run(&mut encoder, &TextSettings { texts: vec!["sofa".into()], ..settings }).is_err());
    }
}
