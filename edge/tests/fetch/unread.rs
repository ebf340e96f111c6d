//! Files that were checked are not read again, and files that rot are found.

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use slag_common::shard::Profile;
use slag_edge::store::files::{DiskFiles, Files, Stat};
use slag_edge::store::mmap::FileBytes;
use slag_edge::store::{EdgeCache, Snapshot};

use super::Robot;
use super::scene::Published;
use super::server::Server;

/// Counts the files mapped.
#[derive(Default)]
struct Counting {
    disk: DiskFiles,
    n_mapped: AtomicUsize,
}

impl Counting {
    fn take(&self) -> usize {
        self.n_mapped.swap(0, Ordering::Relaxed)
    }
}

impl Files for Counting {
    fn create_dir(&self, dir: &Path) -> io::Result<()> {
        self.disk.create_dir(dir)
    }
    fn write_from(&self, path: &Path, offset_bytes: u64, bytes: &[u8]) -> io::Result<()> {
        self.disk.write_from(path, offset_bytes, bytes)
    }
    fn sync(&self, path: &Path) -> io::Result<()> {
        self.disk.sync(path)
    }
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.disk.rename(from, to)
    }
    fn sync_dir(&self, dir: &Path) -> io::Result<()> {
        self.disk.sync_dir(dir)
    }
    fn remove(&self, path: &Path) -> io::Result<()> {
        self.disk.remove(path)
    }
    fn list(&self, dir: &Path) -> io::Result<Vec<String>> {
        self.disk.list(dir)
    }
    fn read(&self, path: &Path, max_bytes: u64) -> io::Result<Vec<u8>> {
        self.disk.read(path, max_bytes)
    }
    fn map(&self, path: &Path) -> io::Result<FileBytes> {
        self.n_mapped.fetch_add(1, Ordering::Relaxed);
        self.disk.map(path)
    }
    fn stat(&self, path: &Path) -> io::Result<Option<Stat>> {
        self.disk.stat(path)
    }
    fn free_bytes(&self, dir: &Path) -> io::Result<Option<u64>> {
        self.disk.free_bytes(dir)
    }
}

struct Trial {
    _dir: tempfile::TempDir,
    server: Server,
    files: Arc<Counting>,
    robot: Robot,
}

/// A robot with generation 1 on board, whose files are older than the grain of file times.
fn trial() -> Trial {
    let dir = tempfile::tempdir().expect("temporary folder");
    let server = Server::start(Published::new(1, &[0; 3], 40));
    let files = Arc::new(Counting::default());
    let cache = EdgeCache::with_files(dir.path().join("cache"), files.clone());
    let robot = Robot::new(cache, &server.url());
    robot.fetch().expect("works");
    std::thread::sleep(Duration::from_millis(150));
    robot.fetch().expect("nothing new");
    files.take();
    Trial { _dir: dir, server, files, robot }
}

#[test]
fn checked_files_are_not_read_at_every_fetch() {
    let Trial { _dir, server, files, mut robot } = trial();
    robot.fetch().expect("nothing new");
    assert_eq!(files.take(), 0, "all were checked");
    // One of three is new: mapped once for its hash, once for its content. Those of the generation that goes are opened once,
    // for the record of its objects.
    server.publish(Published::new(2, &[0, 7, 0], 40));
    assert_eq!(robot.fetch().expect("works").downloaded.n_shards, 1);
    assert_eq!(files.take(), 2 + 3);
    // Without the records of use, all are checked, once.
    fs_err::remove_dir_all(robot.cache.dir().join("db")).expect("there");
    std::thread::sleep(Duration::from_millis(150));
    for expected in [3, 0] {
        robot.fetch().expect("nothing new");
        assert_eq!(files.take(), expected);
    }
    // After a day, they are read again.
    robot.now_unix_secs -= 2 * 24 * 3600;
    for expected in [3, 0] {
        robot.fetch().expect("nothing new");
        assert_eq!(files.take(), expected);
    }
}

/// A bit that flips on the medium leaves the file's time alone.
#[test]
fn rot_is_found_within_a_day() {
    let Trial { _dir, server: _server, files, mut robot } = trial();
    let victim = robot.cache.shard_path(robot.snapshot().current.cells[1].hash);
    let modified = fs_err::metadata(&victim).expect("there").modified().expect("known");
    let mut bytes = fs_err::read(&victim).expect("there");
    bytes[600] ^= 1;
    let file = std::fs::OpenOptions::new().write(true).open(&victim).expect("there");
    io::Write::write_all(&mut &file, &bytes).expect("written");
    file.set_modified(modified).expect("set");
    drop(file);
    files.take();
    assert_eq!(robot.fetch().expect("unseen").downloaded.n_shards, 0);
    // Backwards: forwards the manifest would expire.
    robot.now_unix_secs -= 24 * 3600 + 900;
    assert_eq!(robot.fetch().expect("found").downloaded.n_shards, 1);
    robot.snapshot();
}

/// A new generation shares the open shards of the one before.
#[test]
fn open_shards_are_shared_by_generations() {
    let Trial { _dir, server, files, robot } = trial();
    let first = robot.snapshot();
    assert_eq!(files.take(), 3);
    server.publish(Published::new(2, &[0, 7, 0], 40));
    robot.fetch().expect("works");
    files.take();
    let second = Snapshot::open_after(&robot.cache, Some(&first)).expect("opens");
    assert_eq!(files.take(), 1, "the shard that changed");
    let is_shared = |at: usize| Arc::ptr_eq(&first.shards[at], &second.shards[at]);
    assert_eq!([0, 1, 2].map(is_shared), [true, false, true]);
    super::assert_holds(&second, &Published::new(2, &[0, 7, 0], 40), 0..3);
    // A file that was replaced is opened anew, whatever its name says.
    let path = robot.cache.shard_path(second.current.cells[0].hash);
    let copy = path.with_extension("copy");
    fs_err::copy(&path, &copy).expect("copied");
    fs_err::rename(&copy, &path).expect("renamed");
    let third = Snapshot::open_after(&robot.cache, Some(&second)).expect("opens");
    assert!(!Arc::ptr_eq(&second.shards[0], &third.shards[0]));
    assert_eq!(third.current.profile, Profile::Compact);
}
