//! A file that is read front to back and knows its offset and the bytes that remain.

use std::fmt::Display;
use std::io::{self, BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

use super::error::SplatError;
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
            let format = "what is no file, such as a pipe or a device,";
            return Err(SplatError::unsupported(path, format, "write it into a file first"));
        }
        let reader = BufReader::with_capacity(BUFFER_BYTES, file);
        Ok(Self { reader, path: path.into(), len_bytes: metadata.len(), offset_bytes: 0 })
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

    pub fn place(&self) -> String {
        format!("byte {}", self.offset_bytes)
    }

    pub fn malformed(&self, expected: impl Display, found: impl Display) -> SplatError {
        SplatError::malformed(&self.path, self.place(), expected, found)
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
        let left = self.remaining_bytes();
        let found = format_args!("{left} up to the end of the file");
        Err(self.malformed(format_args!("{n} bytes of {what}"), found))
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
                let left = self.remaining_bytes();
                return Err(self.malformed("the end of the file", format_args!("{left} more bytes")));
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
