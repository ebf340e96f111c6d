//! All formats against `expected.json` (splat-transform 2.7.1, confirmed by a second reader); trained scenes against a
//! separate parser.

use super::*;
use std::io::Read;

use serde_json::Value;

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().into_iter().flatten().map(|v| v.as_f64().expect("a number")).collect()
}

#[needs_shared]
fn every_format_gives_the_recorded_gaussians() {
    let folder = shared("fixtures/formats");
    let text = std::fs::read(folder.join("expected.json")).expect("expected.json is there");
    let expected: Value = serde_json::from_slice(&text).expect("expected.json is JSON");
    let mut n_read = 0;
    for (name, expected) in expected.as_object().expect("an object") {
        if name.ends_with(".ksplat") {
            continue;
        }
        let gaussians = read_all(&folder.join(name)).unwrap_or_else(|error| panic!("{error}"));
        assert_columns_agree(&gaussians);
        assert_eq!(gaussians.len() as u64, expected["count"], "{name}");
        assert_eq!(gaussians.sh_degree, expected["sh_degree"], "{name}");
        assert!((0..gaussians.len()).all(|i| gaussians.is_usable(i)), "{name}");
        for (side, fold) in [("bbox_min", f64::min as fn(f64, f64) -> f64), ("bbox_max", f64::max)] {
            for (axis, bound) in numbers(&expected[side]).into_iter().enumerate() {
                let found = gaussians.means_in_world.iter().map(|m| m[axis]).reduce(fold);
                assert_near(found.expect("not empty"), bound, 1e-6, &format!("{name} {side}"));
            }
        }
        // .splat stores rotations as bytes, and readers take 127.5 or 128 as zero: up to 0.9 degrees, half of that
        // between quaternions. Other formats: f32 rounding of the recorded values.
        let rotation_tolerance = if name.ends_with(".splat") { 0.008 } else { 2e-6 };
        for row in expected["gaussians"].as_array().expect("an array") {
            let i = row["index"].as_u64().expect("an index") as usize;
            let what = |field: &str| format!("{name} {i} {field}");
            for (axis, x) in numbers(&row["position"]).into_iter().enumerate() {
                // The recorded positions are f32, ours f64.
                assert_near(gaussians.means_in_world[i][axis], x, 2e-7, &what("position"));
            }
            for (axis, s) in numbers(&row["scale"]).into_iter().enumerate() {
                // Relative: the recorded logarithms, up to 10, have f32 rounding errors of 1e-6.
                assert_near(f64::from(gaussians.scales[i][axis]) / s, 1.0, 2e-6, &what("scale"));
            }
            let opacity = row["opacity"].as_f64().expect("a number");
            // The recorded opacities passed through a logit clamped to 1e-6 and 1 - 1e-6.
            assert_near(gaussians.opacities[i].into(), opacity, 1.1e-6, &what("opacity"));
            for (channel, c) in numbers(&row["f_dc"]).into_iter().enumerate() {
                assert_near(gaussians.sh_dc[i][channel].into(), c, 5e-7, &what("f_dc"));
            }
            let q = numbers(&row["rotation_wxyz"]);
            let distance = |sign: f64| {
                let found = gaussians.rotations_wxyz[i].iter().map(|q| f64::from(*q) * sign);
                found.zip(&q).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
            };
            assert!(distance(1.0).min(distance(-1.0)) <= rotation_tolerance, "{}", what("rotation"));
            let rest = numbers(&row["f_rest"]);
            let k = rest.len() / 3;
            for (j, c) in rest.into_iter().enumerate() {
                let found = gaussians.sh_rest[(i * k + j % k) * 3 + j / k];
                assert_near(found.into(), c, 2e-7, &what("f_rest"));
            }
        }
        n_read += 1;
    }
    assert_eq!(n_read, 14, "files with recorded values");
}

#[needs_shared]
fn a_folder_is_read_as_its_meta_file() {
    let folder = shared("fixtures/formats/playbot_lod3_sog");
    let by_folder = read_all(&folder).expect("reads");
    assert_eq!(by_folder.len(), 31_000);
    assert_eq!(by_folder, read_all(&folder.join("meta.json")).expect("reads"));
}

#[needs_shared]
fn higher_harmonics_are_read_on_request() {
    let folder = shared("fixtures/formats");
    for name in ["lod6.ply", "lod6.compressed.ply", "lod6_v3.spz", "lod6_v4.spz", "lod6.sog"] {
        let path = folder.join(format!("playbot_{name}"));
        let mut full = read_all(&path).expect("reads");
        assert_eq!((full.sh_degree, full.sh_rest.len()), (2, 1873 * 24), "{name}");
        (full.sh_degree, full.sh_rest) = (0, Vec::new());
        assert_eq!(read(&path, &ReadOptions::default()).expect("reads"), full, "{name}");
    }
}

#[needs_shared]
fn small_ply_files_with_another_order_of_properties() {
    let folder = shared("fixtures/formats");
    let text = std::fs::read_to_string(folder.join("gsplatrs_minimal_ascii.ply")).expect("is there");
    let rows = text.lines().skip_while(|line| *line != "end_header").skip(1);
    let ascii = read_all(&folder.join("gsplatrs_minimal_ascii.ply")).expect("reads");
    let binary = read_all(&folder.join("gsplatrs_minimal_binary.ply")).expect("reads");
    assert_eq!((ascii.len(), binary.len()), (3, 3));
    for (i, row) in rows.enumerate() {
        let v: Vec<f64> = row.split_whitespace().map(|word| word.parse().expect("a number")).collect();
        for gaussians in [&ascii, &binary] {
            assert_near(gaussians.means_in_world[i].z, v[2], 1e-7, "z");
            assert_near(gaussians.opacities[i].into(), 1.0 / (1.0 + (-v[3]).exp()), 1e-7, "opacity");
            assert_near(gaussians.scales[i][1].into(), v[5].exp(), 1e-7, "scale");
            assert_near(gaussians.rotations_wxyz[i][0].into(), v[7], 1e-7, "w");
            assert_near(gaussians.sh_dc[i][2].into(), v[13], 1e-7, "blue");
        }
    }
}

/// Oracle: the files' 17 floats per row, read by position and decoded in f64.
#[needs_shared]
fn trained_scenes_row_by_row() {
    for (scene, count) in [("brighton", 149_097), ("house_a", 104_878)] {
        let path = shared(&format!("scenes/{scene}/point_cloud.ply"));
        let gaussians = read_all(&path).unwrap_or_else(|error| panic!("{error}"));
        assert_columns_agree(&gaussians);
        assert_eq!((gaussians.len(), gaussians.sh_degree), (count, 0));
        let bytes = std::fs::read(&path).expect("is there");
        let rows = &bytes[bytes.len() - count * 68..];
        assert!(bytes[..bytes.len() - count * 68].ends_with(b"end_header\n"));
        for (i, row) in rows.chunks_exact(68).enumerate() {
            let v: [f64; 17] = std::array::from_fn(|j| {
                f32::from_le_bytes(row[4 * j..4 * j + 4].try_into().expect("4 bytes")).into()
            });
            assert_eq!(gaussians.means_in_world[i].to_array(), v[0..3], "{scene} {i}");
            assert_eq!(gaussians.sh_dc[i].map(f64::from), v[6..9], "{scene} {i}");
            assert_near(gaussians.opacities[i].into(), 1.0 / (1.0 + (-v[9]).exp()), 1e-7, scene);
            let norm = v[13..17].iter().map(|q| q * q).sum::<f64>().sqrt();
            for j in 0..4 {
                assert_near(gaussians.rotations_wxyz[i][j].into(), v[13 + j] / norm, 1e-7, scene);
            }
            for j in 0..3 {
                assert_near(f64::from(gaussians.scales[i][j]) / v[10 + j].exp(), 1.0, 1e-7, scene);
            }
        }
    }
}

#[test]
fn a_dot_splat_with_an_incomplete_row_is_refused() {
    for (len, row) in [(0, 0), (63, 32), (65, 64)] {
        let expected =
            format!("cut.splat: byte {row}: expected rows of 32 bytes, found a file of {len} bytes");
        refused("cut.splat", &vec![1; len], &[&expected]);
    }
}

#[needs_shared]
fn refusals_give_advice() {
    let folder = shared("fixtures/formats");
    let error = read_all(&folder.join("minimal.ksplat")).expect_err("is refused");
    let text = error.to_string();
    assert!(text.contains("minimal.ksplat: .ksplat is not supported; convert it"), "{text}");
    let error = read_all(&folder.join("README.md")).expect_err("is refused");
    assert!(error.to_string().contains("README.md: byte 0: expected a PLY"), "{error}");
    assert_error(read_all(&folder.join("absent.ply")), &["absent.ply", "check the path"]);
}

#[test]
fn a_missing_file_is_named_once() {
    let error = read_all(std::path::Path::new("absent.ply")).expect_err("is refused");
    let chain = std::iter::successors(Some(&error as &dyn std::error::Error), |error| error.source());
    let text = chain.map(ToString::to_string).collect::<Vec<_>>().join(": ");
    assert_eq!(text.matches("absent.ply").count(), 1, "{text}");
}

/// Extra rows, or two columns of one name, would be read by half without a word.
#[needs_shared]
fn files_that_go_on_behind_their_last_row_are_refused() {
    let fixture = |name: &str| std::fs::read(shared("fixtures/formats").join(name)).unwrap();
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
        refused(name, &bytes, &["expected the end of the"]);
    }
    read_well("blank.ply", &[&plain[..], b"\n"].concat());
    let (from, to) = ("property float opacity\n", "property float opacity\nproperty float opacity\n");
    let twice = String::from_utf8(ascii).expect("text").replacen(from, to, 1);
    refused("twice.ply", twice.as_bytes(), &["a property that the element does not have yet"]);
}
