//! Runs every fuzz target on seeds, on the corpus of coverage-guided fuzzing (`fuzz/corpus`), and on thousands of
//! seeded mutations of both. `SLAG_FUZZ_SECS` sets seconds per target instead of a number of mutations.

use super::*;
use std::panic::{AssertUnwindSafe, catch_unwind};

#[path = "../fuzz/src/lib.rs"]
mod targets;

use slag_test_support::{memory_of, shared_folder};

/// Memory that a decoder may take in addition to [`MAX_EXPANSION`] times its input: buffers and small images.
const FREE_BYTES: usize = 64 << 20;
const MAX_EXPANSION: usize = 256;
/// Mutations per target; those that write files and decode images take longest.
const N_MUTATIONS: u64 = 3000;
const INTERESTING: [u64; 12] =
    [0, 1, 2, 0x7f, 0x80, 0xff, 0xffff, 0x7fff_ffff, 0x8000_0000, 0xffff_ffff, u64::MAX >> 1, u64::MAX];

/// Mutates a seed: bits, numbers, digits, truncation, copies, pieces of another seed. Half of the time it is one
/// of the first `n_valid`, because few mutations of refused inputs are accepted.
fn mutated(seeds: &[Vec<u8>], n_valid: usize, random: &mut Random) -> Vec<u8> {
    let n = if random.below(2) == 0 { n_valid } else { seeds.len() };
    let mut bytes = seeds[random.below(n)].clone();
    for _ in 0..1 + random.below(4) {
        let at = random.below(bytes.len());
        match random.below(9) {
            0 | 1 if !bytes.is_empty() => bytes[at] ^= 1 << random.below(8),
            2 if !bytes.is_empty() => bytes[at] = random.bits() as u8,
            3 | 4 => {
                let width = [1, 2, 4, 8][random.below(4)];
                let value = INTERESTING[random.below(INTERESTING.len())].to_le_bytes();
                // Most numbers are aligned.
                let at = if random.below(2) == 0 { at } else { at / width * width };
                let end = (at + width).min(bytes.len());
                bytes[at..end].copy_from_slice(&value[..end - at]);
            }
            5 => {
                // Text: a digit, a sign or a long number.
                let piece: &[u8] =
                    [b"-".as_slice(), b"9", b"1e999", b"NaN", b"99999999999999999999", b"\"", b"{"]
                        [random.below(7)];
                let end = (at + random.below(3)).min(bytes.len());
                bytes.splice(at..end, piece.iter().copied());
            }
            6 => bytes.truncate(at),
            7 => {
                let end = (at + random.below(64)).min(bytes.len());
                let piece = bytes[at..end].to_vec();
                let to = random.below(bytes.len() + 1);
                bytes.splice(to..to, piece);
            }
            _ => {
                let other = &seeds[random.below(seeds.len())];
                let from = random.below(other.len());
                let piece = &other[from..(from + random.below(64)).min(other.len())];
                let end = (at + piece.len()).min(bytes.len());
                bytes.splice(at..end, piece.iter().copied());
            }
        }
    }
    bytes
}

/// Inputs that coverage-guided fuzzing kept for a target, sorted by name.
fn corpus(name: &str) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus").join(name);
    let Ok(entries) = fs_err::read_dir(folder) else { return Vec::new() };
    let mut paths: Vec<_> = entries.map(|entry| entry.expect("readable").path()).collect();
    paths.sort();
    paths.iter().map(|path| fs_err::read(path).expect("readable")).collect()
}

#[test]
fn no_decoder_panics() {
    let folder = shared_folder();
    let budget = std::env::var("SLAG_FUZZ_SECS")
        .ok()
        .map(|secs| Duration::from_secs(secs.parse().expect("SLAG_FUZZ_SECS is a number of seconds")));
    let mut without_valid_seed = Vec::new();
    for target in targets::TARGETS {
        let mut seeds = targets::seeds::of(target.name, folder.as_deref());
        assert!(!seeds.is_empty() || folder.is_none(), "{} has no seeds", target.name);
        if seeds.is_empty() {
            continue;
        }
        let start = Instant::now();
        let mut random = Random::new(7);
        let (mut n, mut largest_bytes) = (0, 0);
        let mut n_accepted = seeds.iter().filter(|seed| (target.run)(seed)).count();
        if n_accepted == 0 {
            without_valid_seed.push(target.name);
        }
        let n_valid = seeds.len();
        let mut corpus = corpus(target.name);
        seeds.extend_from_slice(&corpus);
        while !corpus.is_empty() || budget.map_or(n < N_MUTATIONS, |budget| start.elapsed() < budget) {
            let input = corpus.pop().unwrap_or_else(|| mutated(&seeds, n_valid, &mut random));
            let run = || catch_unwind(AssertUnwindSafe(|| targets::run(target.name, &input)));
            let (ended, taken) = memory_of(run);
            let peak_bytes = taken.peak_bytes;
            let message = || format!("{} at mutation {n}; the input: {}", target.name, input.escape_ascii());
            n_accepted += usize::from(ended.unwrap_or_else(|_| panic!("{}", message())));
            largest_bytes = largest_bytes.max(peak_bytes);
            let limit_bytes = FREE_BYTES + input.len() * MAX_EXPANSION;
            assert!(peak_bytes <= limit_bytes, "{peak_bytes} bytes of memory: {}", message());
            n += 1;
        }
        println!(
            "{}: {n} mutations of {} seeds, {n_accepted} accepted, at most {largest_bytes} bytes, in {:.1?}",
            target.name,
            seeds.len(),
            start.elapsed()
        );
    }
    // Mutations of refused seeds test little.
    assert!(without_valid_seed.is_empty(), "no seed is accepted: {without_valid_seed:?}");
}
