//! Damaged files of every format give an error that names the file, or consistent columns; never a panic, and
//! never memory out of proportion.

use std::io::Read;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use slag_math::random::Random;
use slag_test_support::{memory_of, trials};

use super::generated::{gzip, write_sog_v1};
use super::{assert_columns_agree, needs_shared, read_all, read_bytes, shared};

/// Damages a file: truncates it, flips bits, overwrites a word with an extreme value, or changes a digit. Half of
/// the places lie near the front, among the headers.
fn damaged(bytes: &[u8], random: &mut Random) -> Vec<u8> {
    let mut out = bytes.to_vec();
    let n_changes = 1 + random.below(4);
    for _ in 0..n_changes {
        let reach = if random.below(2) == 0 { out.len().min(1500) } else { out.len() };
        if reach == 0 {
            break;
        }
        let at = random.below(reach);
        match random.below(8) {
            0 => out.truncate(at),
            1 => {
                let word = [u32::MAX, 0, 1 << 31, 0x00FF_FFFF, 1 << 20][random.below(5)].to_le_bytes();
                out.iter_mut().skip(at).zip(word).for_each(|(byte, new)| *byte = new);
            }
            2 => {
                let digits: Vec<_> = (0..reach).filter(|i| out[*i].is_ascii_digit()).collect();
                if !digits.is_empty() {
                    let digit = digits[random.below(digits.len())];
                    out[digit] = b"0123456789eE-. "[random.below(15)];
                }
            }
            _ => out[at] ^= 1 << random.below(8),
        }
    }
    out
}

/// Reads `path` (`len_bytes` in all its files) and asserts what the module states; returns whether it was read.
fn assert_survives(path: &Path, len_bytes: usize, what: &str) -> bool {
    let (result, taken) = memory_of(|| catch_unwind(AssertUnwindSafe(|| read_all(path))));
    let result = result.unwrap_or_else(|_| panic!("{what}: panicked"));
    let most = (64 << 20) + 64 * len_bytes;
    assert!(taken.peak_bytes <= most, "{what}: {taken:?} for {len_bytes} bytes");
    match result {
        Ok(gaussians) => {
            assert_columns_agree(&gaussians);
            true
        }
        Err(error) => {
            let text = error.to_string();
            let folder = path.parent().expect("a file").display().to_string();
            assert!(text.contains(&folder), "{what}: {text}");
            false
        }
    }
}

/// Damages the content of a file `n` times, and a fifth as often outside the nightly checks; `pack` turns the
/// damaged content into the file.
fn survives_damage(name: &str, content: &[u8], n: u64, pack: impl Fn(&[u8]) -> Vec<u8>) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join(name);
    let n = trials(n / 5, n);
    let mut n_read = 0;
    for seed in 1..=n {
        let file = pack(&damaged(content, &mut Random::new(seed)));
        std::fs::write(&path, &file).expect("the temporary folder can be written");
        n_read += usize::from(assert_survives(&path, file.len(), &format!("{name}, seed {seed}")));
        // Overwriting instead would make ext4 wait for the disk.
        std::fs::remove_file(&path).expect("was written");
    }
    println!("{name}: {n_read} of {n} still read");
}

fn fixture(name: &str) -> Vec<u8> {
    std::fs::read(shared("fixtures/formats").join(name)).expect("the fixture is there")
}

#[needs_shared]
#[test]
fn damaged_files_as_they_are() {
    for name in [
        "gsplatrs_minimal_ascii.ply",
        "gsplatrs_minimal_binary.ply",
        "playbot_lod6.ply",
        "playbot_lod6.compressed.ply",
        "minimal-v2.spz",
        "minimal-v3.spz",
        "minimal-v4.spz",
        "gsplatrs_minimal_v4_degree0.spz",
        "playbot_lod6_v3.spz",
        "playbot_lod6_v4.spz",
        "minimal.splat",
        "playbot_lod6.splat",
        "playbot_lod6.sog",
    ] {
        let bytes = fixture(name);
        survives_damage(name, &bytes, 1000, <[u8]>::to_vec);
    }
}

/// More rows than the header counts, or two columns of a name, would be half read in silence.
#[needs_shared]
#[test]
fn files_that_go_on_behind_their_last_row_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let spz = fixture("playbot_lod6_v3.spz");
    let mut content = Vec::new();
    flate2::read::GzDecoder::new(&spz[..]).read_to_end(&mut content).expect("unpacks");
    let longer = |bytes: &[u8]| [bytes, &[7; 400]].concat();
    let (ascii, plain) = (fixture("gsplatrs_minimal_ascii.ply"), fixture("playbot_lod6.ply"));
    let rows = ascii.windows(11).position(|w| w == b"end_header\n").expect("a header") + 11;
    for (name, bytes) in [
        ("plain.ply", longer(&plain)),
        ("ascii.ply", [&ascii, &b"\n"[..], &ascii[rows..]].concat()),
        ("packed.ply", longer(&fixture("playbot_lod6.compressed.ply"))),
        ("whole.spz", gzip(&longer(&content))),
    ] {
        let error = read_bytes(folder.path(), name, &bytes).expect_err(name).to_string();
        assert!(error.contains("expected the end of the"), "{error}");
    }
    read_bytes(folder.path(), "blank.ply", &[&plain[..], b"\n"].concat()).expect("reads");
    let (from, to) = ("property float opacity\n", "property float opacity\nproperty float opacity\n");
    let twice = String::from_utf8(ascii).expect("text").replacen(from, to, 1);
    let error = read_bytes(folder.path(), "twice.ply", twice.as_bytes()).expect_err("is refused").to_string();
    assert!(error.contains("a property that the element does not have yet"), "{error}");
}

/// Damage inside an intact gzip stream; its checksum would otherwise catch the damage.
#[needs_shared]
#[test]
fn damaged_spz_in_intact_gzip() {
    for name in ["minimal-v2.spz", "playbot_lod6_v3.spz"] {
        let bytes = fixture(name);
        let mut content = Vec::new();
        flate2::read::GzDecoder::new(&bytes[..]).read_to_end(&mut content).expect("unpacks");
        survives_damage(name, &content, 1000, gzip);
    }
}

/// Damage in one file of a folder; the checksums of a bundle would otherwise catch it.
#[needs_shared]
#[test]
fn damaged_sog_folders() {
    let folder = tempfile::tempdir().expect("a folder");
    let bytes = fixture("playbot_lod6.sog");
    let v2 = folder.path().join("v2");
    zip::ZipArchive::new(std::io::Cursor::new(bytes)).expect("opens").extract(&v2).expect("unpacks");
    let v1 = folder.path().join("v1");
    std::fs::create_dir(&v1).expect("the temporary folder can be written");
    write_sog_v1(&v1);
    for folder in [v1, v2] {
        let mut files: Vec<_> =
            std::fs::read_dir(&folder).expect("lists").map(|f| f.expect("lists").path()).collect();
        files.sort();
        let intact: Vec<_> = files.iter().map(|file| std::fs::read(file).expect("reads")).collect();
        let len_bytes = intact.iter().map(Vec::len).sum();
        let mut n_read = 0;
        for seed in 1..=1000 {
            let index = seed as usize % files.len();
            let bytes = damaged(&intact[index], &mut Random::new(seed));
            std::fs::remove_file(&files[index]).expect("was written");
            std::fs::write(&files[index], bytes).expect("writes");
            let what = format!("{}, seed {seed}", files[index].display());
            n_read += usize::from(assert_survives(&folder.join("meta.json"), len_bytes, &what));
            std::fs::remove_file(&files[index]).expect("was written");
            std::fs::write(&files[index], &intact[index]).expect("writes");
        }
        println!("{}: {n_read} of 1000 still read", folder.display());
    }
}
