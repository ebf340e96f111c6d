//! The signals that stop a program.

use std::io;

use tokio::signal::unix::{Signal, SignalKind, signal};

struct Signals {
    interrupt: Signal,
    terminate: Signal,
    /// `None` under `nohup`, which ignores it: the program outlives its terminal.
    hangup: Option<Signal>,
}

impl Signals {
    /// Installs the handlers.
    fn new() -> io::Result<Self> {
        let hangup = (!ignores_hangup()).then(|| signal(SignalKind::hangup())).transpose()?;
        let [interrupt, terminate] = [SignalKind::interrupt(), SignalKind::terminate()].map(signal);
        Ok(Self { interrupt: interrupt?, terminate: terminate?, hangup })
    }

    async fn next(&mut self) {
        let hung_up = async {
            match &mut self.hangup {
                Some(hangup) => hangup.recv().await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            _ = self.interrupt.recv() => {}
            _ = self.terminate.recv() => {}
            _ = hung_up => {}
        }
    }
}

/// Returns a future that completes at ctrl-c, SIGTERM or SIGHUP.
///
/// The handlers are installed when this returns, so that no signal is lost before the first poll.
pub fn stop_signal() -> io::Result<impl Future<Output = ()> + Send + 'static> {
    let mut signals = Signals::new()?;
    Ok(async move {
        signals.next().await;
        tracing::info!("stopping: requests in progress are finished first");
    })
}

/// Calls `stop` at ctrl-c, SIGTERM or SIGHUP.
pub fn on_stop(mut stop: impl FnMut() + Send + 'static) -> io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    // The caller may be within another runtime, where none can be driven.
    let mut signals = {
        let _context = runtime.enter();
        Signals::new()?
    };
    let listening = move || {
        runtime.block_on(async {
            loop {
                signals.next().await;
                stop();
            }
        });
    };
    std::thread::Builder::new().name("signals".to_owned()).spawn(listening).map(drop)
}

/// Returns whether SIGHUP was ignored at the start; false if the system does not tell.
fn ignores_hangup() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    ignored.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).is_some_and(|mask| mask & 1 == 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Without the handlers each of these would end this process.
    #[tokio::test]
    async fn a_terminal_and_a_supervisor_stop_a_service() {
        for name in ["-TERM", "-HUP", "-INT"] {
            let signalled = stop_signal().expect("handlers");
            let id = std::process::id().to_string();
            let killed = std::process::Command::new("kill").args([name, &id]).status();
            assert!(killed.expect("runs").success());
            signalled.await;
        }
    }
}
