//! One fetch at a time.

use std::fs::{File, TryLockError};
use std::io;
use std::path::Path;
use std::time::{Duration, Instant};

/// Wait for another fetch: a service's and a command's may meet.
const TIMEOUT: Duration = Duration::from_secs(2);
const PAUSE: Duration = Duration::from_millis(20);

/// The cache's lock, held until dropped.
#[derive(Debug)]
pub struct Lock(#[expect(dead_code, reason = "the lock lasts as long as the file is open")] File);

impl Lock {
    /// Takes the lock of a cache folder; `None` if another fetch keeps it.
    ///
    /// # Errors
    /// The file system's, with the path.
    pub fn take(dir: &Path) -> io::Result<Option<Self>> {
        let path = dir.join("lock");
        fs_err::create_dir_all(dir)?;
        let file = fs_err::OpenOptions::new().write(true).create(true).truncate(false).open(&path)?;
        let file = file.into_parts().0;
        let start = Instant::now();
        loop {
            match file.try_lock() {
                Ok(()) => return Ok(Some(Self(file))),
                Err(TryLockError::WouldBlock) if start.elapsed() > TIMEOUT => return Ok(None),
                Err(TryLockError::WouldBlock) => std::thread::sleep(PAUSE),
                Err(TryLockError::Error(e)) => {
                    return Err(io::Error::new(e.kind(), format!("locking {}: {e}", path.display())));
                }
            }
        }
    }
}
