//! NumPy archives (`.npz`): zip files whose members are arrays, `NAME.npy`.
//!
//! `npyz` reads the arrays, but its own archives bring Zstandard and bzip2 in C; NumPy writes neither.

use std::io::{self, BufReader, Read};
use std::path::Path;

use fs_err::File;
use zip::ZipArchive;
use zip::result::ZipError;

pub struct Npz(ZipArchive<BufReader<File>>);

impl Npz {
    pub fn open(path: &Path) -> io::Result<Self> {
        Ok(Self(ZipArchive::new(BufReader::new(File::open(path)?))?))
    }

    /// Returns the bytes of an array, header included, decompressed as they are read; `None` if it is absent.
    pub fn array(&mut self, name: &str) -> io::Result<Option<impl Read + '_>> {
        match self.0.by_name(&format!("{name}.npy")) {
            Ok(member) => Ok(Some(member)),
            Err(ZipError::FileNotFound) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }
}
