//! Keeps a follower alive: one that panics is reported, and begins again after a pause.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use slag_common::retry::Backoff;

use crate::fetch::follow::Following;

/// Pauses before a follower that failed begins again.
pub const RESTARTS: Backoff = Backoff { first: Duration::from_secs(1), longest: Duration::from_secs(60) };
/// Longest sleep between looks at the cancel flag.
const NAP: Duration = Duration::from_millis(50);

/// Runs `follow` until it returns. If it panics, `following` says so (and with it `/readyz`, `/position`,
/// `/status` and `/metrics`) until a fetch of its successor ends, and `follow` runs again after a pause that
/// doubles with each failure in a row. Returns `None` if cancelled in a pause.
pub fn keep_following<T>(
    following: &Following,
    restarts: Backoff,
    cancel: &AtomicBool,
    mut follow: impl FnMut() -> T,
) -> Option<T> {
    loop {
        // What it leaves half done is either its own, and dropped with it, or behind a lock that recovers.
        let panic = match catch_unwind(AssertUnwindSafe(&mut follow)) {
            Ok(ended) => return Some(ended),
            Err(panic) => panic,
        };
        let failure = format!("the follower panicked: {}", text_of(&*panic));
        let n_in_a_row = following.note_failure(&failure);
        let pause = restarts.after(u32::try_from(n_in_a_row).unwrap_or(u32::MAX));
        tracing::error!("{failure}; it begins again in {} s", pause.as_secs_f64());
        let mut left = pause;
        while !left.is_zero() {
            if cancel.load(Ordering::Relaxed) {
                return None;
            }
            std::thread::sleep(left.min(NAP));
            left = left.saturating_sub(NAP);
        }
        following.note_restart();
    }
}

/// Returns the message of a panic.
fn text_of(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied().or(panic.downcast_ref::<String>().map(String::as_str));
    text.unwrap_or("without a message")
}
