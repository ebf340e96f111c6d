//! Attacks on what a robot remembers: damaged, lost and outdated records of keys, generations and scenes.

use std::path::{Path, PathBuf};

use slag_common::Hash32;
use slag_common::manifest::ManifestError;
use slag_edge::fetch::{FetchError, RecordsError};

use super::crash::copy_dir;
use super::scene::{Published, key, public};
use super::server::Server;
use super::{Robot, assert_holds};

const A: u8 = 1;
const B: u8 = 2;
const C: u8 = 3;
/// Flips of each file of records.
const N_FLIPS: usize = 120;

fn hash(seed: u8) -> Hash32 {
    public(&key(seed))
}

fn signed(generation: u64, by: u8, next: Option<u8>) -> Published {
    Published::new(generation, &[generation; 3], 20)
        .edited(&key(by), |manifest| manifest.next_key = next.map(hash))
}

/// A robot that has followed from key A to key B; generation 2 is on board.
struct Rotated {
    dir: tempfile::TempDir,
    server: Server,
    robot: Robot,
}

impl Rotated {
    fn new() -> Self {
        let dir = tempfile::tempdir().expect("temporary folder");
        let server = Server::start(signed(1, A, Some(B)));
        let robot = Robot::on_disk(dir.path(), &server.url());
        robot.fetch().expect("first contact");
        server.publish(signed(2, B, None));
        assert_eq!(robot.fetch().expect("accepted").replaced_key, Some(hash(A)));
        Self { dir, server, robot }
    }

    /// Returns the folders of records.
    fn records(&self) -> Vec<PathBuf> {
        let folders = ["db", "trust"].map(|name| self.robot.cache.dir().join(name));
        folders.into_iter().filter(|folder| folder.is_dir()).collect()
    }

    fn refuses_the_old_key(&self, context: &str) -> String {
        self.server.publish(signed(9, A, Some(B)));
        let error = self.robot.fetch().expect_err(context);
        let is_refused =
            matches!(error, FetchError::Manifest(ManifestError::UnknownKey { .. }) | FetchError::Key { .. });
        assert!(is_refused, "{context}: {error}");
        assert_holds(&self.robot.snapshot(), &signed(2, B, None), 0..3);
        slag_edge::error_line(&error)
    }

    fn accepts_the_new_key(&self, context: &str) {
        self.server.publish(signed(2, B, None));
        self.robot.fetch().unwrap_or_else(|e| panic!("{context}: {}", slag_edge::error_line(&e)));
    }
}

fn files_below(dir: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs_err::read_dir(dir).expect("there") {
        let path = entry.expect("readable").path();
        match path.is_dir() {
            true => files_below(&path, found),
            false => found.push(path),
        }
    }
}

/// A flipped bit in any file of records neither stops a robot nor brings an old key back.
#[test]
fn a_flipped_bit_in_the_records_costs_nothing() {
    let rotated = Rotated::new();
    let mut files = Vec::new();
    for folder in rotated.records() {
        copy_dir(&folder, &rotated.dir.path().join("saved").join(folder.file_name().expect("a name")));
        files_below(&folder, &mut files);
    }
    let mut n_trials = 0;
    for file in files {
        let bytes = fs_err::read(&file).expect("there");
        // Most of a database is zeros.
        let places: Vec<usize> = (0..bytes.len()).filter(|at| bytes[*at] != 0).collect();
        for at in places.iter().step_by(places.len().div_ceil(N_FLIPS).max(1)) {
            for folder in rotated.records() {
                let saved = rotated.dir.path().join("saved").join(folder.file_name().expect("a name"));
                fs_err::remove_dir_all(&folder).expect("there");
                copy_dir(&saved, &folder);
            }
            let mut flipped = bytes.clone();
            flipped[*at] ^= 1 << (at % 8);
            fs_err::write(&file, flipped).expect("written");
            let context = format!("bit {} of byte {at} of {}", at % 8, file.display());
            rotated.refuses_the_old_key(&context);
            rotated.accepts_the_new_key(&context);
            n_trials += 1;
        }
    }
    assert!(n_trials > 100, "{n_trials}");
}

/// A command line that still names the old key: with its records, without them, and with damaged ones.
#[test]
fn a_command_line_with_the_old_key_does_not_bring_it_back() {
    let mut rotated = Rotated::new();
    rotated.robot.request.keys = vec![hash(A)];
    let error = rotated.refuses_the_old_key("records intact");
    assert!(!error.contains("delete"), "{error}");
    rotated.accepts_the_new_key("the old key's successor signs");
    for folder in rotated.records() {
        fs_err::remove_dir_all(folder).expect("there");
    }
    let error = rotated.refuses_the_old_key("records lost");
    assert!(!error.contains("delete"), "{error}");
}

/// Floors of generations are counted by scene: another scene could bring an older map without a word.
#[test]
fn another_scene_of_the_same_key_is_refused() {
    let dir = tempfile::tempdir().expect("temporary folder");
    let second = Published::new(2, &[0; 3], 20);
    let server = Server::start(second.clone());
    let robot = Robot::on_disk(dir.path(), &server.url());
    robot.fetch().expect("works");
    let other = Published::new(1, &[4; 3], 20).edited(&key(A), |manifest| manifest.scene = "barn".into());
    server.publish(other.clone());
    let error = robot.fetch().expect_err("another scene").to_string();
    assert!(error.contains("\"barn\"") && error.contains("\"yard\"") && error.contains("--scene"), "{error}");
    assert_holds(&robot.snapshot(), &second, 0..3);

    // To go there is a step of its own; and so is the way back, to the generation that was seen.
    let mut moved = robot.clone();
    moved.request.scene = Some("shed".into());
    let error = moved.fetch().expect_err("a third scene").to_string();
    assert!(error.contains("\"barn\"") && error.contains("\"shed\""), "{error}");
    moved.request.scene = Some("barn".into());
    assert_eq!(moved.fetch().expect("asked for").scene, "barn");
    assert_holds(&robot.snapshot(), &other, 0..3);
    assert_eq!(robot.fetch().expect("pinned now").scene, "barn");
    server.publish(Published::new(1, &[0; 3], 20));
    assert!(matches!(robot.fetch(), Err(FetchError::Scene { .. })));
    moved.request.scene = Some("yard".into());
    assert!(matches!(moved.fetch(), Err(FetchError::Rollback { seen: 2, offered: 1, .. })));
    assert_holds(&robot.snapshot(), &other, 0..3);
    // The scene on board counts if the records are lost.
    fs_err::remove_dir_all(robot.cache.dir().join("trust")).expect("there");
    server.publish(second);
    assert!(matches!(robot.fetch(), Err(FetchError::Scene { .. })));
}

/// Both copies are damaged: no key is accepted until one is named, and then only that of the generation on
/// board.
#[test]
fn without_a_whole_copy_no_key_is_accepted() {
    let mut rotated = Rotated::new();
    let copies = ["0", "1"].map(|name| rotated.robot.cache.dir().join("trust").join(name));
    for path in &copies {
        let mut bytes = fs_err::read(path).expect("there");
        *bytes.last_mut().expect("not empty") ^= 1;
        fs_err::write(path, bytes).expect("written");
    }
    rotated.server.publish(signed(2, B, None));
    for keys in [vec![], vec![hash(A)], vec![hash(A), hash(C)]] {
        rotated.robot.request.keys = keys;
        let error = rotated.robot.fetch().expect_err("fails closed");
        let is_closed =
            matches!(error, FetchError::Records(RecordsError::Damaged { .. }) | FetchError::Key { .. });
        assert!(is_closed && !error.to_string().contains("delete"), "{error}");
        assert_holds(&rotated.robot.snapshot(), &signed(2, B, None), 0..3);
    }
    rotated.robot.request.keys = vec![hash(B)];
    rotated.accepts_the_new_key("the key of the generation on board");
    rotated.robot.request.keys.clear();
    rotated.accepts_the_new_key("the record is written anew");
    rotated.refuses_the_old_key("the record is written anew");
}
