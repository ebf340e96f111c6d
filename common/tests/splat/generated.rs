//! Generated files for cases without a recorded file: SPZ of degree 3 and 4 and its extensions, SOG 1, false counts.

use super::*;

use flate2::Compression;
use flate2::write::GzEncoder;
use image::codecs::webp::WebPEncoder;
use ruzstd::encoding::{CompressionLevel, compress_to_vec};
use slag_test_support::memory_of;

pub fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::fast());
    encoder.write_all(bytes).expect("memory");
    encoder.finish().expect("memory")
}

/// Header of SPZ and the columns of one Gaussian: mean (1, 2, 3) in stored axes, then `sh`.
fn spz_columns(version: u32, degree: u8, sh: &[u8]) -> (Vec<u8>, [Vec<u8>; 6]) {
    let mut header = b"NGSP".to_vec();
    header.extend(version.to_le_bytes());
    header.extend(1_u32.to_le_bytes());
    header.extend([degree, 8, 0, if degree > 0 { 6 } else { 5 }]);
    let position = [1, 2, 3].iter().flat_map(|x: &i32| (x << 8).to_le_bytes()[..3].to_vec()).collect();
    let rotation = vec![0, 0, 0, 0xC0];
    (header, [position, vec![255], vec![128; 3], vec![160; 3], rotation, sh.to_vec()])
}

fn spz_v4(degree: u8, sh: &[u8], extensions: &[u8]) -> Vec<u8> {
    let (mut out, columns) = spz_columns(4, degree, sh);
    out[14] = if extensions.is_empty() { 0 } else { 2 };
    out.extend((32 + extensions.len() as u32).to_le_bytes());
    out.extend([0; 12]);
    out.extend(extensions);
    let columns: Vec<_> = columns.iter().filter(|c| !c.is_empty()).collect();
    let streams: Vec<_> =
        columns.iter().map(|c| compress_to_vec(&c[..], CompressionLevel::Fastest)).collect();
    for (column, stream) in columns.iter().zip(&streams) {
        out.extend((stream.len() as u64).to_le_bytes());
        out.extend((column.len() as u64).to_le_bytes());
    }
    out.extend(streams.concat());
    out
}

/// Real spherical harmonics of degree 1 to 3 with the constants and signs of 3DGS.
fn basis([x, y, z]: [f64; 3]) -> [f64; 15] {
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        -0.488_602_511_9 * y,
        0.488_602_511_9 * z,
        -0.488_602_511_9 * x,
        1.092_548_430_6 * x * y,
        -1.092_548_430_6 * y * z,
        0.315_391_565_3 * (2.0 * zz - xx - yy),
        -1.092_548_430_6 * x * z,
        0.546_274_215_3 * (xx - yy),
        -0.590_043_589_9 * y * (3.0 * xx - yy),
        2.890_611_442_6 * x * y * z,
        -0.457_045_799_5 * y * (4.0 * zz - xx - yy),
        0.373_176_332_6 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.457_045_799_5 * x * (4.0 * zz - xx - yy),
        1.445_305_721_3 * z * (xx - yy),
        -0.590_043_589_9 * x * (xx - 3.0 * yy),
    ]
}

/// Oracle: the colour along a direction does not change when the axes turn.
#[test]
fn spz_harmonics_turn_with_the_axes() {
    for (degree, n) in [(1, 3), (2, 8), (3, 15), (4, 24)] {
        let sh: Vec<u8> = (0..3 * n).map(|i| (i * 37 % 251) as u8).collect();
        let (mut whole, columns) = spz_columns(3, degree, &sh);
        whole.extend(columns.concat());
        let gz = read_well("3.spz", &gzip(&whole));
        let zstd = read_well("4.spz", &spz_v4(degree, &sh, &[]));
        assert_eq!((&gz, &read_well("bare.spz", &whole)), (&zstd, &zstd));
        assert_eq!(gz.means_in_world, [glam::DVec3::new(1.0, -2.0, -3.0)]);
        assert_eq!((gz.sh_degree, gz.opacities[0], gz.scales[0]), (degree.min(3), 1.0, [1.0; 3]));
        assert_eq!(gz.rotations_wxyz, [[1.0, 0.0, 0.0, 0.0]]);
        let [x, y, z] = [0.36, -0.48, 0.8];
        let (stored, turned) = (basis([x, y, z]), basis([x, -y, -z]));
        for channel in 0..3 {
            let kept = gz.sh_rest.len() / 3;
            let before: f64 =
                (0..kept).map(|i| stored[i] * (f64::from(sh[3 * i + channel]) - 128.0) / 128.0).sum();
            let after: f64 = (0..kept).map(|i| turned[i] * f64::from(gz.sh_rest[3 * i + channel])).sum();
            assert_near(after, before, 1e-6, "colour");
        }
    }
}

#[test]
fn spz_in_other_axes_is_refused() {
    let record = |kind: u32, system: u32| [kind, 4, system].map(u32::to_le_bytes).concat();
    let other = [record(0xADBE_0002, 9), record(0xADBE_0003, 6)].concat();
    let same = [record(0xADBE_0002, 9), record(0xADBE_0003, 4)].concat();
    let legacy = |extensions: &[u8]| {
        let (mut whole, columns) = spz_columns(2, 0, &[]);
        whole[14] = 2;
        whole.extend(columns[..4].concat());
        whole.extend([128; 3]);
        whole.extend(extensions);
        gzip(&whole)
    };
    for bytes in [spz_v4(0, &[], &same), legacy(&same)] {
        read_well("same.spz", &bytes);
    }
    for bytes in [spz_v4(0, &[], &other), legacy(&other)] {
        refused("other.spz", &bytes, &["other.spz: SPZ coordinate system 6 is not supported; export it"]);
    }
}

#[test]
fn wrong_checksums_are_refused() {
    let (mut whole, columns) = spz_columns(3, 0, &[]);
    whole.extend(columns.concat());
    let (gz, zstd) = (gzip(&whole), spz_v4(0, &[], &[]));
    // The checksum is 8 bytes before the end of a gzip file, and at the end of a Zstandard frame.
    for (bytes, from_end) in [(gz, 8), (zstd, 4)] {
        read_well("intact.spz", &bytes);
        let mut wrong = bytes.clone();
        wrong[bytes.len() - from_end] ^= 1;
        refused("wrong.spz", &wrong, &["wrong.spz: byte ", "cannot be decompressed"]);
    }
}

#[test]
fn false_counts_are_refused_before_memory_is_reserved() {
    let names = "x y z opacity rot_0 rot_1 rot_2 rot_3 scale_0 scale_1 scale_2 f_dc_0 f_dc_1 f_dc_2";
    let floats: String = names.split(' ').map(|name| format!("property float {name}\n")).collect();
    for encoding in ["ascii", "binary_little_endian"] {
        for count in ["2", "4294967295", "18446744073709551615"] {
            let text =
                format!("ply\nformat {encoding} 1.0\nelement vertex {count}\n{floats}end_header\n1 2 3\n");
            refused("a.ply", text.as_bytes(), &["a.ply: byte ", count]);
        }
    }
    let (mut header, columns) = spz_columns(3, 0, &[]);
    header[8..12].copy_from_slice(&u32::MAX.to_le_bytes());
    refused("a.spz", &gzip(&[header, columns.concat()].concat()), &["Gaussians in", "4294967295"]);
}

/// Streams that inflate far beyond the table of contents are refused without being held in memory.
#[test]
fn zstandard_bombs_are_refused() {
    for (log_window, expected) in [(23, "more than the 1 bytes"), (30, "window_size")] {
        let (mut out, columns) = spz_columns(4, 0, &[]);
        out.extend(32_u32.to_le_bytes());
        out.extend([0; 12]);
        let compress = |column: &Vec<u8>| compress_to_vec(&column[..], CompressionLevel::Fastest);
        let mut streams: Vec<_> = columns[..5].iter().map(compress).collect();
        // 2,000 blocks that repeat a byte 128 KiB times: 250 MiB.
        let mut bomb = vec![0x28, 0xB5, 0x2F, 0xFD, 0x00, (log_window - 10) << 3];
        for block in 0..2000_u32 {
            let header = (128 << 10) << 3 | 1 << 1 | u32::from(block == 1999);
            bomb.extend(&header.to_le_bytes()[..3]);
            bomb.push(0);
        }
        streams[1] = bomb;
        for (column, stream) in columns.iter().zip(&streams) {
            out.extend((stream.len() as u64).to_le_bytes());
            out.extend((column.len() as u64).to_le_bytes());
        }
        out.extend(streams.concat());
        let (result, taken) = memory_of(|| read_bytes("bomb.spz", &out));
        assert_error(result, &["bomb.spz: byte ", expected]);
        assert!(taken.peak_bytes < 40 << 20, "{taken:?}");
    }
}

fn write_webp(path: &Path, width: u32, pixels: &[[u8; 4]]) {
    let file = std::fs::File::create(path).expect("the temporary folder can be written");
    let bytes = pixels.concat();
    let height = pixels.len() as u32 / width;
    WebPEncoder::new_lossless(file)
        .encode(&bytes, width, height, image::ExtendedColorType::Rgba8)
        .expect("encodes");
}

/// Writes a SOG of version 1 with six Gaussians and harmonics of degree 1.
fn write_sog_v1(folder: &Path) {
    let pixel = |seed: u8| -> Vec<[u8; 4]> {
        (0..6)
            .map(|i: u8| [0, 1, 2, 3].map(|c: u8| seed.wrapping_mul(31).wrapping_add(i * 40 + c * 11)))
            .collect()
    };
    for (name, seed) in [("means_l", 1), ("means_u", 2), ("scales", 3), ("sh0", 4)] {
        write_webp(&folder.join(format!("{name}.webp")), 3, &pixel(seed));
    }
    let quats: Vec<_> =
        pixel(5).into_iter().enumerate().map(|(i, [a, b, c, _])| [a, b, c, 250 + i as u8]).collect();
    write_webp(&folder.join("quats.webp"), 3, &quats);
    let labels: Vec<_> = (0..6).map(|i| [i * 20, 0, 0, 255]).collect();
    write_webp(&folder.join("labels.webp"), 3, &labels);
    let codebook: Vec<_> = (0..192 * 2_u32).map(|i| [i as u8, (i / 2) as u8, (i / 3) as u8, 255]).collect();
    write_webp(&folder.join("centroids.webp"), 192, &codebook);
    let meta = r#"{
        "means": {"shape": [6, 3], "mins": [-2, -1, 0], "maxs": [2, 3, 1], "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"mins": [-9, -8, -7], "maxs": [-1, 0, 1], "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"mins": [-1, -2, -3, -8], "maxs": [1, 2, 3, 8], "files": ["sh0.webp"]},
        "shN": {"mins": -0.5, "maxs": 1.5, "files": ["centroids.webp", "labels.webp"]}
    }"#;
    std::fs::write(folder.join("meta.json"), meta).expect("the temporary folder can be written");
}

/// Oracle: the formulas of version 1, applied to the bytes of [`write_sog_v1`].
#[test]
fn sog_version_1() {
    let folder = tempfile::tempdir().expect("a folder");
    write_sog_v1(folder.path());
    let found = read_all(folder.path()).unwrap_or_else(|error| panic!("{error}"));
    assert_eq!((found.len(), found.sh_degree), (6, 1));
    // The text as programs of Windows save it.
    let path = folder.path().join("meta.json");
    let meta = std::fs::read_to_string(&path).expect("was written");
    std::fs::write(&path, format!("\u{feff}{meta}")).expect("writes");
    assert!(read_all(folder.path()).expect("a byte order mark") == found);
    std::fs::write(&path, meta.encode_utf16().flat_map(u16::to_le_bytes).collect::<Vec<u8>>())
        .expect("writes");
    assert_error(read_all(folder.path()), &["UTF-16, expected UTF-8"]);
    for i in 0..6_usize {
        let byte =
            |seed: u8, c: usize| f64::from(seed.wrapping_mul(31).wrapping_add((i * 40 + c * 11) as u8));
        for c in 0..3 {
            let (min, max) = ([-2.0, -1.0, 0.0][c], [2.0, 3.0, 1.0][c]);
            let log: f64 = min + (max - min) * (byte(1, c) + 256.0 * byte(2, c)) / 65535.0;
            let mean = log.signum() * (log.abs().exp() - 1.0);
            assert_near(found.means_in_world[i][c], mean, 1e-12, "mean");
            let log_scale = -9.0 + c as f64 + 8.0 * byte(3, c) / 255.0;
            assert_near(found.scales[i][c].into(), log_scale.exp(), 1e-7, "scale");
            let half = 1.0 + c as f64;
            assert_near(found.sh_dc[i][c].into(), -half + 2.0 * half * byte(4, c) / 255.0, 1e-6, "f_dc");
            for k in 0..3 {
                let codebook = ((i * 20 * 3 + k) / (c + 1)) as u8;
                let expected = -0.5 + 2.0 * f64::from(codebook) / 255.0;
                assert_near(found.sh_rest[(i * 3 + k) * 3 + c].into(), expected, 1e-6, "f_rest");
            }
        }
        let logit = -8.0 + 16.0 * byte(4, 3) / 255.0;
        assert_near(found.opacities[i].into(), 1.0 / (1.0 + (-logit).exp()), 1e-6, "opacity");
        // Tags 250 and 251 are invalid: such rows are kept, unusable.
        assert_eq!(found.is_usable(i), i >= 2, "{i}");
        if let Some(largest) = i.checked_sub(2) {
            let mut others = (0..3).map(|c| (byte(5, c) / 255.0 * 2.0 - 1.0) / 2_f64.sqrt());
            for (c, q) in found.rotations_wxyz[i].into_iter().enumerate() {
                if c == largest {
                    assert!(q >= 0.0);
                } else if i != 2 {
                    assert_near(q.into(), others.next().expect("three"), 1e-6, "rotation");
                }
            }
        }
    }
}

/// A count below that of the images would drop Gaussians silently.
#[test]
fn sog_counts_take_in_all_gaussians() {
    let folder = tempfile::tempdir().expect("a folder");
    write_sog_v1(folder.path());
    let path = folder.path().join("meta.json");
    let meta = std::fs::read_to_string(&path).expect("was written");
    std::fs::write(&path, meta.replace("[6, 3]", "[4, 3]")).expect("writes");
    assert_error(read_all(folder.path()), &["takes in all those of the images, found 4, and more"]);
}

#[test]
fn sog_parts_stay_in_their_folder() {
    let folder = tempfile::tempdir().expect("a folder");
    let inner = folder.path().join("inner");
    std::fs::create_dir(&inner).expect("the temporary folder can be written");
    write_sog_v1(&inner);
    std::fs::rename(inner.join("sh0.webp"), folder.path().join("sh0.webp")).expect("moves");
    let meta = std::fs::read_to_string(inner.join("meta.json")).expect("was written");
    for outside in ["../sh0.webp", "../inner/../sh0.webp", "sub/../../sh0.webp"] {
        std::fs::create_dir_all(inner.join("sub")).expect("the temporary folder can be written");
        std::fs::write(inner.join("meta.json"), meta.replace("sh0.webp", outside)).expect("writes");
        assert_error(read_all(&inner), &["plain file names", outside]);
    }
}

#[test]
fn sog_labels_and_codebooks_out_of_range() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path();
    write_sog_v1(path);
    write_webp(&path.join("labels.webp"), 3, &[[127, 0, 0, 255]; 6]);
    assert_eq!(read_all(path).unwrap_or_else(|e| panic!("{e}")).sh_degree, 1);
    write_webp(&path.join("labels.webp"), 3, &[[128, 0, 0, 255]; 6]);
    assert_error(read_all(path), &["shN: expected labels below 128, found 128"]);
    // Resized images have their Gaussians at other places.
    write_webp(&path.join("labels.webp"), 4, &[[127, 0, 0, 255]; 8]);
    assert_error(read_all(path), &["labels.webp: expected 3 pixels a row, as in the other images, found 4"]);
    write_webp(&path.join("labels.webp"), 3, &[[127, 0, 0, 255]; 6]);

    // Version 2 with a codebook null, 1, ... 255 (PlayCanvas takes 1 + (1 - 255) / 255 for null), and a short one.
    let numbers = |n: usize| (1..n).map(|i| i.to_string()).collect::<Vec<_>>().join(",");
    let meta = std::fs::read_to_string(path.join("meta.json")).expect("was written");
    let start = meta.find("\"scales\"").expect("is there");
    let means = meta[..start].replacen('{', "{\"version\": 2, \"count\": 6,", 1);
    let v2 = format!(
        "{means} \"scales\": {{\"codebook\": [{}], \"files\": [\"scales.webp\"]}},\
         \"quats\": {{\"files\": [\"quats.webp\"]}},\
         \"sh0\": {{\"codebook\": [null,{}], \"files\": [\"sh0.webp\"]}}}}",
        numbers(100),
        numbers(256),
    );
    std::fs::write(path.join("meta.json"), v2).expect("writes");
    write_webp(&path.join("sh0.webp"), 3, &[[0, 1, 255, 51]; 6]);
    write_webp(&path.join("scales.webp"), 3, &[[0, 98, 99, 255]; 6]);
    let found = read_all(path).unwrap_or_else(|e| panic!("{e}"));
    assert_near(found.sh_dc[5][0].into(), 1.0 - 254.0 / 255.0, 1e-7, "null");
    assert_eq!((found.sh_dc[5][1], found.sh_dc[5][2], found.opacities[5]), (1.0, 255.0, 0.2));
    assert_near(f64::from(found.scales[5][0]), 1_f64.exp(), 1e-7, "scale");
    assert!(found.scales[5][2].is_nan() && !found.is_usable(5));
}
