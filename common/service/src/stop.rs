//! The signals that stop a program.

use std::io;

use tokio::signal::unix::{SignalKind, signal};

/// Returns a future that completes at ctrl-c or SIGTERM.
///
/// The handlers are installed when this returns, so that no signal is lost before the first poll.
pub fn stop_signal() -> io::Result<impl Future<Output = ()> + Send + 'static> {
    let (mut interrupt, mut terminate) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
    Ok(async move {
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
        }
        tracing::info!("stopping: requests in progress are finished first");
    })
}

/// Calls `stop` at ctrl-c, SIGTERM or SIGHUP.
pub fn on_stop(mut stop: impl FnMut() + Send + 'static) -> io::Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    // The caller may be within another runtime, where none can be driven.
    let (mut interrupt, mut terminate, mut hangup) = {
        let _context = runtime.enter();
        // Under `nohup`, which ignores it, the program outlives its terminal.
        let hangup = (!ignores_hangup()).then(|| signal(SignalKind::hangup())).transpose()?;
        (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?, hangup)
    };
    let listening = move || {
        runtime.block_on(async {
            loop {
                let hung_up = async {
                    match &mut hangup {
                        Some(hangup) => hangup.recv().await,
                        None => std::future::pending().await,
                    }
                };
                tokio::select! {
                    _ = interrupt.recv() => {}
                    _ = terminate.recv() => {}
                    _ = hung_up => {}
                }
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

    /// Without the handler SIGTERM would end this process.
    #[tokio::test]
    async fn sigterm_is_the_signal_to_stop() {
        let signalled = stop_signal().expect("handlers");
        let id = std::process::id().to_string();
        let killed = std::process::Command::new("kill").args(["-TERM", &id]).status();
        assert!(killed.expect("runs").success());
        signalled.await;
    }
}
