//! Tells systemd that the service is ready, alive or stopping; without systemd nothing is told.

use std::time::Duration;

/// Pulses in the time after which systemd takes a silent service for dead; it advises two.
const PULSES_PER_TIMEOUT: u32 = 3;

/// What systemd is told.
#[derive(Clone, Copy, Debug)]
pub enum News {
    Ready,
    Alive,
    Stopping,
}

#[cfg(unix)]
pub fn tell(news: News) {
    use sd_notify::NotifyState;

    let state = match news {
        News::Ready => NotifyState::Ready,
        News::Alive => NotifyState::Watchdog,
        News::Stopping => NotifyState::Stopping,
    };
    if let Err(error) = sd_notify::notify(&[state]) {
        tracing::warn!("systemd was not told {news:?}: {error}");
    }
}

#[cfg(not(unix))]
pub fn tell(_: News) {}

/// Says for ever that the service is alive, as long as `is_alive` says so in time; returns at once if nobody
/// expects it.
pub async fn pulse<A: Future<Output = bool>>(is_alive: impl Fn() -> A) {
    let timeout: Option<Duration> = match () {
        #[cfg(unix)]
        () => sd_notify::watchdog_enabled(),
        #[cfg(not(unix))]
        () => None,
    };
    let Some(pulse) = timeout.map(|timeout| timeout / PULSES_PER_TIMEOUT).filter(|pulse| !pulse.is_zero())
    else {
        return;
    };
    loop {
        match tokio::time::timeout(pulse, is_alive()).await {
            Ok(true) => tell(News::Alive),
            _ => tracing::error!("the service does not answer itself; its supervisor may end it"),
        }
        tokio::time::sleep(pulse).await;
    }
}
