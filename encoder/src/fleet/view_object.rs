//! The object of a view: its record, the outlines of its masks and its contributions. The contributions come last, as they
//! are in a file, so that cells read them by byte ranges.
//!
//! | bytes | content |
//! |---|---|
//! | 0..8 | `SLAGVIEW` |
//! | 8..12 | version, u32 |
//! | 12..16 | length of the record, u32 |
//! | 16..24 | length of the outlines, u64 |
//! | 24..32 | length of the contributions, u64 |
//! | 32.. | record (JSON), outlines, contributions |

use std::ops::Range;

use crate::encode::fleet_parts::ViewRecord;

const MAGIC: [u8; 8] = *b"SLAGVIEW";
const VERSION: u32 = 1;
const HEAD_BYTES: usize = 32;

/// Returns the object of a view.
pub(super) fn pack(record: ViewRecord, outlines: &[u8], contributions: &[u8]) -> std::io::Result<Vec<u8>> {
    let record = serde_json::to_vec(&record)?;
    let mut bytes = Vec::with_capacity(HEAD_BYTES + record.len() + outlines.len() + contributions.len());
    bytes.extend(MAGIC);
    bytes.extend(VERSION.to_le_bytes());
    bytes.extend((record.len() as u32).to_le_bytes());
    bytes.extend((outlines.len() as u64).to_le_bytes());
    bytes.extend((contributions.len() as u64).to_le_bytes());
    bytes.extend(record);
    bytes.extend(outlines);
    bytes.extend(contributions);
    Ok(bytes)
}

/// The places of an object's parts.
pub(super) struct Unpacked {
    pub(super) record: ViewRecord,
    pub(super) outlines: Range<usize>,
    pub(super) contributions: Range<usize>,
}

/// Finds the parts of an object.
///
/// # Errors
/// What is wrong with it.
pub(super) fn unpack(bytes: &[u8]) -> Result<Unpacked, String> {
    let u64_at = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().expect("eight bytes"));
    let u32_at = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"));
    if bytes.len() < HEAD_BYTES || bytes[..8] != MAGIC || u32_at(8) != VERSION {
        return Err(format!("no view object of version {VERSION}"));
    }
    let ends = [u64::from(u32_at(12)), u64_at(16), u64_at(24)];
    let ends = ends.iter().try_fold(vec![HEAD_BYTES as u64], |mut ends, len| {
        ends.push(ends.last()?.checked_add(*len)?);
        Some(ends)
    });
    match ends.filter(|ends| ends[3] == bytes.len() as u64) {
        Some(ends) => {
            let part = |i: usize| ends[i] as usize..ends[i + 1] as usize;
            let record = serde_json::from_slice(&bytes[part(0)]).map_err(|e| e.to_string())?;
            Ok(Unpacked { record, outlines: part(1), contributions: part(2) })
        }
        None => Err(format!("{} bytes, the head states other lengths", bytes.len())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_come_back_and_a_cut_object_is_refused() {
        let record = ViewRecord { raster_width_px: 640, secs: 0.25 };
        let bytes = pack(record, b"outlines", b"contributions").expect("packs");
        let found = unpack(&bytes).expect("whole");
        assert_eq!(found.record, record);
        assert_eq!(
            (&bytes[found.outlines], &bytes[found.contributions]),
            (&b"outlines"[..], &b"contributions"[..])
        );
        for cut in 0..bytes.len() {
            assert!(unpack(&bytes[..cut]).is_err(), "{cut}");
        }
        let mut huge = bytes.clone();
        huge[24..32].fill(0xff);
        assert!(unpack(&huge).is_err());
    }
}
