//! A failing medium: an unreadable sector or inode costs its cell only, and ends no program.

use super::*;
use slag_test_support::{LoopDisk, needs_loop_disk};

/// A shard has more than 12 blocks.
const N: u32 = 4000;
const BLOCK: usize = 15;

struct Trial {
    /// Unmounted before its folder goes.
    disk: LoopDisk,
    _dir: tempfile::TempDir,
    server: Server,
    scene: Published,
    robot: Robot,
}

fn trial() -> Trial {
    let dir = tempfile::tempdir().expect("temporary folder");
    let disk = LoopDisk::new(dir.path());
    let scene = Published::new(1, &[0; 3], N);
    let server = Server::start(scene.clone());
    let robot = Robot::on_disk(disk.path(), &server.url());
    robot.fetch().expect("works");
    Trial { disk, _dir: dir, server, scene, robot }
}

/// Read through the map, the sector would end this process with SIGBUS.
#[needs_loop_disk]
fn a_sector_that_cannot_be_read_costs_its_cell_and_is_fetched_again() {
    let Trial { disk, scene, robot, .. } = &trial();
    disk.break_block(&robot.cache.shard_path(scene.hash(1, Profile::Compact)), BLOCK);
    let snapshot = robot.snapshot();
    assert_eq!((cells(&snapshot), snapshot.bad_cells[0].fault), (vec![0, 2], CellFault::Unreadable));
    drop(snapshot);
    assert_eq!(robot.fetch().expect("heals").downloaded.n_shards, 1);
    assert_holds(&robot.snapshot(), scene, 0..3);
}

/// Either reader may meet the sector first: the record of leaving objects, or the scrub.
#[needs_loop_disk]
fn fetches_and_scrubs_read_and_do_not_map() {
    let Trial { disk, server, scene, robot, .. } = &trial();
    disk.break_block(&robot.cache.shard_path(scene.hash(1, Profile::Compact)), BLOCK);
    let next = Published::new(2, &[5; 3], N);
    server.publish(next.clone());
    assert_eq!(robot.fetch().expect("goes on").downloaded.n_shards, 3, "the objects of what goes");
    assert_eq!(robot.snapshot().shards.len(), 3);
    disk.break_block(&robot.cache.shard_path(next.hash(2, Profile::Compact)), BLOCK);
    let snapshot = robot.snapshot();
    assert_eq!(cells(&snapshot), [0, 1]);
    assert!(Scrubber::default().step(&robot.cache, &snapshot).is_some_and(|step| step.is_sound));
}

/// ext4 neither reads, removes nor replaces it: the cell is missing until the disk is checked; the others go on.
#[needs_loop_disk]
fn an_inode_that_cannot_be_read_fails_no_fetch() {
    let Trial { disk, server, scene, robot, .. } = &trial();
    disk.break_inode(&robot.cache.shard_path(scene.hash(1, Profile::Compact)));
    let snapshot = robot.snapshot();
    assert_eq!((cells(&snapshot), snapshot.bad_cells[0].fault), (vec![0, 2], CellFault::Unreadable));
    drop(snapshot);
    let report = robot.fetch().expect("the others");
    let found: Vec<_> = report.bad_cells.iter().map(|bad| (bad.cell_id, bad.fault)).collect();
    assert_eq!(found, [(1, CellFault::Unreadable)]);
    let second = Published::new(2, &[0, 7, 0], N);
    server.publish(second.clone());
    assert_eq!(robot.fetch().expect("works").bad_cells, []);
    assert_holds(&robot.snapshot(), &second, 0..3);
    // One copy of the trust records: the other counts, and is written from then on.
    drop(Records::open(&robot.cache).expect("free"));
    // A crash left a file under the staging name.
    let left = robot.cache.dir().join("staging/put0");
    std::fs::write(&left, "half").expect("written");
    disk.break_inode(&left);
    disk.break_inode(&robot.cache.dir().join("trust/0"));
    for generation in 3..5 {
        server.publish(Published::new(generation, &[0, 7, 0], N));
        assert_eq!(robot.fetch().expect("believes the other copy").generation, generation);
    }
}
