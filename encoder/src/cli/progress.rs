//! Progress on stderr: a bar with rate and ETA on a terminal, a plain line now and then otherwise.

use std::io::IsTerminal;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use slag_common::note;

use crate::progress::{Progress, Silent};

const LINE_INTERVAL: Duration = Duration::from_secs(10);

pub fn shown(is_shown: bool) -> Box<dyn Progress> {
    let terminal = std::io::stderr().is_terminal();
    if is_shown { Box::new(TerminalProgress { terminal, stage: Mutex::default() }) } else { Box::new(Silent) }
}

struct TerminalProgress {
    terminal: bool,
    stage: Mutex<Stage>,
}

#[derive(Default)]
struct Stage {
    bar: Option<ProgressBar>,
    name: String,
    total: u64,
    done: u64,
    first: u64,
    started: Option<Instant>,
    last_line: Option<Instant>,
}

impl TerminalProgress {
    fn stage(&self) -> std::sync::MutexGuard<'_, Stage> {
        self.stage.lock().unwrap_or_else(|e| e.into_inner())
    }
}

impl Progress for TerminalProgress {
    fn begin(&self, name: &str, unit: &str, total: u64, done: u64) {
        let mut stage = self.stage();
        let now = Some(Instant::now());
        *stage =
            Stage { name: name.into(), total, done, first: done, started: now, last_line: now, bar: None };
        if self.terminal {
            let template =
                format!("{{prefix:>10}} [{{bar:32}}] {{pos}}/{{len}} {unit}s  {{per_sec}}  ETA {{eta}}");
            let style =
                ProgressStyle::with_template(&template).unwrap_or_else(|_| ProgressStyle::default_bar());
            let bar =
                ProgressBar::new(total).with_style(style.progress_chars("=> ")).with_prefix(name.to_owned());
            bar.set_position(done);
            bar.reset_eta();
            bar.enable_steady_tick(Duration::from_millis(200));
            stage.bar = Some(bar);
        } else {
            note(format_args!("{name}: {done} of {total}"));
        }
    }

    fn advance(&self, n: u64) {
        let mut stage = self.stage();
        stage.done += n;
        match &stage.bar {
            Some(bar) => bar.inc(n),
            None if stage.last_line.is_none_or(|t| t.elapsed() >= LINE_INTERVAL) => {
                let seconds = stage.started.map_or(0.0, |t| t.elapsed().as_secs_f64());
                let rate = (stage.done - stage.first) as f64 / seconds.max(1e-9);
                let eta_secs = stage.total.saturating_sub(stage.done) as f64 / rate.max(1e-9);
                note(format_args!(
                    "{}: {} of {}, {rate:.1}/s, ETA {eta_secs:.0} s",
                    stage.name, stage.done, stage.total
                ));
                stage.last_line = Some(Instant::now());
            }
            None => {}
        }
    }

    fn end(&self) {
        if let Some(bar) = self.stage().bar.take() {
            bar.finish();
        }
    }
}
