//! The attacks that The Update Framework names, over a real connection: whose metadata a robot accepts, and which.

use slag_common::tuf::TufError;
use slag_edge::fetch::{FetchError, FetchReport};

use super::scene::{FIRST, NOW, Published, RootKeys};
use super::server::{Fault, Server};
use super::{Robot, assert_holds};

const SECOND: RootKeys = RootKeys { root: 3, online: 4 };
const THIRD: RootKeys = RootKeys { root: 5, online: 6 };
const THIEF: RootKeys = RootKeys { root: 9, online: 9 };

/// A generation whose content is its number, under the last of these roots.
fn of(generation: u64, roots: &[RootKeys], version: u64) -> Published {
    Published::new(generation, &[generation; 3], 20).signed_by(roots, version)
}

struct Trial {
    server: Server,
    robot: Robot,
}

impl Trial {
    fn new(first: Published) -> Self {
        let (server, robot) = Robot::started(first.clone());
        assert!(robot.fetch().expect("first contact").is_first_contact);
        assert_holds(&robot.snapshot(), &first, 0..3);
        Self { server, robot }
    }

    fn accepts(&self, published: Published) -> FetchReport {
        self.server.publish(published.clone());
        let report = self.robot.fetch().expect("accepted");
        assert_holds(&self.robot.snapshot(), &published, 0..3);
        report
    }

    fn refuses(&self, published: Published) -> TufError {
        let before = self.robot.snapshot().manifest;
        self.server.publish(published);
        let error = self.robot.fetch().expect_err("refused");
        assert_eq!(self.robot.snapshot().manifest, before);
        match error {
            FetchError::Tuf(error) => error,
            error => panic!("{error}"),
        }
    }

    fn does_not_know_the_keys_of(&self, published: Published) {
        let error = self.refuses(published);
        assert!(matches!(error, TufError::Signatures { ref role, .. } if role == "timestamp"), "{error}");
    }
}

/// Wrong keys, and a leaked online key that a new root took out of use.
#[test]
fn a_robot_follows_new_roots_and_refuses_revoked_keys() {
    let (trial, sleeps) = (Trial::new(of(1, &[FIRST], 1)), Trial::new(of(1, &[FIRST], 1)));
    trial.does_not_know_the_keys_of(of(2, &[THIEF], 2));
    let report = trial.accepts(of(2, &[FIRST, SECOND], 2));
    assert_eq!((report.root_version, report.is_first_contact), (2, false));
    trial.does_not_know_the_keys_of(of(9, &[FIRST], 9));
    assert_eq!(trial.accepts(of(3, &[FIRST, SECOND, THIRD], 3)).root_version, 3);
    trial.does_not_know_the_keys_of(of(9, &[FIRST], 9));
    trial.does_not_know_the_keys_of(of(9, &[FIRST, SECOND], 9));
    // A robot that missed both changes follows them at once.
    assert_eq!(sleeps.accepts(of(3, &[FIRST, SECOND, THIRD], 3)).root_version, 3);
}

#[test]
fn an_old_state_is_refused_even_if_the_new_one_never_arrived() {
    let trial = Trial::new(of(2, &[FIRST], 2));
    assert!(matches!(trial.refuses(of(1, &[FIRST], 1)), TufError::Rollback { seen: 2, offered: 1, .. }));
    trial.server.publish(of(7, &[FIRST], 7));
    trial.server.fault_at("objects", Fault::Status(404));
    assert!(matches!(trial.robot.fetch(), Err(FetchError::Download { .. })));
    trial.server.faults(|_| Fault::None);
    assert!(matches!(trial.refuses(of(6, &[FIRST], 6)), TufError::Rollback { seen: 7, offered: 6, .. }));
    trial.accepts(of(7, &[FIRST], 7));
}

/// Each file is genuine, but of another state.
#[test]
fn files_of_different_states_are_not_mixed() {
    let trial = Trial::new(of(1, &[FIRST], 1));
    let (other, new) = (of(5, &[FIRST], 2), of(2, &[FIRST], 2));
    for name in ["2.snapshot.json", "2.targets.json"] {
        let mut mixed = new.clone().signed_by(&[FIRST], 2);
        mixed.metadata.insert(name.into(), other.metadata[name].clone());
        let error = trial.refuses(mixed);
        assert!(matches!(error, TufError::Content { .. }), "{name}: {error}");
    }
    trial.server.publish(new.clone());
    trial.server.fault_at("/targets/", Fault::Instead(other.listed));
    assert!(matches!(trial.robot.fetch(), Err(FetchError::Tuf(TufError::Content { .. }))));
    trial.server.faults(|_| Fault::None);
    trial.accepts(new);
}

/// Time is the later of the clock and the newest signed time, so that a frozen store is noticed when its timestamp
/// expires; what is on board answers on. A clock that is ahead stops fetches while it is ahead, and leaves nothing
/// behind; at 1970, what the newest signed time allows is taken.
#[test]
fn a_clock_that_is_wrong_costs_no_more_than_fetches() {
    let mut trial = Trial::new(of(1, &[FIRST], 1));
    let wrong = [NOW + 1000, NOW + (10 << 30), u64::MAX];
    for ahead in wrong {
        trial.robot.now_unix_secs = ahead;
        let error = trial.refuses(of(2, &[FIRST], 2));
        assert!(matches!(error, TufError::Expired { .. }), "{ahead}: {error}");
    }
    trial.robot.now_unix_secs = NOW;
    trial.accepts(of(2, &[FIRST], 2));
    for (version, clock) in [(3, 0), (4, NOW - 2000), (5, NOW + 999)] {
        trial.robot.now_unix_secs = clock;
        trial.accepts(of(version, &[FIRST], version));
    }
}
