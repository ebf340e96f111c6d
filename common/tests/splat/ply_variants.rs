//! PLY files in every encoding, type and order of properties, and the writer.

use super::*;
use slag_common::splat::ply;

/// Returns the properties and rows of a plain PLY of floats, read by a separate parser.
fn rows_of(bytes: &[u8]) -> (Vec<String>, Vec<Vec<f32>>) {
    let end = bytes.windows(11).position(|w| w == b"end_header\n").expect("a header") + 11;
    let names: Vec<_> = String::from_utf8_lossy(&bytes[..end])
        .lines()
        .filter_map(|line| line.strip_prefix("property float ").map(String::from))
        .collect();
    let floats =
        |row: &[u8]| row.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().expect("4"))).collect();
    let rows = bytes[end..].chunks_exact(4 * names.len()).map(floats).collect();
    (names, rows)
}

/// Writes rows with reversed properties among foreign ones, after a foreign element with lists.
fn variant(encoding: &str, kind: &str, names: &[String], rows: &[Vec<f32>]) -> Vec<u8> {
    let mut out = format!("ply\r\nformat {encoding} 1.0\r\ncomment made here\r\nelement face 2\r\n");
    out += "property double area\r\nproperty list uchar int vertex_indices\r\nproperty uchar flag\r\n";
    out += &format!("element vertex {}\r\nproperty uchar tag\r\n", rows.len());
    for name in names.iter().rev() {
        out += &format!("property {kind} {name}\r\n");
    }
    out += "property short weight\r\nelement tail 1\r\nproperty int last\r\nend_header\r\n";
    let mut out = out.into_bytes();
    if encoding == "ascii" {
        out.extend(b"0.5 3 7 8 9 1\n0.25 0 0\n\n");
        for row in rows {
            let words: Vec<_> = row.iter().rev().map(f32::to_string).collect();
            out.extend(format!("7 {} -3\n", words.join(" ")).bytes());
        }
        out.extend(b"1\n");
        return out;
    }
    let big = encoding == "binary_big_endian";
    let mut put = |bytes: &[u8]| match big {
        true => out.extend(bytes.iter().rev()),
        false => out.extend(bytes),
    };
    for items in [3, 0] {
        put(&0.5_f64.to_le_bytes());
        put(&[items]);
        (0..i32::from(items)).for_each(|item| put(&item.to_le_bytes()));
        put(&[1]);
    }
    for row in rows {
        put(&[7]);
        for value in row.iter().rev() {
            match kind {
                "double" => put(&f64::from(*value).to_le_bytes()),
                _ => put(&value.to_le_bytes()),
            }
        }
        put(&(-3_i16).to_le_bytes());
    }
    put(&1_i32.to_le_bytes());
    out
}

#[needs_shared]
fn encodings_types_and_orders_give_the_same_gaussians() {
    let path = shared("fixtures/formats/playbot_lod6.ply");
    let expected = read_all(&path).expect("reads");
    let (names, rows) = rows_of(&std::fs::read(&path).expect("is there"));
    assert_eq!((names.len(), rows.len()), (38, 1873));
    for (encoding, kind) in [
        ("binary_little_endian", "float"),
        ("binary_little_endian", "double"),
        ("binary_big_endian", "float"),
        ("binary_big_endian", "double"),
    ] {
        let bytes = variant(encoding, kind, &names, &rows);
        assert!(read_well("variant.ply", &bytes) == expected, "{encoding} {kind}");
    }
    // ASCII is read as f64, so values may differ in the last place of f32.
    let bytes = variant("ascii", "float", &names, &rows);
    let found = read_well("variant.ply", &bytes);
    assert_eq!((found.len(), found.sh_degree), (1873, 2));
    for i in 0..found.len() {
        assert!((found.means_in_world[i] - expected.means_in_world[i]).length() < 1e-6);
        assert_near(found.opacities[i].into(), expected.opacities[i].into(), 1e-7, "opacity");
    }
    assert_eq!(found.sh_rest, expected.sh_rest);
}

/// Lines of a header.
fn floats(names: &str) -> String {
    names.split(' ').map(|name| format!("property float {name}\n")).collect()
}

#[test]
fn plain_colours_stand_in_for_harmonics() {
    let header = "ply\nformat ascii 1.0\nelement vertex 1\n";
    let names = "x y z opacity rot_0 rot_1 rot_2 rot_3 scale_0 scale_1 scale_2";
    let floats = floats(names);
    let colours = |kind: &str| {
        ["red", "green", "blue"].map(|c| format!("property {kind} {c}\n")).concat() + "end_header\n"
    };
    for (kind, values) in
        [("uchar", "255 0 51"), ("ushort", "65535 0 13107"), ("float", "1 0 0.2"), ("float", "255 0 51")]
    {
        let text = format!("{header}{floats}{}1 2 3 0 2 0 0 0 0 0 0 {values}\n", colours(kind));
        let found = read_well("rgb.ply", text.as_bytes());
        for (found, expected) in found.rgb_dc(0).into_iter().zip([1.0, 0.0, 0.2]) {
            assert_near(found.into(), expected, 1e-6, kind);
        }
        assert_eq!((found.opacities[0], found.rotations_wxyz[0]), (0.5, [1.0, 0.0, 0.0, 0.0]));
    }
}

/// No logit is an integer: 51 of 255 is a fifth.
#[test]
fn opacities_in_bytes_are_shares() {
    let names = "x y z rot_0 rot_1 rot_2 rot_3 scale_0 scale_1 scale_2 f_dc_0 f_dc_1 f_dc_2";
    let floats = floats(names);
    let header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty uchar opacity\n";
    let rows = ["0", "51"].map(|opacity| format!("{opacity} 1 2 3 2 0 0 0 0 0 0 0 0 0\n")).concat();
    let found = read_well("bytes.ply", format!("{header}{floats}end_header\n{rows}").as_bytes());
    assert_eq!(found.opacities, [0.0, 0.2]);
}

/// A training run's folder, as 3DGS writes it, is no unpacked SOG; the longest training is named.
#[test]
fn the_splat_in_a_folder_is_named() {
    let run = tempfile::tempdir().expect("a folder");
    let said = || read_all(run.path()).expect_err("is refused").to_string();
    assert!(said().contains("no unpacked SOG") && said().ends_with("give the splat's file"), "{}", said());
    for n in [7000, 30_000] {
        let folder = run.path().join(format!("point_cloud/iteration_{n}"));
        std::fs::create_dir_all(&folder).expect("makes");
        std::fs::write(folder.join("point_cloud.ply"), "ply").expect("writes");
    }
    assert!(said().ends_with("iteration_30000/point_cloud.ply"), "{}", said());
}

#[test]
fn rows_that_cannot_be_drawn_keep_their_place() {
    let header = "ply\nformat ascii 1.0\nelement vertex 4\n";
    let names = "x y z opacity rot_0 rot_1 rot_2 rot_3 scale_0 scale_1 scale_2 f_dc_0 f_dc_1 f_dc_2";
    let floats = floats(names);
    let rows = "-nan(ind) 0 0 0 1 0 0 0 0 0 0 0 0 0\n0 0 0 0 0 0 0 0 0 0 0 0 0 0\n\
                0 0 0 inf 1 0 0 0 -inf 0 0 0 0 0\n0 0 0 0 1 0 0 0 inf 0 0 0 0 0\n";
    let text = format!("{header}{floats}end_header\n{rows}");
    let found = read_well("odd.ply", text.as_bytes());
    assert_eq!([0, 1, 2, 3].map(|i| found.is_usable(i)), [false, false, true, false]);
    assert_eq!((found.opacities[2], found.scales[2][0]), (1.0, 0.0));
}

#[test]
fn missing_properties_are_named() {
    let text = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n\
                 property float z\nend_header\n1 2 3\n";
    let parts = ["cloud.ply: line 7: expected a header with property \"rot_0\"", "give the PLY of the splat"];
    refused("cloud.ply", text, &parts);
}

/// A compressed PLY with `n_chunks` chunks without colour ranges (as in the first version) and five Gaussians with
/// harmonics of degree 1; all harmonics of a Gaussian have the same byte of `sh`.
fn compressed(n_chunks: usize, sh: &[u8]) -> Vec<u8> {
    let axes = ["x", "y", "z", "scale_x", "scale_y", "scale_z"];
    let ranges = axes.map(|axis| format!("property float min_{axis}\nproperty float max_{axis}\n")).concat();
    let packed =
        ["position", "rotation", "scale", "color"].map(|p| format!("property uint packed_{p}\n")).concat();
    let rest: String = (0..9).map(|i| format!("property uchar f_rest_{i}\n")).collect();
    let mut out = format!(
        "ply\nformat binary_little_endian 1.0\nelement chunk {n_chunks}\n{ranges}\
         element vertex 5\n{packed}element sh {}\n{rest}end_header\n",
        sh.len()
    )
    .into_bytes();
    for _ in 0..n_chunks {
        (0..6).for_each(|axis| out.extend([-1.0, axis as f32].map(f32::to_le_bytes).concat()));
    }
    // Position: x at its maximum, y at its minimum, z at 1023/2047; colour 255, 0, 51; opacity 255.
    let words: [u32; 4] = [0x7FF << 21 | 1023, 0b11 << 30 | 1023 << 20 | 512 << 10 | 511, 0, 0xFF00_33FF];
    (0..5).for_each(|_| out.extend(words.map(u32::to_le_bytes).concat()));
    sh.iter().for_each(|byte| out.extend([*byte; 9]));
    out
}

/// Oracle: PlayCanvas's description of the format, by hand.
#[test]
fn compressed_ply_by_hand() {
    let bytes = compressed(1, &[0, 1, 128, 254, 255]);
    let found = read_well("hand.ply", &bytes);
    assert_columns_agree(&found);
    let mean = found.means_in_world[4];
    assert_eq!((mean.x, mean.y), (0.0, -1.0));
    assert_near(mean.z, -1.0 + 3.0 * 1023.0 / 2047.0, 1e-12, "z");
    assert_near(found.scales[4][2].into(), (-1.0_f64).exp(), 1e-7, "scale");
    for (found, expected) in found.rgb_dc(4).into_iter().zip([1.0, 0.0, 0.2]) {
        assert_near(found.into(), expected, 1e-6, "colour");
    }
    assert_eq!(found.opacities[4], 1.0);
    // w, x, y are 0.5 * sqrt(2) * (2 n / 1023 - 1) for n = 1023, 512, 511; z, the largest, follows from unit length.
    let small = 0.5_f64.sqrt() / 1023.0;
    for (found, expected) in
        found.rotations_wxyz[4].into_iter().zip([0.5_f64.sqrt(), small, -small, 0.5_f64.sqrt()])
    {
        assert_near(found.into(), expected, 1e-6, "rotation");
    }
    for (i, expected) in [-4.0, -4.0 + 1.5 / 32.0, 0.5 / 32.0, 4.0 - 1.5 / 32.0, 4.0].into_iter().enumerate()
    {
        assert_eq!(found.sh_rest[9 * i..9 * (i + 1)], [expected; 9], "{i}");
    }
    for (bytes, expected) in [
        (compressed(2, &[0; 5]), "expected 1 chunks for 5 Gaussians, found 2"),
        (compressed(0, &[0; 5]), "expected 1 chunks for 5 Gaussians, found 0"),
        (compressed(1, &[0; 4]), "expected 5 rows of element \"sh\", found 4"),
    ] {
        refused("wrong.ply", &bytes, &["wrong.ply: byte ", expected]);
    }
}

/// Random Gaussians, including the ends of the ranges.
fn random_gaussians(n: usize, sh_degree: u8) -> Gaussians {
    let mut random = slag_math::random::Random::new(7);
    let mut unit = || random.unit() as f32;
    let mut out = Gaussians { sh_degree, ..Gaussians::default() };
    for i in 0..n {
        out.means_in_world.push(glam::DVec3::from_array([0; 3].map(|_| f64::from(unit() * 200.0 - 100.0))));
        let q = [0; 4].map(|_| unit() - 0.5);
        let norm = q.iter().map(|q| q * q).sum::<f32>().sqrt();
        out.rotations_wxyz.push(q.map(|q| q / norm));
        out.scales.push([unit() * 3.0, unit() * 1e-4, if i == 0 { 0.0 } else { unit() }]);
        out.opacities.push(if i < 2 { i as f32 } else { unit() });
        out.sh_dc.push([0; 3].map(|_| unit() * 4.0 - 2.0));
        out.sh_rest.extend((0..3 * Gaussians::sh_rest_per_channel(sh_degree)).map(|_| unit() - 0.5));
    }
    out
}

#[test]
fn what_is_written_is_read_back() {
    let folder = tempfile::tempdir().expect("a folder");
    for degree in 0..=3 {
        let path = folder.path().join(format!("{degree}.ply"));
        let written = random_gaussians(300, degree);
        ply::write(&path, &written).expect("writes");
        let found = read_all(&path).unwrap_or_else(|error| panic!("{error}"));
        assert_columns_agree(&found);
        assert_eq!((found.len(), found.sh_degree), (300, degree));
        assert_eq!((&found.means_in_world, &found.sh_dc), (&written.means_in_world, &written.sh_dc));
        assert_eq!(found.sh_rest, written.sh_rest);
        assert_eq!((found.opacities[0], found.opacities[1], found.scales[0][2]), (0.0, 1.0, 0.0));
        for i in 0..300 {
            // f32 logarithms down to -18 lose up to 1e-6 of the value.
            for (found, written) in found.scales[i].into_iter().zip(written.scales[i]) {
                assert!((found - written).abs() <= 2e-6 * written, "{found} {written}");
            }
            assert_near(found.opacities[i].into(), written.opacities[i].into(), 2e-7, "opacity");
            for (found, written) in found.rotations_wxyz[i].into_iter().zip(written.rotations_wxyz[i]) {
                assert_near(found.into(), written.into(), 2e-7, "rotation");
            }
        }
        // The layout itself, by name and place: a round trip would not reveal a consistent swap.
        let (names, rows) = rows_of(&std::fs::read(&path).expect("is there"));
        let per_channel = Gaussians::sh_rest_per_channel(degree);
        assert_eq!(names.len(), 17 + 3 * per_channel);
        assert_eq!(names[..9].join(" "), "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2");
        let tail = "opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
        assert_eq!(names[9 + 3 * per_channel..].join(" "), tail);
        for j in 0..3 * per_channel {
            let (channel, coefficient) = (j / per_channel, j % per_channel);
            assert_eq!(rows[5][9 + j], written.sh_rest[(5 * per_channel + coefficient) * 3 + channel]);
        }
        assert!(rows.iter().flatten().all(|value| value.is_finite()), "logarithms of 0 and 1 as well");
        let opacity = f64::from(written.opacities[5]);
        let logit = (opacity / (1.0 - opacity)).ln();
        assert_near(rows[5][9 + 3 * per_channel].into(), logit, 1e-6, "logit");
        assert_near(rows[5][10 + 3 * per_channel].into(), f64::from(written.scales[5][0]).ln(), 1e-6, "log");
    }
}

/// An ASCII PLY of one Gaussian with these properties, each with its value.
fn one_row(properties: &[(&str, &str, f64)]) -> Vec<u8> {
    let header: String =
        properties.iter().map(|(kind, name, _)| format!("property {kind} {name}\n")).collect();
    let row: Vec<String> = properties.iter().map(|(.., value)| value.to_string()).collect();
    format!("ply\nformat ascii 1.0\nelement vertex 1\n{header}end_header\n{}\n", row.join(" ")).into_bytes()
}

/// Flat Gaussians of 2DGS, colours of 0 to 1, harmonics of degree 4; other files are named.
#[test]
fn files_of_other_kinds_are_read_or_named() {
    let geometry = |float: &'static str| -> Vec<(&'static str, &'static str, f64)> {
        let names = ["x", "y", "z", "rot_0", "rot_1", "rot_2", "rot_3", "scale_0", "scale_1", "opacity"];
        names.into_iter().map(|name| (float, name, if name == "rot_0" { 1.0 } else { 0.0 })).collect()
    };
    let read_back = |properties: &[(&str, &str, f64)]| read_well("a.ply", &one_row(properties));
    assert_error(read_all(std::path::Path::new("/dev/zero")), &["write it into a file"]);
    let colours = [("float", "red", 1.0), ("float", "green", 0.5), ("float", "blue", 0.0)];
    let flat = read_back(&[&geometry("float")[..], &colours].concat());
    assert_eq!(flat.scales[0], [1.0, 1.0, 0.0]);
    for (found, expected) in flat.rgb_dc(0).into_iter().zip([1.0, 0.5, 0.0]) {
        assert_near(found.into(), expected, 1e-6, "colour");
    }
    // A single scale holds for all axes.
    let ball: Vec<_> = geometry("float").into_iter().filter(|(_, name, _)| *name != "scale_1").collect();
    assert_eq!(read_back(&[&ball[..], &colours].concat()).scales[0], [1.0; 3]);
    // Mip-Splatting's, by hand: 1 and 0.75 make 1.25, and 0.5 / 1.25^3 is 0.256.
    let blurred = [&ball[..], &colours, &[("float", "filter_3D", 0.75)]].concat();
    let blurred = read_back(&blurred);
    assert_eq!((blurred.scales[0], blurred.opacities[0]), ([1.25; 3], 0.256));
    let rest: Vec<String> = (0..72).map(|i| format!("f_rest_{i}")).collect();
    let mut fourth = [&geometry("float")[..], &[("float", "scale_2", 0.0)]].concat();
    fourth.extend((0..3).map(|i| ("float", ["f_dc_0", "f_dc_1", "f_dc_2"][i], 0.25)));
    fourth.extend(rest.iter().enumerate().map(|(i, name)| ("float", name.as_str(), i as f64)));
    let fourth = read_back(&fourth);
    assert_eq!((fourth.sh_degree, fourth.sh_rest.len()), (3, 45));
    // Channel by channel in the file, 24 each, of which 15 are kept.
    assert_eq!((fourth.sh_rest[..4].to_vec(), fourth.sh_rest[44]), (vec![0.0, 24.0, 48.0, 1.0], 62.0));

    refused("a.ply", b"version https://git-lfs.github.com/spec/v1\n", &["git lfs pull"]);
    refused("a.ply", b"<!DOCTYPE html>", &["web page"]);
    refused("a.ply", &one_row(&geometry("float")[..3]), &["point cloud"]);
    refused("a.ply", &gzip(&one_row(&geometry("float"))), &["gunzip"]);
}
