//! The keys that a robot accepts while keys change.

use slag_common::Hash32;
use slag_common::manifest::ManifestError;
use slag_edge::fetch::{FetchError, FetchReport};

use super::crash::copy_dir;
use super::scene::{Published, key, public};
use super::server::Server;
use super::{Robot, assert_holds};

const A: u8 = 1;
const B: u8 = 2;
const C: u8 = 3;

/// A generation signed by one key, naming the next.
fn signed(generation: u64, by: u8, next: Option<u8>) -> Published {
    Published::new(generation, &[generation; 3], 20)
        .edited(&key(by), |manifest| manifest.next_key = next.map(|next| public(&key(next))))
}

struct Trial {
    dir: tempfile::TempDir,
    server: Server,
    robot: Robot,
}

impl Trial {
    fn new(first: Published) -> Self {
        let dir = tempfile::tempdir().expect("temporary folder");
        let server = Server::start(first.clone());
        let robot = Robot::on_disk(dir.path(), &server.url());
        assert!(robot.fetch().expect("first contact").is_first_contact);
        assert_holds(&robot.snapshot(), &first, 0..3);
        Self { dir, server, robot }
    }

    fn accepts(&self, published: Published) -> FetchReport {
        self.server.publish(published.clone());
        let report = self.robot.fetch().expect("accepted");
        assert_holds(&self.robot.snapshot(), &published, 0..3);
        report
    }

    fn refuses(&self, published: Published) -> FetchError {
        let before = self.robot.snapshot().manifest;
        self.server.publish(published);
        let error = self.robot.fetch().expect_err("refused");
        assert_eq!(self.robot.snapshot().manifest, before);
        error
    }

    fn does_not_know_the_key_of(&self, published: Published) {
        let error = self.refuses(published);
        assert!(matches!(error, FetchError::Manifest(ManifestError::UnknownKey { .. })), "{error}");
    }

    fn records(&self) -> std::path::PathBuf {
        self.robot.cache.dir().join("trust")
    }
}

fn hash(seed: u8) -> Hash32 {
    public(&key(seed))
}

#[test]
fn a_named_successor_is_accepted_and_then_alone() {
    let trial = Trial::new(signed(1, A, None));
    trial.does_not_know_the_key_of(signed(2, B, None));
    let report = trial.accepts(signed(2, A, Some(B)));
    assert_eq!((report.next_key, report.replaced_key), (Some(hash(B)), None));
    // Both keys are accepted now, a third is not, and generations never decrease.
    trial.does_not_know_the_key_of(signed(3, C, None));
    trial.accepts(signed(5, A, Some(B)));
    let error = trial.refuses(signed(4, B, None));
    assert!(matches!(error, FetchError::Rollback { seen: 5, offered: 4, .. }), "{error}");
    let report = trial.accepts(signed(6, B, None));
    assert_eq!((report.key, report.replaced_key, report.next_key), (hash(B), Some(hash(A)), None));
    trial.does_not_know_the_key_of(signed(9, A, Some(B)));
    trial.accepts(signed(7, B, None));
    let error = trial.refuses(signed(6, B, None));
    assert!(matches!(error, FetchError::Rollback { seen: 7, .. }), "{error}");
    // And to the next key.
    trial.accepts(signed(8, B, Some(C)));
    assert_eq!(trial.accepts(signed(9, C, None)).replaced_key, Some(hash(B)));
    trial.does_not_know_the_key_of(signed(10, B, Some(C)));
    trial.does_not_know_the_key_of(signed(10, A, Some(C)));
}

/// A retracted change: a successor that the present key no longer names is not accepted.
#[test]
fn a_successor_may_be_dropped() {
    let trial = Trial::new(signed(1, A, Some(B)));
    trial.accepts(signed(2, A, None));
    trial.does_not_know_the_key_of(signed(3, B, None));
    trial.accepts(signed(3, A, Some(C)));
    trial.does_not_know_the_key_of(signed(4, B, None));
    trial.accepts(signed(4, C, None));
}

/// A command line that names the old key keeps working, and does not reinstate it.
#[test]
fn keys_that_are_named_follow_their_successors() {
    let mut trial = Trial::new(signed(1, A, Some(B)));
    trial.robot.request.keys = vec![hash(A)];
    trial.accepts(signed(2, B, None));
    trial.accepts(signed(3, B, None));
    trial.does_not_know_the_key_of(signed(9, A, Some(B)));
    // A robot that missed the announcement is given both keys.
    let mut late = Trial::new(signed(1, A, None));
    late.does_not_know_the_key_of(signed(3, B, None));
    late.robot.request.keys = vec![hash(A), hash(B)];
    assert_eq!(late.accepts(signed(3, B, None)).replaced_key, Some(hash(A)));
    late.does_not_know_the_key_of(signed(9, A, None));
    late.accepts(signed(4, B, None));
}

/// The records are lost, or are those of before the change: the manifest on board still refuses the old key.
#[test]
fn the_old_key_stays_refused_without_the_records() {
    let trial = Trial::new(signed(1, A, Some(B)));
    let before = trial.dir.path().join("before");
    copy_dir(&trial.records(), &before);
    trial.accepts(signed(2, B, None));
    for put_back in [false, true] {
        fs_err::remove_dir_all(trial.records()).expect("there");
        if put_back {
            copy_dir(&before, &trial.records());
        }
        trial.does_not_know_the_key_of(signed(9, A, Some(B)));
        assert!(matches!(trial.refuses(signed(1, A, Some(B))), FetchError::Manifest(_)), "{put_back}");
        trial.accepts(signed(2, B, None));
    }
    // Lost between announcement and change: both keys are still accepted.
    let trial = Trial::new(signed(1, A, Some(B)));
    fs_err::remove_dir_all(trial.records()).expect("there");
    trial.accepts(signed(2, B, None));
}

/// The old generation still answers if the new one was accepted but never arrived.
#[test]
fn a_change_of_keys_that_was_cut_off_loses_nothing() {
    let old = signed(1, A, Some(B));
    let trial = Trial::new(old.clone());
    trial.server.publish(signed(2, B, None));
    trial.server.faults(|seen| match seen.path.contains("objects") {
        true => super::server::Fault::Status(404),
        false => super::server::Fault::None,
    });
    assert!(matches!(trial.robot.fetch(), Err(FetchError::Download { .. })));
    assert_holds(&trial.robot.snapshot(), &old, 0..3);
    trial.server.faults(|_| super::server::Fault::None);
    // The new key has signed: the old one is refused, though its generation is on board.
    trial.does_not_know_the_key_of(signed(9, A, Some(B)));
    trial.does_not_know_the_key_of(old);
    trial.accepts(signed(2, B, None));
}

/// A generation seen under the old key that never arrived counts for the new key.
#[test]
fn what_was_seen_under_the_old_key_counts_for_the_new_one() {
    let trial = Trial::new(signed(1, A, Some(B)));
    trial.server.publish(signed(7, A, Some(B)));
    trial.server.faults(|seen| match seen.path.contains("objects") {
        true => super::server::Fault::Status(404),
        false => super::server::Fault::None,
    });
    assert!(matches!(trial.robot.fetch(), Err(FetchError::Download { .. })));
    trial.server.faults(|_| super::server::Fault::None);
    let error = trial.refuses(signed(6, B, None));
    assert!(matches!(error, FetchError::Rollback { seen: 7, offered: 6, .. }), "{error}");
    trial.accepts(signed(7, B, None));
}

/// The generation on board answers beyond its expiry; only fetch refuses it.
#[test]
fn an_expired_generation_goes_on_answering() {
    let mut trial = Trial::new(signed(1, A, None));
    let expires = signed(1, A, None).manifest.expires_unix_secs.expect("given");
    trial.robot.now_unix_secs = expires;
    trial.accepts(signed(1, A, None));
    trial.robot.now_unix_secs = expires + 1;
    let error = trial.refuses(signed(1, A, None));
    assert!(matches!(error, FetchError::Manifest(ManifestError::Expired { .. })), "{error}");
}
