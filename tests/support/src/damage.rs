//! Damaged files.

use slag_math::random::Random;

/// Returns a file, not empty, with its end cut off, up to four bits flipped, or up to eight bytes overwritten.
pub fn damaged(bytes: &[u8], random: &mut Random) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    match random.below(3) {
        0 => bytes.truncate(random.below(bytes.len())),
        1 => {
            for _ in 0..=random.below(4) {
                let at = random.below(bytes.len());
                bytes[at] ^= 1 << random.below(8);
            }
        }
        _ => {
            let at = random.below(bytes.len());
            let end = (at + 1 + random.below(8)).min(bytes.len());
            let value = [0xFF, b'9', b'o', 0][random.below(4)];
            bytes[at..end].fill(value);
        }
    }
    bytes
}
