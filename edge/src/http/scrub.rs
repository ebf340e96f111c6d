//! Scrubs in the background: each shard on board is read again within a given time, so that rot is found before an
//! answer needs it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::app::App;
use crate::store::Scrubber;

/// Longest sleep between looks at the cancel flag.
const NAP: Duration = Duration::from_millis(100);
/// Pause while no scene is loaded.
const IDLE: Duration = Duration::from_secs(1);

/// Reads every shard on board once in `round`, evenly, until `cancel` is set. A damaged one is marked, the
/// generation is opened again without it, and a follower fetches it.
pub fn keep_scrubbing(app: &App, round: Duration, cancel: &AtomicBool) {
    let mut scrubber = Scrubber::default();
    while !cancel.load(Ordering::Relaxed) {
        let snapshot = app.engine.snapshot().ok();
        let step = snapshot.and_then(|snapshot| scrubber.step(app.engine.cache(), &snapshot));
        let mut left = step.map_or(IDLE, |step| round.mul_f64(step.share));
        if step.is_some_and(|step| !step.is_sound) {
            app.reload_now();
        }
        while !left.is_zero() && !cancel.load(Ordering::Relaxed) {
            std::thread::sleep(left.min(NAP));
            left = left.saturating_sub(NAP);
        }
    }
}
