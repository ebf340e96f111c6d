//! Progress on stderr: a bar with rate and ETA on a terminal, a plain line now and then otherwise.

use std::io::IsTerminal;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use crate::progress::{Progress, Silent};

/// Time between two plain lines.
const LINE_INTERVAL: Duration = Duration::from_secs(10);

/// Returns a receiver that shows progress on stderr, or one that discards it.
pub fn shown(is_shown: bool) -> Box<dyn Progress> {
    if is_shown { Box::new(Shown::new()) } else { Box::new(Silent) }
}

/// Shows progress to a person or writes it to a log.
pub struct Shown {
    terminal: bool,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    bar: Option<ProgressBar>,
    stage: String,
    total: u64,
    done: u64,
    first: u64,
    started: Option<Instant>,
    last_line: Option<Instant>,
}

impl Shown {
    /// Returns a receiver that draws bars if stderr is a terminal, else writes lines.
    fn new() -> Self {
        Self { terminal: std::io::stderr().is_terminal(), state: Mutex::default() }
    }

    fn state(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(|e| e.into_inner())
    }
}

impl Progress for Shown {
    fn begin(&self, stage: &str, unit: &str, total: u64, done: u64) {
        let mut state = self.state();
        let now = Some(Instant::now());
        *state =
            State { stage: stage.into(), total, done, first: done, started: now, last_line: now, bar: None };
        if self.terminal {
            let template =
                format!("{{prefix:>10}} [{{bar:32}}] {{pos}}/{{len}} {unit}s  {{per_sec}}  ETA {{eta}}");
            let style =
                ProgressStyle::with_template(&template).unwrap_or_else(|_| ProgressStyle::default_bar());
            let bar =
                ProgressBar::new(total).with_style(style.progress_chars("=> ")).with_prefix(stage.to_owned());
            bar.set_position(done);
            bar.reset_eta();
            bar.enable_steady_tick(Duration::from_millis(200));
            state.bar = Some(bar);
        } else {
            eprintln!("{stage}: {done} of {total}");
        }
    }

    fn advance(&self, n: u64) {
        let mut state = self.state();
        state.done += n;
        match &state.bar {
            Some(bar) => bar.inc(n),
            None if state.last_line.is_none_or(|t| t.elapsed() >= LINE_INTERVAL) => {
                let seconds = state.started.map_or(0.0, |t| t.elapsed().as_secs_f64());
                let rate = (state.done - state.first) as f64 / seconds.max(1e-9);
                let eta_secs = state.total.saturating_sub(state.done) as f64 / rate.max(1e-9);
                eprintln!(
                    "{}: {} of {}, {rate:.1}/s, ETA {eta_secs:.0} s",
                    state.stage, state.done, state.total
                );
                state.last_line = Some(Instant::now());
            }
            None => {}
        }
    }

    fn end(&self) {
        if let Some(bar) = self.state().bar.take() {
            bar.finish();
        }
    }
}
