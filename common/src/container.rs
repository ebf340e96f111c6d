//! The container of all binary files: checksummed sections, little-endian and 64-byte aligned, so that a mapped
//! file is used without parsing. The byte table is in `docs/formats.md`.

use std::io::{self, Write};
use std::ops::Range;

use bytemuck::{AnyBitPattern, NoUninit};

/// Alignment of sections: a mapped file can be cast to any column type.
pub const ALIGNMENT_BYTES: usize = 64;
/// Bytes before the section table.
pub const PREAMBLE_BYTES: usize = 32;
pub const SECTION_ROW_BYTES: usize = 32;
/// Largest number of sections accepted: more than any format has.
pub const MAX_SECTIONS: u32 = 64;

#[cfg(target_endian = "big")]
compile_error!("the on-disk columns are used in place and are little-endian");

#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ContainerError {
    #[error(
        "the file has {found_bytes} bytes, expected {expected_bytes}: it is truncated; delete it, and it is made or fetched again"
    )]
    Length { expected_bytes: u64, found_bytes: u64 },
    #[error(
        "byte 0: magic {found:02x?}, expected {expected:02x?}: this is another kind of file; check the path"
    )]
    Magic { expected: [u8; 8], found: [u8; 8] },
    #[error(
        "byte 8: format version {found}, expected {expected}; use a program of the matching version, or encode again"
    )]
    Version { expected: u32, found: u32 },
    #[error("byte {offset_bytes}: {what}; the file is damaged: delete it, and it is made or fetched again")]
    Damaged { offset_bytes: u64, what: String },
    #[error(
        "section {id} at byte {offset_bytes}: checksum {found:#018x}, expected {expected:#018x}; the file is damaged: delete it, and it is made or fetched again"
    )]
    Checksum { id: u32, offset_bytes: u64, expected: u64, found: u64 },
    #[error(
        "section {id} ({name}) is missing; the file was written by another version of this program: encode again"
    )]
    Missing { id: u32, name: &'static str },
}

/// The first eight bytes of the BLAKE3 hash, little-endian.
fn checksum(bytes: &[u8]) -> u64 {
    let hash = blake3::hash(bytes);
    u64::from_le_bytes(hash.as_bytes()[..8].try_into().expect("a hash has 32 bytes"))
}

fn align_up(n: usize) -> usize {
    n.next_multiple_of(ALIGNMENT_BYTES)
}

/// Writes a container: preamble, table, then each section padded with zeros to 64 bytes.
pub fn write(mut out: impl Write, magic: [u8; 8], version: u32, sections: &[(u32, &[u8])]) -> io::Result<()> {
    let mut offset = align_up(PREAMBLE_BYTES + SECTION_ROW_BYTES * sections.len());
    let mut table = Vec::with_capacity(SECTION_ROW_BYTES * sections.len());
    for (id, bytes) in sections {
        table.extend(id.to_le_bytes());
        table.extend(0u32.to_le_bytes());
        table.extend((offset as u64).to_le_bytes());
        table.extend((bytes.len() as u64).to_le_bytes());
        table.extend(checksum(bytes).to_le_bytes());
        offset = align_up(offset + bytes.len());
    }
    let mut head = Vec::with_capacity(PREAMBLE_BYTES + table.len());
    head.extend(magic);
    head.extend(version.to_le_bytes());
    head.extend((sections.len() as u32).to_le_bytes());
    head.extend((offset as u64).to_le_bytes());
    let head_checksum = checksum(&[head.as_slice(), &table].concat());
    head.extend(head_checksum.to_le_bytes());
    head.extend(table);
    let zeros = [0; ALIGNMENT_BYTES];
    out.write_all(&head)?;
    out.write_all(&zeros[..align_up(head.len()) - head.len()])?;
    for (_, bytes) in sections {
        out.write_all(bytes)?;
        out.write_all(&zeros[..align_up(bytes.len()) - bytes.len()])?;
    }
    Ok(())
}

/// Checks preamble and table against their checksum; returns the number of sections.
fn check_head(bytes: &[u8], magic: [u8; 8], version: u32) -> Result<usize, ContainerError> {
    let length =
        |expected_bytes: u64| Err(ContainerError::Length { expected_bytes, found_bytes: bytes.len() as u64 });
    if bytes.len() < PREAMBLE_BYTES {
        return length(PREAMBLE_BYTES as u64);
    }
    if bytes[..8] != magic {
        let found = bytes[..8].try_into().expect("eight bytes");
        return Err(ContainerError::Magic { expected: magic, found });
    }
    let found = read_u32(bytes, 8);
    if found != version {
        return Err(ContainerError::Version { expected: version, found });
    }
    let n_sections = read_u32(bytes, 12);
    if n_sections > MAX_SECTIONS {
        return Err(damaged(12, format!("{n_sections} sections, expected at most {MAX_SECTIONS}")));
    }
    let head_bytes = PREAMBLE_BYTES + n_sections as usize * SECTION_ROW_BYTES;
    let file_bytes = read_u64(bytes, 16);
    if file_bytes != bytes.len() as u64 || bytes.len() < head_bytes {
        return length(file_bytes);
    }
    let expected = read_u64(bytes, 24);
    let found = checksum(&[&bytes[..24], &bytes[PREAMBLE_BYTES..head_bytes]].concat());
    if expected != found {
        let what = format!("checksum of preamble and table {found:#018x}, expected {expected:#018x}");
        return Err(damaged(24, what));
    }
    Ok(n_sections as usize)
}

pub(crate) fn damaged(offset: usize, what: impl Into<String>) -> ContainerError {
    ContainerError::Damaged { offset_bytes: offset as u64, what: what.into() }
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layout {
    sections: Vec<(u32, Range<usize>)>,
}

impl Layout {
    /// Checks a whole container (bounds, table, every checksum) and returns the places of its sections.
    pub fn check(bytes: &[u8], magic: [u8; 8], version: u32) -> Result<Self, ContainerError> {
        let layout = Self::check_table(bytes, magic, version)?;
        for (row, (id, range)) in layout.sections.iter().enumerate() {
            let at = PREAMBLE_BYTES + row * SECTION_ROW_BYTES + 24;
            let expected = read_u64(bytes, at);
            let found = checksum(&bytes[range.clone()]);
            if expected != found {
                let offset_bytes = range.start as u64;
                return Err(ContainerError::Checksum { id: *id, offset_bytes, expected, found });
            }
        }
        Ok(layout)
    }

    /// Checks preamble and table only.
    ///
    /// # Errors
    /// As [`Layout::check`], without the checksums of the sections.
    pub fn check_table(bytes: &[u8], magic: [u8; 8], version: u32) -> Result<Self, ContainerError> {
        let n_sections = check_head(bytes, magic, version)?;
        let file_bytes = bytes.len() as u64;
        let mut end = align_up(PREAMBLE_BYTES + n_sections * SECTION_ROW_BYTES);
        let mut sections = Vec::with_capacity(n_sections);
        for row in 0..n_sections {
            let at = PREAMBLE_BYTES + row * SECTION_ROW_BYTES;
            let (id, start, len) = (read_u32(bytes, at), read_u64(bytes, at + 8), read_u64(bytes, at + 16));
            // Sections follow in table order without gaps, so none can overlap another or the table.
            let stop = start.checked_add(len).filter(|stop| *stop <= file_bytes);
            let (true, Some(stop)) = (start == end as u64, stop) else {
                let what = format!(
                    "section {id} has offset {start} and length {len}, expected offset {end} and an end within {file_bytes} bytes"
                );
                return Err(damaged(at, what));
            };
            if sections.iter().any(|(other, _)| *other == id) {
                return Err(damaged(at, format!("section {id} occurs twice")));
            }
            sections.push((id, start as usize..stop as usize));
            end = align_up(stop as usize);
        }
        if end as u64 != file_bytes {
            let what = format!("the file has {file_bytes} bytes, but its sections end at {end}");
            return Err(damaged(16, what));
        }
        Ok(Self { sections })
    }

    pub fn find(&self, id: u32) -> Option<Range<usize>> {
        self.sections.iter().find(|(other, _)| *other == id).map(|(_, range)| range.clone())
    }

    /// Returns the values of a section that was checked; none without it.
    ///
    /// # Panics
    /// If `bytes` are shorter than those checked, or do not start at an aligned address.
    pub(crate) fn slice<'a, T: AnyBitPattern + NoUninit>(&self, bytes: &'a [u8], id: u32) -> &'a [T] {
        self.find(id).map_or(&[], |range| bytemuck::cast_slice(&bytes[range]))
    }

    /// Returns the place of a section, which must hold `expected_len` values of `T`.
    pub fn column<T>(
        &self,
        id: u32,
        name: &'static str,
        expected_len: usize,
    ) -> Result<Range<usize>, ContainerError> {
        let range = self.find(id).ok_or(ContainerError::Missing { id, name })?;
        let expected_bytes = expected_len.checked_mul(size_of::<T>());
        if expected_bytes != Some(range.len()) {
            let what = format!(
                "section {id} ({name}) has {} bytes, expected {expected_len} values of {} bytes",
                range.len(),
                size_of::<T>()
            );
            return Err(damaged(range.start, what));
        }
        Ok(range)
    }

    pub fn value<T: AnyBitPattern>(
        &self,
        bytes: &[u8],
        id: u32,
        name: &'static str,
    ) -> Result<T, ContainerError> {
        Ok(bytemuck::pod_read_unaligned(&bytes[self.column::<T>(id, name, 1)?]))
    }

    pub fn values<T: AnyBitPattern + NoUninit>(
        &self,
        bytes: &[u8],
        id: u32,
        name: &'static str,
        expected_len: usize,
    ) -> Result<Vec<T>, ContainerError> {
        Ok(bytemuck::pod_collect_to_vec(&bytes[self.column::<T>(id, name, expected_len)?]))
    }
}

/// Returns the byte range of a section from the start of a file; nothing is validated.
pub(crate) fn section_by_start(start: &[u8], magic: [u8; 8], id: u32) -> Option<Range<usize>> {
    let rows = start.get(PREAMBLE_BYTES..)?.chunks_exact(SECTION_ROW_BYTES);
    let n_sections = read_u32(start, 12).min(MAX_SECTIONS) as usize;
    let row = rows.take(n_sections).find(|row| start.starts_with(&magic) && read_u32(row, 0) == id)?;
    let at = usize::try_from(read_u64(row, 8)).ok()?;
    Some(at..at.checked_add(usize::try_from(read_u64(row, 16)).ok()?)?)
}

fn read_u32(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"))
}

fn read_u64(bytes: &[u8], at: usize) -> u64 {
    u64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight bytes"))
}

/// Bytes aligned for every column type, for files that are read, not mapped.
#[derive(Clone, Debug, Default)]
pub struct AlignedBytes {
    blocks: Vec<Block>,
    len: usize,
}

#[derive(Clone, Copy, Debug, bytemuck::Zeroable, bytemuck::Pod)]
#[repr(C, align(64))]
struct Block([u8; ALIGNMENT_BYTES]);

impl AlignedBytes {
    pub fn read(path: &std::path::Path) -> io::Result<Self> {
        let file = fs_err::File::open(path)?;
        let len = file.metadata()?.len() as usize;
        Self::read_from(file, len)
    }

    pub fn read_from(mut reader: impl io::Read, len: usize) -> io::Result<Self> {
        let mut blocks = vec![Block([0; ALIGNMENT_BYTES]); len.div_ceil(ALIGNMENT_BYTES)];
        reader.read_exact(&mut bytemuck::cast_slice_mut::<Block, u8>(&mut blocks)[..len])?;
        Ok(Self { blocks, len })
    }

    pub fn copy_of(bytes: &[u8]) -> Self {
        let mut blocks = vec![Block([0; ALIGNMENT_BYTES]); bytes.len().div_ceil(ALIGNMENT_BYTES)];
        bytemuck::cast_slice_mut::<Block, u8>(&mut blocks)[..bytes.len()].copy_from_slice(bytes);
        Self { blocks, len: bytes.len() }
    }
}

impl std::ops::Deref for AlignedBytes {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.blocks)[..self.len]
    }
}

pub fn bytes_of<T: NoUninit>(column: &[T]) -> &[u8] {
    bytemuck::cast_slice(column)
}

#[cfg(test)]
mod tests {
    use super::*;

    const MAGIC: [u8; 8] = *b"SLAGTEST";

    fn sample() -> Vec<u8> {
        let mut out = Vec::new();
        let long: Vec<u32> = (0..100).collect();
        write(&mut out, MAGIC, 3, &[(1, b"abc"), (7, bytes_of(&long)), (9, b"")]).expect("writes to memory");
        out
    }

    #[test]
    fn sections_come_back_aligned() {
        let bytes = AlignedBytes::copy_of(&sample());
        let layout = Layout::check(&bytes, MAGIC, 3).expect("valid");
        assert_eq!(&bytes[layout.find(1).expect("there")], b"abc");
        let column: &[u32] =
            bytemuck::cast_slice(&bytes[layout.column::<u32>(7, "long", 100).expect("there")]);
        assert_eq!(column[99], 99);
        assert!(layout.column::<u32>(7, "long", 101).is_err());
        assert_eq!(layout.find(9).expect("there").len(), 0);
    }

    /// `docs/formats.md`: a section can be added without a new version, and columns are found as before.
    #[test]
    fn unknown_sections_are_skipped() {
        let mut out = Vec::new();
        write(&mut out, MAGIC, 3, &[(4_000_000_000, b"later"), (1, b"abc"), (8, b"")])
            .expect("writes to memory");
        let layout = Layout::check(&out, MAGIC, 3).expect("valid");
        assert_eq!(&out[layout.find(1).expect("there")], b"abc");
        assert_eq!(layout.find(7), None);
    }

    /// Offsets by hand: each section begins at the next multiple of 64, and all bytes outside sections are zero.
    #[test]
    fn padding_is_zero_up_to_a_multiple_of_64() {
        let mut out = Vec::new();
        write(&mut out, MAGIC, 3, &[(1, b"abc"), (7, &[9; 64]), (9, &[8; 65])]).expect("writes to memory");
        let layout = Layout::check(&out, MAGIC, 3).expect("valid");
        // The table ends at 32 + 3 * 32 = 128.
        let ranges: Vec<_> = layout.sections.iter().map(|(_, range)| range.clone()).collect();
        assert_eq!((ranges, out.len()), (vec![128..131, 192..256, 256..321], 384));
        assert!(out[131..192].iter().chain(&out[321..]).all(|byte| *byte == 0));
    }

    /// Every truncation and every flipped bit is refused: checksums cover the whole file but its zero padding.
    #[test]
    fn every_truncation_and_flipped_bit_is_refused() {
        let bytes = sample();
        for len in 0..bytes.len() {
            assert!(Layout::check(&bytes[..len], MAGIC, 3).is_err(), "cut to {len}");
        }
        let layout = Layout::check(&bytes, MAGIC, 3).expect("valid");
        let head = PREAMBLE_BYTES + 3 * SECTION_ROW_BYTES;
        for at in 0..bytes.len() {
            let covered = at < head || layout.sections.iter().any(|(_, range)| range.contains(&at));
            for bit in 0..8 {
                let mut flipped = bytes.clone();
                flipped[at] ^= 1 << bit;
                assert_eq!(Layout::check(&flipped, MAGIC, 3).is_err(), covered, "byte {at} bit {bit}");
            }
        }
    }
}
