//! A file that is read front to back and knows its offset and the bytes that remain.

use std::io::{self, BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

use super::error::{Place, SplatError};
use crate::files;

/// Makes system calls negligible, and is small compared with the columns.
const BUFFER_BYTES: usize = 1 << 18;

pub(super) struct Input {
    reader: BufReader<fs_err::File>,
    path: PathBuf,
    len_bytes: u64,
    offset_bytes: u64,
}

impl Input {
    pub fn open(path: &Path) -> Result<Self, SplatError> {
        let file = files::open(path)?;
        let metadata = file.metadata()?;
        if !metadata.is_file() {
            let format = "what is no file, such as a pipe or a device,".to_owned();
            return Err(SplatError::Unsupported {
                path: path.into(),
                format,
                advice: "write it into a file first",
            });
        }
        let len_bytes = metadata.len();
        Ok(Self {
            reader: BufReader::with_capacity(BUFFER_BYTES, file),
            path: path.into(),
            len_bytes,
            offset_bytes: 0,
        })
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    pub fn len_bytes(&self) -> u64 {
        self.len_bytes
    }

    pub fn remaining_bytes(&self) -> u64 {
        self.len_bytes.saturating_sub(self.offset_bytes)
    }

    pub fn place(&self) -> Place {
        Place::Byte(self.offset_bytes)
    }

    /// Returns up to `n` bytes without consuming them. Only for small `n` and a file just opened.
    pub fn peek(&mut self, n: usize) -> Result<&[u8], SplatError> {
        let buffered = self.reader.fill_buf()?;
        Ok(&buffered[..n.min(buffered.len())])
    }

    /// Fills `buffer`; the error of a file that ends too early says that `what` was expected.
    pub fn fill(&mut self, buffer: &mut [u8], what: &str) -> Result<(), SplatError> {
        self.require(buffer.len() as u64, what)?;
        Ok(self.read_exact(buffer)?)
    }

    pub fn skip(&mut self, n: u64, what: &str) -> Result<(), SplatError> {
        self.require(n, what)?;
        self.reader.seek_relative(n as i64)?;
        self.offset_bytes += n;
        Ok(())
    }

    pub fn require(&self, n: u64, what: &str) -> Result<(), SplatError> {
        if n <= self.remaining_bytes() {
            return Ok(());
        }
        Err(SplatError::malformed(
            &self.path,
            self.place(),
            format_args!("{n} bytes of {what}"),
            format_args!("{} up to the end of the file", self.remaining_bytes()),
        ))
    }

    /// Checks that nothing but blanks remains.
    pub fn require_end(&mut self) -> Result<(), SplatError> {
        loop {
            let bytes = self.fill_buf()?;
            let n = bytes.len();
            if n == 0 {
                return Ok(());
            }
            if !bytes.trim_ascii().is_empty() {
                let left = format_args!("{} more bytes", self.remaining_bytes());
                return Err(SplatError::malformed(&self.path, self.place(), "the end of the file", left));
            }
            self.consume(n);
        }
    }

    /// Reads a line with its line feed, at most `limit_bytes`; `line` is empty at the end of the file.
    pub fn read_line(&mut self, line: &mut Vec<u8>, limit_bytes: u64) -> Result<(), SplatError> {
        line.clear();
        Ok(self.take(limit_bytes).read_until(b'\n', line).map(drop)?)
    }
}

impl Read for Input {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let n = self.reader.read(buffer)?;
        self.offset_bytes += n as u64;
        Ok(n)
    }
}

impl BufRead for Input {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        self.reader.fill_buf()
    }

    fn consume(&mut self, n: usize) {
        self.reader.consume(n);
        self.offset_bytes += n as u64;
    }
}
