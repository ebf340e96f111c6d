//! Following a robot: decides when to fetch, so that shards are on board before they are needed.
//!
//! A fetch covers `radius + margin` around the robot. The next one is due when the robot is farther than half the
//! margin from that centre, so the other half is left while shards arrive and everything within `radius` stays on
//! board. Moving to and fro within half the margin, even along a cell's edge, downloads and frees nothing.

use std::io::{self, BufRead, Read};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use glam::DVec3;
use schemars::JsonSchema;
use serde::Serialize;
use slag_common::manifest::Manifest;
use slag_common::retry::Backoff;

use super::error::FetchError;
use super::position::{MAX_TEXT_BYTES, NotAPosition, Position};
use super::records;
use super::request::{DEFAULT_RADIUS, FetchReport, FetchRequest};
use crate::store::EdgeCache;

/// Longest sleep between looks at the cancel flag.
const NAP: Duration = Duration::from_millis(100);

#[derive(Clone, Debug)]
pub struct FollowSettings {
    /// Cells within this distance of the robot are kept on board, as far as the network allows; world units.
    pub radius: f64,
    /// Distance fetched beyond the radius, world units.
    pub margin: f64,
    pub min_interval: Duration,
    /// Interval at which a resting robot looks for a new generation; absent: never.
    pub refresh: Option<Duration>,
    /// Waits after failures, scaled by 0.5..1.5.
    pub backoff: Backoff,
}

impl Default for FollowSettings {
    fn default() -> Self {
        Self {
            radius: DEFAULT_RADIUS,
            margin: DEFAULT_RADIUS / 4.0,
            min_interval: Duration::from_secs(2),
            refresh: Some(Duration::from_secs(300)),
            backoff: Backoff { first: Duration::from_secs(2), longest: Duration::from_secs(60) },
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decision {
    Fetch,
    NotBefore(Duration),
    /// Everything needed is on board; the time of the next fetch, if any.
    Rest(Option<Duration>),
}

/// Decides when to fetch. Pure: times are passed in, relative to any fixed moment.
#[derive(Clone, Debug)]
pub struct Follower {
    settings: FollowSettings,
    covered: Option<(DVec3, Duration)>,
    attempted: Option<Duration>,
    n_failures: u32,
    retry_at: Duration,
}

impl Follower {
    pub fn new(settings: FollowSettings) -> Self {
        Self { settings, covered: None, attempted: None, n_failures: 0, retry_at: Duration::ZERO }
    }

    pub fn fetch_radius(&self) -> f64 {
        self.settings.radius + self.settings.margin
    }

    /// Decides for a position in the world frame; `None` if it is geographic and no manifest relates it to the scene.
    pub fn decide(&self, now: Duration, at: Option<DVec3>) -> Decision {
        let slack = self.settings.margin / 2.0;
        let rest = match (self.covered, at) {
            (Some((centre, since)), Some(at)) if at.distance(centre) <= slack => {
                let refresh_at = self.settings.refresh.map(|refresh| since.saturating_add(refresh));
                Some(refresh_at).filter(|refresh_at| refresh_at.is_none_or(|refresh_at| refresh_at > now))
            }
            _ => None,
        };
        if let Some(refresh_at) = rest {
            return Decision::Rest(refresh_at);
        }
        let spaced =
            self.attempted.map_or(Duration::ZERO, |at| at.saturating_add(self.settings.min_interval));
        match spaced.max(self.retry_at) {
            earliest if earliest <= now => Decision::Fetch,
            earliest => Decision::NotBefore(earliest),
        }
    }

    /// Makes a fetch due wherever the robot is.
    pub fn forget(&mut self) {
        self.covered = None;
    }

    pub fn fetched(&mut self, began: Duration, centre_in_world: DVec3) {
        (self.covered, self.attempted) = (Some((centre_in_world, began)), Some(began));
        (self.n_failures, self.retry_at) = (0, Duration::ZERO);
    }

    /// Allows a fetch at once despite failures: their cause may be gone.
    pub fn retry(&mut self) {
        self.retry_at = Duration::ZERO;
    }

    /// Records a failed fetch, its start and its end; `random` is within 0..1.
    pub fn failed(&mut self, began: Duration, now: Duration, random: f64) {
        self.attempted = Some(began);
        self.n_failures = self.n_failures.saturating_add(1);
        let pause = self.settings.backoff.after(self.n_failures).mul_f64(0.5 + random.clamp(0.0, 1.0));
        self.retry_at = now.saturating_add(pause);
    }
}

/// Status of following, for people and monitors.
#[derive(Clone, Debug, Default, PartialEq, Serialize, JsonSchema)]
pub struct FollowStatus {
    /// The robot's last known position.
    pub position: Option<Position>,
    /// Successful fetches.
    pub n_fetches: u64,
    /// Failed fetches.
    pub n_failures: u64,
    /// Error of the last fetch; absent if it succeeded.
    pub last_error: Option<String>,
    /// Times that the follower itself failed and began again.
    pub n_restarts: u64,
    /// Why nothing is followed just now; absent once a fetch has ended since.
    pub failure: Option<String>,
}

#[derive(Default)]
struct Inbox {
    status: FollowStatus,
    n_posted: u64,
    is_due: bool,
    is_over: bool,
    /// The follower's own failures since the last fetch that ended.
    n_failures_in_a_row: u64,
}

/// Receives positions from any thread; only the last one counts.
#[derive(Default)]
pub struct Following {
    inbox: Mutex<Inbox>,
    changed: Condvar,
}

impl Following {
    pub fn post(&self, position: Position) {
        let mut inbox = self.lock();
        inbox.status.position = Some(position);
        inbox.n_posted += 1;
        self.changed.notify_all();
    }

    /// Makes a fetch due, as a file on board was lost.
    pub fn refresh(&self) {
        let mut inbox = self.lock();
        inbox.is_due = true;
        inbox.n_posted += 1;
        self.changed.notify_all();
    }

    pub fn close(&self) {
        self.lock().is_over = true;
        self.changed.notify_all();
    }

    pub fn status(&self) -> FollowStatus {
        self.lock().status.clone()
    }

    /// Returns why following is interrupted, if it is.
    pub fn failure(&self) -> Option<String> {
        self.lock().status.failure.clone()
    }

    /// Records a failure of the follower itself, and returns the failures in a row.
    pub(crate) fn note_failure(&self, failure: &str) -> u64 {
        let mut inbox = self.lock();
        inbox.status.failure = Some(failure.to_owned());
        inbox.n_failures_in_a_row += 1;
        inbox.n_failures_in_a_row
    }

    pub(crate) fn note_restart(&self) {
        self.lock().status.n_restarts += 1;
    }

    fn lock(&self) -> MutexGuard<'_, Inbox> {
        self.inbox.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the last position, the number posted, and whether they ended; after a refresh the follower forgets.
    fn read(&self, follower: &mut Follower) -> (Option<Position>, u64, bool) {
        let mut inbox = self.lock();
        if std::mem::take(&mut inbox.is_due) {
            follower.forget();
        }
        (inbox.status.position, inbox.n_posted, inbox.is_over)
    }

    /// Waits for a position after `n_seen`, for the end, or for the timeout.
    fn wait(&self, n_seen: u64, at_most: Duration) {
        let is_quiet = |inbox: &mut Inbox| inbox.n_posted == n_seen && !inbox.is_over;
        drop(self.changed.wait_timeout_while(self.lock(), at_most, is_quiet));
    }

    fn note(&self, outcome: &Result<FetchReport, FetchError>) {
        let mut inbox = self.lock();
        // Even a failed fetch shows that the follower is alive.
        inbox.n_failures_in_a_row = 0;
        let status = &mut inbox.status;
        status.failure = None;
        match outcome {
            Ok(_) => (status.n_fetches, status.last_error) = (status.n_fetches + 1, None),
            Err(error) => {
                status.n_failures += 1;
                status.last_error = Some(crate::error_line(error));
            }
        }
    }
}

pub struct FollowEnvironment<'a> {
    pub fetch: &'a mut dyn FnMut(&FetchRequest) -> Result<FetchReport, FetchError>,
    pub report: &'a mut dyn FnMut(&Result<FetchReport, FetchError>),
    /// Returns numbers within 0..1, to spread retries.
    pub random: &'a dyn Fn() -> f64,
    pub cancel: &'a AtomicBool,
}

/// Follows the posted positions until the last one is served, or until cancelled. `request` gives everything except
/// position and radius. Blocks.
///
/// # Errors
/// The error of the last fetch, if it was still due when positions ended; [`FetchError::Cancelled`].
pub fn follow(
    cache: &EdgeCache,
    request: &FetchRequest,
    settings: FollowSettings,
    following: &Following,
    environment: FollowEnvironment<'_>,
) -> Result<(), FetchError> {
    let started = Instant::now();
    let mut follower = Follower::new(settings);
    let mut manifest = None;
    // The records at a failure for want of trust.
    let mut distrusted = None;
    loop {
        if environment.cancel.load(Ordering::Relaxed) {
            return Err(FetchError::Cancelled);
        }
        let (position, n_seen, is_over) = following.read(&mut follower);
        if distrusted.as_ref().is_some_and(|before| *before != (n_seen, records::stamp(cache))) {
            follower.retry();
        }
        let now = started.elapsed();
        let decision = match position {
            Some(position) => follower.decide(now, in_world(position, manifest.as_ref())),
            None => Decision::Rest(None),
        };
        let nap = match decision {
            Decision::Rest(_) if is_over => return Ok(()),
            Decision::Fetch => None,
            Decision::NotBefore(at) | Decision::Rest(Some(at)) => Some(at.saturating_sub(now).min(NAP)),
            Decision::Rest(None) => Some(NAP),
        };
        if let Some(nap) = nap {
            // After the end nothing is posted, so nothing would end a wait.
            match is_over {
                true => std::thread::sleep(nap),
                false => following.wait(n_seen, nap),
            }
            continue;
        }
        let request = FetchRequest { at: position, radius: follower.fetch_radius(), ..request.clone() };
        let before = (n_seen, records::stamp(cache));
        let outcome = (environment.fetch)(&request);
        following.note(&outcome);
        (environment.report)(&outcome);
        match outcome {
            Ok(report) => {
                follower.fetched(now, report.centre_in_world);
                distrusted = None;
                // Needed for its geo-reference only; without it every geographic position fetches.
                manifest = cache.read_manifest(report.manifest_hash).ok();
            }
            Err(FetchError::Cancelled) => return Err(FetchError::Cancelled),
            Err(error) if is_over => return Err(error),
            Err(error) => {
                follower.failed(now, started.elapsed(), (environment.random)());
                distrusted = error.is_want_of_trust().then_some(before);
            }
        }
    }
}

fn in_world(position: Position, manifest: Option<&Manifest>) -> Option<DVec3> {
    match (position, manifest) {
        (Position::World(at), _) => Some(at),
        (_, Some(manifest)) => position.in_world(manifest).ok(),
        (_, None) => None,
    }
}

/// Reads positions, one a line, skipping empty lines, with bounded memory. `each` receives the line number, from 1.
pub fn read_positions(
    mut reader: impl BufRead,
    mut each: impl FnMut(u64, Result<Position, NotAPosition>),
) -> io::Result<()> {
    let mut line = Vec::new();
    for number in 1.. {
        line.clear();
        // One byte beyond the limit reveals an overlong line.
        let limit = MAX_TEXT_BYTES as u64 + 1;
        if reader.by_ref().take(limit).read_until(b'\n', &mut line)? == 0 {
            break;
        }
        if line.len() as u64 == limit && line.last() != Some(&b'\n') {
            reader.skip_until(b'\n')?;
        }
        let text = String::from_utf8_lossy(&line);
        if !text.trim().is_empty() {
            each(number, text.parse());
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn settings() -> FollowSettings {
        FollowSettings {
            radius: 20.0,
            margin: 8.0,
            min_interval: Duration::from_secs(2),
            refresh: Some(Duration::from_secs(100)),
            backoff: Backoff { first: secs(4), longest: secs(20) },
        }
    }

    fn secs(secs: u64) -> Duration {
        Duration::from_secs(secs)
    }

    fn x(x: f64) -> Option<DVec3> {
        Some(DVec3::X * x)
    }

    #[test]
    fn distance_time_and_failures_ask_for_a_fetch() {
        let mut follower = Follower::new(settings());
        assert_eq!(follower.decide(secs(0), x(0.0)), Decision::Fetch);
        assert_eq!(follower.decide(secs(0), None), Decision::Fetch);
        follower.fetched(secs(0), DVec3::ZERO);
        assert_eq!(follower.decide(secs(1), x(4.0)), Decision::Rest(Some(secs(100))));
        assert_eq!(follower.decide(secs(1), x(-4.1)), Decision::NotBefore(secs(2)));
        assert_eq!(follower.decide(secs(2), x(-4.1)), Decision::Fetch);
        assert_eq!(follower.decide(secs(100), x(0.0)), Decision::Fetch);
        // Failures: 4, 8, 16, 20, 20 s, scaled at random; returning to the covered area needs no fetch.
        let mut at = secs(10);
        for backoff in [4, 8, 16, 20, 20] {
            follower.failed(at, at, 0.5);
            assert_eq!(follower.decide(at, x(9.0)), Decision::NotBefore(at + secs(backoff)));
            assert_eq!(follower.decide(at, x(1.0)), Decision::Rest(Some(secs(100))));
            at += secs(backoff);
            assert_eq!(follower.decide(at, x(9.0)), Decision::Fetch);
        }
        follower.failed(at, at, 0.0);
        assert_eq!(follower.decide(at, x(9.0)), Decision::NotBefore(at + secs(10)));
        follower.fetched(at, DVec3::X * 9.0);
        assert_eq!(follower.decide(at, x(9.0)), Decision::Rest(Some(at + secs(100))));
        let mut never = Follower::new(FollowSettings { refresh: None, ..settings() });
        never.fetched(secs(0), DVec3::ZERO);
        assert_eq!(never.decide(secs(1 << 40), x(0.0)), Decision::Rest(None));
    }

    proptest! {
        /// Whenever no fetch is due, the last one covers the radius; fetches keep their minimum interval.
        #[test]
        fn the_radius_is_covered_whenever_nothing_is_due(
            steps in prop::collection::vec((prop::array::uniform3(-3.0..3.0f64), 0..5u64, prop::bool::weighted(0.2)), 1..200),
        ) {
            let mut follower = Follower::new(settings());
            let (mut at, mut now, mut last, mut centre) = (DVec3::ZERO, secs(0), None::<Duration>, None::<DVec3>);
            for (step, pause, fails) in steps {
                at += DVec3::from(step);
                now += secs(pause);
                match follower.decide(now, Some(at)) {
                    Decision::Fetch => {
                        prop_assert!(last.is_none_or(|last| now >= last + secs(2)));
                        last = Some(now);
                        if fails {
                            follower.failed(now, now, 0.5);
                        } else {
                            follower.fetched(now, at);
                            centre = Some(at);
                        }
                    }
                    Decision::NotBefore(until) => prop_assert!(until > now && until <= now + secs(20)),
                    Decision::Rest(_) => {
                        let centre = centre.expect("fetched");
                        prop_assert!(at.distance(centre) + 20.0 <= follower.fetch_radius());
                    }
                }
            }
        }
    }

    #[test]
    fn lines_are_read_skipped_and_bounded() {
        let long = "7".repeat(5000);
        let text = format!("1 2 3\n\nnonsense\n{long}\n46.8,-92\r\n\u{fffd}\n4 5 6");
        let mut found = Vec::new();
        let reader = io::BufReader::with_capacity(16, text.as_bytes());
        read_positions(reader, |number, read| found.push((number, read.ok()))).expect("reads");
        let world = |x, y, z| Some(Position::World(DVec3::new(x, y, z)));
        let earth = Position::Geographic { latitude_deg: 46.8, longitude_deg: -92.0, height_m: None };
        let expected = [
            (1, world(1.0, 2.0, 3.0)),
            (3, None),
            (4, None),
            (5, Some(earth)),
            (6, None),
            (7, world(4.0, 5.0, 6.0)),
        ];
        assert_eq!(found, expected);
    }
}
