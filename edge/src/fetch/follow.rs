//! Following a robot: when it fetches again, so that what lies around it is on board before it is needed.
//!
//! A fetch covers `radius + margin` around the robot. The next one is due when the robot is farther than
//! half the margin from that centre, so it has the other half left while the shards come in; what lies
//! within `radius` of it is on board all the while. A robot that goes to and fro within the half margin,
//! along the edge of a cell or not, neither downloads nor frees anything.

use std::io::{self, BufRead, Read};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use glam::DVec3;
use serde::Serialize;
use slag_common::manifest::Manifest;

use super::error::FetchError;
use super::position::{MAX_TEXT_BYTES, NotAPosition, Position};
use super::report::FetchReport;
use super::request::{DEFAULT_RADIUS, FetchRequest};
use crate::store::EdgeCache;

/// Longest sleep before the cancel flag is looked at again.
const NAP: Duration = Duration::from_millis(100);

/// How a robot is followed.
#[derive(Clone, Debug)]
pub struct FollowSettings {
    /// Cells within this of the robot are on board, as far as the network allows; world units.
    pub radius: f64,
    /// How much farther is fetched, world units.
    pub margin: f64,
    /// Fetches do not begin in quicker succession.
    pub min_interval: Duration,
    /// A robot that stays asks for a new generation this often; absent: never.
    pub refresh: Option<Duration>,
    /// Wait after the first failure; doubled after each further one, and scaled by 0.5..1.5.
    pub first_backoff: Duration,
    /// Longest wait after a failure.
    pub longest_backoff: Duration,
}

impl Default for FollowSettings {
    fn default() -> Self {
        Self {
            radius: DEFAULT_RADIUS,
            margin: DEFAULT_RADIUS / 4.0,
            min_interval: Duration::from_secs(2),
            refresh: Some(Duration::from_secs(300)),
            first_backoff: Duration::from_secs(2),
            longest_backoff: Duration::from_secs(60),
        }
    }
}

/// What a robot at a place is to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decision {
    /// Fetch.
    Fetch,
    /// A fetch is due, but not before this time.
    NotBefore(Duration),
    /// All is on board; by time alone the next fetch is due then, if ever.
    Rest(Option<Duration>),
}

/// Decides when to fetch. Pure: times are given, counted from any fixed moment.
#[derive(Clone, Debug)]
pub struct Follower {
    settings: FollowSettings,
    /// Centre of the last fetch that worked, and its time.
    covered: Option<(DVec3, Duration)>,
    attempted: Option<Duration>,
    n_failures: u32,
    retry_at: Duration,
}

impl Follower {
    /// Starts with nothing known: the first position fetches.
    pub fn new(settings: FollowSettings) -> Self {
        Self { settings, covered: None, attempted: None, n_failures: 0, retry_at: Duration::ZERO }
    }

    /// Returns the radius that a fetch asks for, world units.
    pub fn fetch_radius(&self) -> f64 {
        self.settings.radius + self.settings.margin
    }

    /// Decides for a robot at a place (world frame; absent: on the earth, and no manifest says where that
    /// is in the scene).
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

    /// Notes that a fetch that began then worked.
    pub fn fetched(&mut self, began: Duration, centre_in_world: DVec3) {
        (self.covered, self.attempted) = (Some((centre_in_world, began)), Some(began));
        (self.n_failures, self.retry_at) = (0, Duration::ZERO);
    }

    /// Notes that a fetch that began at one time failed at another; `random` is within 0..1.
    pub fn failed(&mut self, began: Duration, now: Duration, random: f64) {
        self.attempted = Some(began);
        let doubled = self.settings.first_backoff.saturating_mul(1 << self.n_failures.min(16));
        let backoff = doubled.min(self.settings.longest_backoff).mul_f64(0.5 + random.clamp(0.0, 1.0));
        self.n_failures = self.n_failures.saturating_add(1);
        self.retry_at = now.saturating_add(backoff);
    }
}

/// How following goes on, for people and monitors.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct FollowStatus {
    /// Where the robot was said to be last.
    pub position: Option<Position>,
    /// Fetches that worked.
    pub n_fetches: u64,
    /// Fetches that failed.
    pub n_failures: u64,
    /// Why the last fetch failed; absent if it worked.
    pub last_error: Option<String>,
}

#[derive(Default)]
struct Inbox {
    status: FollowStatus,
    n_posted: u64,
    is_over: bool,
}

/// Where positions are posted, from any thread; the last one counts.
#[derive(Default)]
pub struct Following {
    inbox: Mutex<Inbox>,
    changed: Condvar,
}

impl Following {
    /// Says where the robot is.
    pub fn post(&self, position: Position) {
        let mut inbox = self.lock();
        inbox.status.position = Some(position);
        inbox.n_posted += 1;
        self.changed.notify_all();
    }

    /// Says that no more positions come.
    pub fn close(&self) {
        self.lock().is_over = true;
        self.changed.notify_all();
    }

    /// Returns how it goes on.
    pub fn status(&self) -> FollowStatus {
        self.lock().status.clone()
    }

    fn lock(&self) -> MutexGuard<'_, Inbox> {
        self.inbox.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for a position beyond `n_seen`, the end, or at most a while.
    fn wait(&self, n_seen: u64, at_most: Duration) {
        let is_quiet = |inbox: &mut Inbox| inbox.n_posted == n_seen && !inbox.is_over;
        drop(self.changed.wait_timeout_while(self.lock(), at_most, is_quiet));
    }

    fn note(&self, outcome: &Result<FetchReport, FetchError>) {
        let status = &mut self.lock().status;
        match outcome {
            Ok(_) => (status.n_fetches, status.last_error) = (status.n_fetches + 1, None),
            Err(error) => {
                status.n_failures += 1;
                status.last_error = Some(crate::error_line::error_line(error));
            }
        }
    }
}

/// What following takes from outside.
pub struct FollowEnvironment<'a> {
    /// Makes one fetch.
    pub fetch: &'a mut dyn FnMut(&FetchRequest) -> Result<FetchReport, FetchError>,
    /// Is told how each fetch ended.
    pub tell: &'a mut dyn FnMut(&Result<FetchReport, FetchError>),
    /// Gives numbers within 0..1, to spread retries.
    pub random: &'a dyn Fn() -> f64,
    /// Set by anyone who wants it to end.
    pub cancel: &'a AtomicBool,
}

/// Follows the positions that are posted until they end and the last one is served, or until cancelled.
/// `request` says everything but position and radius. Blocks.
///
/// # Errors
/// That of the last fetch, if it was still due when positions ended; [`FetchError::Cancelled`].
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
    loop {
        if environment.cancel.load(Ordering::Relaxed) {
            return Err(FetchError::Cancelled);
        }
        let (position, n_seen, is_over) = {
            let inbox = following.lock();
            (inbox.status.position, inbox.n_posted, inbox.is_over)
        };
        let Some(position) = position else {
            if is_over {
                return Ok(());
            }
            following.wait(n_seen, NAP);
            continue;
        };
        let now = started.elapsed();
        match follower.decide(now, in_world(position, manifest.as_ref())) {
            Decision::Fetch => {}
            Decision::Rest(_) if is_over => return Ok(()),
            // At the end nothing more is posted, so there is nobody to be woken by.
            Decision::NotBefore(at) if is_over => {
                std::thread::sleep(at.saturating_sub(now).min(NAP));
                continue;
            }
            Decision::NotBefore(at) | Decision::Rest(Some(at)) => {
                following.wait(n_seen, at.saturating_sub(now).min(NAP));
                continue;
            }
            Decision::Rest(None) => {
                following.wait(n_seen, NAP);
                continue;
            }
        }
        let request = FetchRequest { at: Some(position), radius: follower.fetch_radius(), ..request.clone() };
        let outcome = (environment.fetch)(&request);
        following.note(&outcome);
        (environment.tell)(&outcome);
        match outcome {
            Ok(report) => {
                follower.fetched(now, report.centre_in_world);
                // Only for the geo-reference: without it every position on the earth fetches.
                manifest = cache.read_manifest(report.manifest_hash, report.key).ok();
            }
            Err(FetchError::Cancelled) => return Err(FetchError::Cancelled),
            Err(error) if is_over => return Err(error),
            Err(_) => follower.failed(now, started.elapsed(), (environment.random)()),
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

/// Reads positions, one a line, until the end; empty lines are passed over, overlong ones are not kept.
/// `each` gets the line's number, from 1.
///
/// # Errors
/// Whatever the reader gives.
pub fn read_positions(
    mut reader: impl BufRead,
    mut each: impl FnMut(u64, Result<Position, NotAPosition>),
) -> io::Result<()> {
    let mut line = Vec::new();
    for number in 1.. {
        line.clear();
        // One byte more than may be: then it is too long, and refused as that.
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
            first_backoff: Duration::from_secs(4),
            longest_backoff: Duration::from_secs(20),
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
        // Failures: 4, 8, 16, 20, 20 s, halved and more by chance; coming back needs no fetch at all.
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
        let never = Follower::new(FollowSettings { refresh: None, ..settings() });
        let mut never = never;
        never.fetched(secs(0), DVec3::ZERO);
        assert_eq!(never.decide(secs(1 << 40), x(0.0)), Decision::Rest(None));
    }

    proptest! {
        /// Wherever a robot goes: what lies within the radius is covered by the last fetch whenever none
        /// is due, and fetches keep their distance in time.
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
