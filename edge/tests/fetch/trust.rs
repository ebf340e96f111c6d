//! First trust, and attacks on a robot's records: damaged and lost ones, other roots, other scenes.

use super::*;

use slag_common::tuf::sha256_hex;
use slag_edge::fetch::accepted;

const SECOND: RootKeys = RootKeys { root: 3, online: 4 };
const OTHER: RootKeys = RootKeys { root: 8, online: 9 };

fn of(generation: u64, roots: &[RootKeys]) -> Published {
    Published::new(generation, &[generation; 3], 20).signed_by(roots, generation)
}

/// A robot that has followed from the first root to the second; generation 2 is on board.
struct Rotated {
    server: Server,
    robot: Robot,
}

impl Rotated {
    fn new() -> Self {
        let (server, mut robot) = Robot::started(of(1, &[FIRST]));
        robot.fetch().expect("first contact");
        robot.request.trust_first = false;
        server.publish(of(2, &[FIRST, SECOND]));
        assert_eq!(robot.fetch().expect("accepted").root_version, 2);
        Self { server, robot }
    }

    fn records(&self) -> [PathBuf; 3] {
        ["trust/0", "trust/1", "usage.json"].map(|name| self.robot.cache.dir().join(name))
    }

    fn refuses_the_old_keys(&self, context: &str) {
        self.server.publish(of(9, &[FIRST]));
        let error = self.robot.fetch().expect_err(context);
        assert!(matches!(error, FetchError::Tuf(TufError::Signatures { .. })), "{context}: {error}");
        assert_holds(&self.robot.snapshot(), &of(2, &[FIRST, SECOND]), 0..3);
    }

    fn accepts_the_new_keys(&self, context: &str) {
        self.server.publish(of(2, &[FIRST, SECOND]));
        self.robot.fetch().unwrap_or_else(|e| panic!("{context}: {}", slag_edge::error_line(&e)));
    }

    fn damage_both_copies(&self) {
        for name in ["0", "1"] {
            let path = self.robot.cache.dir().join("trust").join(name);
            let mut bytes = fs_err::read(&path).expect("there");
            *bytes.last_mut().expect("not empty") ^= 1;
            fs_err::write(path, bytes).expect("written");
        }
    }
}

#[test]
fn an_old_state_is_refused_even_if_the_new_one_never_arrived() {
    let (server, robot) = Robot::fetched(of(2, &[FIRST]));
    let refuses = |old: u64, newest: u64| {
        server.publish(of(old, &[FIRST]));
        match robot.fetch().expect_err("refused") {
            FetchError::Tuf(TufError::Rollback { seen, offered, .. }) => {
                assert_eq!((seen, offered), (newest, old));
            }
            error => panic!("{error}"),
        }
    };
    refuses(1, 2);
    server.publish(of(7, &[FIRST]));
    server.fault_at("objects", Fault::Status(404));
    assert!(matches!(robot.fetch(), Err(FetchError::Download { .. })));
    server.faults(|_| Fault::None);
    refuses(6, 7);
    server.publish(of(7, &[FIRST]));
    robot.fetch().expect("accepted");
}

/// A flipped bit in any file of records neither stops a robot nor restores old keys.
#[test]
fn a_flipped_bit_in_the_records_costs_nothing() {
    let rotated = Rotated::new();
    let saved = rotated.records().map(|file| (fs_err::read(&file).expect("there"), file));
    let (n_flips, mut n_trials) = (trials(12, 120), 0);
    for (bytes, file) in &saved {
        for at in (0..bytes.len()).step_by(bytes.len().div_ceil(n_flips)) {
            saved.iter().for_each(|(bytes, file)| fs_err::write(file, bytes).expect("written"));
            let mut flipped = bytes.clone();
            flipped[at] ^= 1 << (at % 8);
            fs_err::write(file, flipped).expect("written");
            let context = format!("bit {} of byte {at} of {}", at % 8, file.display());
            rotated.refuses_the_old_keys(&context);
            rotated.accepts_the_new_keys(&context);
            n_trials += 1;
        }
    }
    assert!(n_trials >= n_flips, "{n_trials}");
}

/// Adding the first root again after its keys were revoked changes nothing; another root needs --replace.
#[test]
fn adding_the_first_root_again_does_not_bring_its_keys_back() {
    let rotated = Rotated::new();
    let first = FirstRoot::Bytes(of(1, &[FIRST]).first_root());
    for root in [first, FirstRoot::Any { from: rotated.server.url() }] {
        assert!(!rotated.robot.add_root(&root, false).expect("known").is_new);
        rotated.refuses_the_old_keys("the first root is added again");
        rotated.accepts_the_new_keys("the first root is added again");
    }
    let other = FirstRoot::Bytes(of(3, &[OTHER]).first_root());
    let error = rotated.robot.add_root(&other, false).expect_err("another root");
    assert!(matches!(error, FetchError::OtherRoot { .. }), "{error}");
    rotated.accepts_the_new_keys("another root was refused");
    assert!(rotated.robot.add_root(&other, true).expect("asked for").is_new);
    let error = rotated.robot.fetch().expect_err("the former root's store");
    assert!(matches!(error, FetchError::Tuf(TufError::Signatures { .. })), "{error}");
    rotated.server.publish(of(1, &[OTHER]));
    assert_eq!(rotated.robot.fetch().expect("the other store").generation, 1);
}

/// Without explicit trust, no store is trusted.
#[test]
fn first_trust_is_a_step_of_its_own() {
    let published = of(2, &[FIRST, SECOND]);
    let (server, mut robot) = Robot::started(published.clone());
    robot.request.trust_first = false;
    let error = robot.fetch().expect_err("nothing is trusted");
    assert!(matches!(error, FetchError::NoTrust { .. }), "{error}");
    assert_eq!(server.take_seen().len(), 0, "nothing is asked");
    assert!(matches!(accepted(&robot.cache), Ok(None)));

    let second_root = published.metadata["2.root.json"].clone();
    let by_hash = |sha256: String| FirstRoot::Sha256 { from: server.url(), sha256 };
    let error = robot.add_root(&by_hash("0".repeat(64)), false).expect_err("no such root");
    assert!(error.to_string().contains("has no root with SHA-256 0000"), "{error}");
    let junk = robot.add_root(&FirstRoot::Bytes(b"{}".to_vec()), false).expect_err("no root");
    assert!(matches!(junk, FetchError::Tuf(TufError::Format { .. })), "{junk}");
    let mut forged = second_root.clone();
    let digit = forged.iter().rposition(|byte| byte.is_ascii_digit()).expect("a digit");
    forged[digit] ^= 1;
    assert!(robot.add_root(&FirstRoot::Bytes(forged), false).is_err());

    let added = robot.add_root(&by_hash(sha256_hex(&second_root)), false).expect("there");
    assert_eq!((added.version, added.is_new), (2, true));
    let report = robot.fetch().expect("works");
    assert_eq!((report.root_version, report.is_first_contact), (2, false));
    assert_holds(&robot.snapshot(), &published, 0..3);
    let kept = accepted(&robot.cache).expect("reads").expect("recorded");
    assert_eq!((kept.scene.as_deref(), kept.root_version), (Some("yard"), 2));
    assert_eq!(kept.root_sha256, sha256_hex(&second_root));
}

/// With both copies damaged, no store is trusted until a root is added by hand.
#[test]
fn without_a_whole_copy_no_store_is_believed() {
    let mut rotated = Rotated::new();
    rotated.damage_both_copies();
    let shown = accepted(&rotated.robot.cache);
    assert!(matches!(shown, Err(RecordsError::Damaged { .. })), "{shown:?}");
    rotated.server.publish(of(2, &[FIRST, SECOND]));
    for trust_first in [false, true] {
        rotated.robot.request.trust_first = trust_first;
        let error = rotated.robot.fetch().expect_err("fails closed");
        assert!(matches!(error, FetchError::Records(RecordsError::Damaged { .. })), "{error}");
        assert!(!error.to_string().contains("delete"), "{error}");
        assert_holds(&rotated.robot.snapshot(), &of(2, &[FIRST, SECOND]), 0..3);
    }
    rotated.robot.request.trust_first = false;
    let second_root = of(2, &[FIRST, SECOND]).metadata["2.root.json"].clone();
    assert!(rotated.robot.add_root(&FirstRoot::Bytes(second_root), false).expect("a root").is_new);
    rotated.refuses_the_old_keys("the record is written anew");
    rotated.accepts_the_new_keys("the record is written anew");
}

/// Missing records alone are no first contact.
#[test]
fn a_robot_without_records_asks_for_a_root() {
    let rotated = Rotated::new();
    for file in rotated.records() {
        fs_err::remove_file(file).expect("there");
    }
    assert!(matches!(rotated.robot.fetch(), Err(FetchError::NoTrust { .. })));
    assert_holds(&rotated.robot.snapshot(), &of(2, &[FIRST, SECOND]), 0..3);
}

/// A store is trusted for one scene: another one could silently bring an older map.
#[test]
fn another_scene_of_the_same_root_is_refused() {
    let (server, robot) = Robot::fetched(of(2, &[FIRST]));
    let barn = |version| {
        Published::new(1, &[4; 3], 20)
            .edited(|manifest| manifest.scene = "barn".into())
            .signed_by(&[FIRST], version)
    };
    server.publish(barn(3));
    assert_error(robot.fetch(), &["\"barn\"", "\"yard\"", "--scene"]);
    assert_holds(&robot.snapshot(), &of(2, &[FIRST]), 0..3);

    // Changing the scene is explicit, and so is the way back.
    let mut moved = robot.clone();
    moved.request.scene = Some("shed".into());
    assert_error(moved.fetch(), &["\"barn\"", "\"shed\""]);
    moved.request.scene = Some("barn".into());
    assert_eq!(moved.fetch().expect("asked for").scene, "barn");
    assert_holds(&robot.snapshot(), &barn(3), 0..3);
    assert_eq!(robot.fetch().expect("pinned now").scene, "barn");
    server.publish(Published::new(2, &[0; 3], 20).signed_by(&[FIRST], 4));
    let refused = || robot.fetch().expect_err("another scene").to_string();
    assert!(refused().contains("this robot expects \"barn\""), "{}", refused());
    // The scene on board counts if the records are lost.
    fs_err::remove_dir_all(robot.cache.dir().join("trust")).expect("there");
    assert!(refused().contains("this robot expects \"barn\""), "{}", refused());
}
