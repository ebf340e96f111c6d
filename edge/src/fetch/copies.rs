//! A small record in two checksummed copies, which survives a power cut or one damaged copy.
//!
//! A copy is `slag-record 1 SEQUENCE HASH\n` and the content; HASH is the BLAKE3 hash of `SEQUENCE\n` and the content.
//! One copy is durable before the other is replaced, so one is always whole; at rest both are the same.

use std::io;
use std::path::PathBuf;

use slag_common::{Hash32, tuf};

use crate::store::files::{Files, is_bad_medium, put_through};

/// A longer copy is damaged. Fits the longest metadata that a client keeps, with escaped quotes.
pub const MAX_COPY_BYTES: u64 =
    2 * (tuf::MAX_ROOT_BYTES + tuf::MAX_TIMESTAMP_BYTES + tuf::MAX_SNAPSHOT_BYTES) + (64 << 10);
const NAMES: [&str; 2] = ["0", "1"];

/// The newest version, if there is one; the error: all copies are damaged, by the fault of the first.
pub type Found = Result<Option<Version>, String>;

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Version {
    /// From 1.
    pub sequence: u64,
    pub content: Vec<u8>,
    index: usize,
    pub is_twice: bool,
}

enum Copy {
    Missing,
    Damaged(String),
    Unreadable(io::Error),
    Whole(u64, Vec<u8>),
}

/// The two copies, in their own folder.
#[derive(Clone, Debug)]
pub struct Copies {
    pub dir: PathBuf,
}

impl Copies {
    pub fn paths(&self) -> [PathBuf; 2] {
        [0, 1].map(|index| self.path(index))
    }

    fn path(&self, index: usize) -> PathBuf {
        self.dir.join(NAMES[index])
    }

    /// Reads the newest whole copy.
    ///
    /// # Errors
    /// The file system's, if no copy is whole and one could not be read.
    pub fn read(&self, files: &dyn Files) -> io::Result<Found> {
        let [first, second] = [0, 1].map(|index| match files.read(&self.path(index), MAX_COPY_BYTES) {
            Ok(bytes) => parse(&bytes),
            Err(e) if e.kind() == io::ErrorKind::NotFound => Copy::Missing,
            Err(e) if e.kind() == io::ErrorKind::InvalidData || is_bad_medium(&e) => {
                Copy::Damaged(e.to_string())
            }
            Err(e) => Copy::Unreadable(e),
        });
        let version =
            |sequence, content, index, is_twice| Ok(Ok(Some(Version { sequence, content, index, is_twice })));
        match (first, second) {
            (Copy::Whole(a, content), Copy::Whole(b, other)) => match a >= b {
                true => version(a, content.clone(), 0, a == b && content == other),
                false => version(b, other, 1, false),
            },
            (Copy::Whole(sequence, content), _) => version(sequence, content, 0, false),
            (_, Copy::Whole(sequence, content)) => version(sequence, content, 1, false),
            (Copy::Unreadable(e), _) | (_, Copy::Unreadable(e)) => Err(e),
            (Copy::Damaged(what), _) | (_, Copy::Damaged(what)) => Ok(Err(what)),
            (Copy::Missing, Copy::Missing) => Ok(Ok(None)),
        }
    }

    /// Makes a version that was read durable: a killed process may have left it unsynced.
    pub(crate) fn settle(&self, files: &dyn Files, version: &Version) -> io::Result<()> {
        files.sync(&self.path(version.index))?;
        files.sync_dir(&self.dir)
    }

    /// Makes the other copy equal to a settled version.
    ///
    /// # Errors
    /// The file system's; the version itself is not touched.
    pub fn heal(&self, files: &dyn Files, version: &mut Version) -> io::Result<()> {
        if !version.is_twice {
            self.write_one(files, 1 - version.index, version.sequence, &version.content)?;
            version.is_twice = true;
        }
        Ok(())
    }

    /// Writes the next version, durably. `present`: the settled version, if there is one.
    ///
    /// # Errors
    /// The file system's; the present or the next version is whole.
    pub fn write(
        &self,
        files: &dyn Files,
        present: Option<&Version>,
        content: Vec<u8>,
    ) -> io::Result<Version> {
        let sequence = present.map_or(1, |present| present.sequence.saturating_add(1));
        let index = present.map_or(0, |present| 1 - present.index);
        let (mut written, mut broken) = (Vec::new(), None);
        for index in [index, 1 - index] {
            match self.write_one(files, index, sequence, &content) {
                Ok(()) => written.push(index),
                // If one copy cannot be replaced, the other must do.
                Err(e) if is_bad_medium(&e) => broken = Some(e),
                Err(e) => return Err(e),
            }
        }
        let Some(index) = written.first().copied() else { return Err(broken.expect("neither was written")) };
        Ok(Version { sequence, content, index, is_twice: written.len() == 2 })
    }

    fn write_one(&self, files: &dyn Files, index: usize, sequence: u64, content: &[u8]) -> io::Result<()> {
        // Renamed into place, so that a power cut leaves no half of the first copy ever written.
        put_through(files, &self.dir.join("new"), &copy_of(sequence, content), &self.path(index))
    }
}

fn copy_of(sequence: u64, content: &[u8]) -> Vec<u8> {
    let counted = [format!("{sequence}\n").as_bytes(), content].concat();
    let head = format!("slag-record 1 {sequence} {}\n", Hash32::of(&counted));
    [head.as_bytes(), content].concat()
}

fn parse(bytes: &[u8]) -> Copy {
    let read = || {
        let end = bytes.iter().position(|b| *b == b'\n')?;
        let words: Vec<&str> = std::str::from_utf8(&bytes[..end]).ok()?.split(' ').collect();
        let ["slag-record", "1", sequence, _] = words[..] else { return None };
        Some((sequence.parse::<u64>().ok()?, &bytes[end + 1..]))
    };
    match read() {
        // Numbers have several spellings; only the canonical one is valid.
        Some((sequence, content)) if copy_of(sequence, content) == bytes => {
            Copy::Whole(sequence, content.to_vec())
        }
        Some(_) => Copy::Damaged("the content does not match its checksum".into()),
        None => Copy::Damaged("line 1 is not `slag-record 1 SEQUENCE HASH`".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::files::DiskFiles;

    fn written(contents: &[&str]) -> (tempfile::TempDir, Copies) {
        let dir = tempfile::tempdir().expect("a folder");
        let copies = Copies { dir: dir.path().to_owned() };
        let mut present = None;
        for content in contents {
            let content = content.as_bytes().to_vec();
            present = Some(copies.write(&DiskFiles, present.as_ref(), content).expect("written"));
        }
        (dir, copies)
    }

    fn found(copies: &Copies) -> Option<(u64, Vec<u8>, bool)> {
        let version = copies.read(&DiskFiles).expect("readable").ok().flatten()?;
        Some((version.sequence, version.content, version.is_twice))
    }

    /// Every bit of either copy, every length, and a missing copy.
    #[test]
    fn every_fault_of_one_copy_leaves_the_record() {
        let (_dir, copies) = written(&["one", "{\"key\":\"two\"}"]);
        let newest = Some((2, b"{\"key\":\"two\"}".to_vec(), false));
        for index in [0, 1] {
            let path = copies.path(index);
            let whole = fs_err::read(&path).expect("there");
            for bit in 0..whole.len() * 8 {
                let mut flipped = whole.clone();
                flipped[bit / 8] ^= 1 << (bit % 8);
                fs_err::write(&path, flipped).expect("written");
                assert_eq!(found(&copies), newest, "copy {index}, bit {bit}");
            }
            for len in 0..whole.len() {
                fs_err::write(&path, &whole[..len]).expect("written");
                assert_eq!(found(&copies), newest, "copy {index}, {len} bytes");
            }
            fs_err::remove_file(&path).expect("there");
            assert_eq!(found(&copies), newest, "copy {index} gone");
            let mut version = copies.read(&DiskFiles).expect("readable").expect("whole").expect("there");
            copies.heal(&DiskFiles, &mut version).expect("healed");
            assert_eq!(fs_err::read(&path).expect("there"), whole);
        }
    }

    #[test]
    fn damage_is_told_from_absence() {
        let (_dir, copies) = written(&[]);
        assert_eq!(copies.read(&DiskFiles).expect("readable"), Ok(None));
        let (_dir, copies) = written(&["x"]);
        for index in [0, 1] {
            fs_err::write(copies.path(index), vec![b'x'; MAX_COPY_BYTES as usize + 1]).expect("written");
        }
        assert!(copies.read(&DiskFiles).expect("readable").is_err());
        fs_err::remove_file(copies.path(0)).expect("there");
        assert!(copies.read(&DiskFiles).expect("readable").is_err());
    }

    /// Between the two writes the newer copy counts; an older one never does while the newer is whole.
    #[test]
    fn the_newest_whole_copy_counts() {
        let (_dir, copies) = written(&["old"]);
        let old = fs_err::read(copies.path(0)).expect("there");
        let (_other, next) = written(&["old", "new"]);
        let new = fs_err::read(next.path(0)).expect("there");
        for (a, b) in [(&old, &new), (&new, &old)] {
            fs_err::write(copies.path(0), a).expect("written");
            fs_err::write(copies.path(1), b).expect("written");
            assert_eq!(found(&copies), Some((2, b"new".to_vec(), false)));
        }
    }
}
