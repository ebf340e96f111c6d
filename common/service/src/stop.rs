//! The signals that stop a service.

use std::io;

/// Returns a future that completes at ctrl-c or, on Unix, SIGTERM.
///
/// The handlers are installed when this returns, so that no signal is lost before the first poll.
#[cfg(unix)]
pub fn stop_signal() -> io::Result<impl Future<Output = ()> + Send + 'static> {
    use tokio::signal::unix::{SignalKind, signal};
    let (mut interrupt, mut terminate) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
    Ok(async move {
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
        }
        tracing::info!("stopping: requests in progress are finished first");
    })
}

/// Returns a future that completes at ctrl-c.
#[cfg(windows)]
pub fn stop_signal() -> io::Result<impl Future<Output = ()> + Send + 'static> {
    let mut interrupt = tokio::signal::windows::ctrl_c()?;
    Ok(async move {
        interrupt.recv().await;
        tracing::info!("stopping: requests in progress are finished first");
    })
}

#[cfg(all(test, unix))]
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
