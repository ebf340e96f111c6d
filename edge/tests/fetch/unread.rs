//! What is on board is read when it is opened and by the scrub, not by every fetch.

use std::sync::Arc;
use std::time::Duration;

use slag_common::shard::Profile;
use slag_edge::store::{Scrubber, Snapshot};

use super::rot::flip_unseen;
use super::scene::Published;
use super::{Robot, assert_holds};

/// A bit that flips on the medium leaves the file's time alone. No fetch reads it; a reader, or the scrub of one
/// that is open, does.
#[test]
fn rot_is_found_within_a_day() {
    let scene = Published::new(1, &[0; 3], 40);
    let (_server, robot) = Robot::fetched(scene.clone());
    for is_open in [false, true] {
        let open = is_open.then(|| robot.snapshot());
        flip_unseen(&robot.cache.shard_path(scene.hash(1, Profile::Compact)));
        assert_eq!(robot.fetch().expect("unseen").downloaded.n_shards, 0);
        match &open {
            Some(snapshot) => {
                let mut scrubber = Scrubber::default();
                let sound = (0..2).filter_map(|_| Some(scrubber.step(&robot.cache, snapshot)?.is_sound));
                assert_eq!(sound.filter(|is_sound| !is_sound).count(), 1);
            }
            None => assert_eq!(robot.snapshot().bad_cells.len(), 1),
        }
        assert_eq!(robot.fetch().expect("found").downloaded.n_shards, 1);
        assert_holds(&robot.snapshot(), &scene, 0..3);
    }
}

/// A new generation shares the open shards of the one before, except those that were replaced.
#[test]
fn open_shards_are_shared_by_generations() {
    let (server, robot) = Robot::fetched(Published::new(1, &[0; 3], 40));
    let first = robot.snapshot();
    let next = Published::new(2, &[0, 7, 0], 40);
    server.publish(next.clone());
    assert_eq!(robot.fetch().expect("works").downloaded.n_shards, 1);
    let second = Snapshot::open_after(&robot.cache, Some(&first)).expect("opens");
    let is_shared = |at: usize| Arc::ptr_eq(&first.shards[at], &second.shards[at]);
    assert_eq!([0, 1, 2].map(is_shared), [true, false, true]);
    assert_holds(&second, &next, 0..3);
    // A file that was replaced is opened anew, whatever its name says.
    std::thread::sleep(Duration::from_millis(20));
    let path = robot.cache.shard_path(second.current.cells[0].hash);
    let copy = path.with_extension("copy");
    fs_err::copy(&path, &copy).expect("copied");
    fs_err::rename(&copy, &path).expect("renamed");
    let third = Snapshot::open_after(&robot.cache, Some(&second)).expect("opens");
    assert!(!Arc::ptr_eq(&second.shards[0], &third.shards[0]));
}
