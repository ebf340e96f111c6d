//! Background work of the service: a follower, restarted after a panic, and a scrubber, which finds rot early.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use slag_common::retry::Backoff;
use slag_service::request::panic_text;

use super::app::App;
use crate::fetch::follow::Following;
use crate::store::Scrubber;

/// Pauses before a failed follower is restarted.
pub const RESTARTS: Backoff = Backoff { first: Duration::from_secs(1), longest: Duration::from_secs(60) };
/// Longest sleep between looks at the cancel flag.
const NAP: Duration = Duration::from_millis(50);

/// Runs `follow` until it returns. After a panic, `following` (and with it `/readyz`, `/position`, `/status` and
/// `/metrics`) reports the failure until a fetch of the restarted follower ends; pauses between restarts double with
/// each failure in a row. Returns `None` if cancelled in a pause.
pub fn keep_following<T>(
    following: &Following,
    restarts: Backoff,
    cancel: &AtomicBool,
    mut follow: impl FnMut() -> T,
) -> Option<T> {
    loop {
        // Its unfinished state is either its own, and dropped with it, or behind a lock that recovers.
        let panic = match catch_unwind(AssertUnwindSafe(&mut follow)) {
            Ok(ended) => return Some(ended),
            Err(panic) => panic,
        };
        let failure = format!("the follower panicked: {}", panic_text(&*panic));
        let n_in_a_row = following.note_failure(&failure);
        let pause = restarts.after(u32::try_from(n_in_a_row).unwrap_or(u32::MAX));
        tracing::error!("{failure}; it begins again in {} s", pause.as_secs_f64());
        if is_cancelled_within(pause, cancel) {
            return None;
        }
        following.note_restart();
    }
}

/// Pause while no scene is loaded.
const IDLE: Duration = Duration::from_secs(1);

/// Reads every shard on board once per `round`, evenly, until `cancel` is set; damaged ones are fetched again.
pub fn keep_scrubbing(app: &App, round: Duration, cancel: &AtomicBool) {
    let mut scrubber = Scrubber::default();
    while !cancel.load(Ordering::Relaxed) {
        let snapshot = app.engine.snapshot().ok();
        let step = snapshot.and_then(|snapshot| scrubber.step(app.engine.cache(), &snapshot));
        if step.is_some_and(|step| !step.is_sound) {
            app.reload_now();
        }
        is_cancelled_within(step.map_or(IDLE, |step| round.mul_f64(step.share)), cancel);
    }
}

/// Sleeps; returns true early once `cancel` is set.
fn is_cancelled_within(pause: Duration, cancel: &AtomicBool) -> bool {
    let mut left = pause;
    while !left.is_zero() && !cancel.load(Ordering::Relaxed) {
        std::thread::sleep(left.min(NAP));
        left = left.saturating_sub(NAP);
    }
    !left.is_zero()
}
