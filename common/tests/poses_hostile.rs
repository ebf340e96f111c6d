//! Damaged pose files give an error or a valid result, never a panic or an allocation out of proportion to the
//! file.

use slag_common::poses::{self, PoseError};
use slag_math::random::Random;
use slag_test_support::{damaged, memory_of};

fn text_model() -> [(&'static str, Vec<u8>); 2] {
    let cameras =
        "# Camera list\n1 PINHOLE 1574 884 924 924 787 442\n2 OPENCV 640 480 500 500 320 240 0.1 0.2 0 0\n";
    let images = "1 0.6 0.8 0 0 1.5 2.5 3.5 1 a.jpg\n1.5 2.5 -1 3.5 4.5 17\n2 1 0 0 0 0 0 0 2 left/b.jpg\n\n";
    [("cameras.txt", cameras.into()), ("images.txt", images.into())]
}

fn binary_model() -> [(&'static str, Vec<u8>); 2] {
    let numbers = |values: &[f64]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let camera = |id: u32, model: i32, params: &[f64]| {
        [
            &id.to_le_bytes()[..],
            &model.to_le_bytes(),
            &640_u64.to_le_bytes(),
            &480_u64.to_le_bytes(),
            &numbers(params),
        ]
        .concat()
    };
    let image = |id: u32, name: &str, n_features: u64| {
        let mut record = id.to_le_bytes().to_vec();
        record.extend(numbers(&[0.6, 0.8, 0.0, 0.0, 1.5, 2.5, 3.5]));
        record.extend(id.to_le_bytes());
        record.extend(name.bytes().chain([0]));
        record.extend(n_features.to_le_bytes());
        record.extend((0..n_features).flat_map(|_| [7_u8; 24]));
        record
    };
    let two = 2_u64.to_le_bytes().to_vec();
    let cameras =
        [two.clone(), camera(1, 1, &[500.0, 500.0, 320.0, 240.0]), camera(2, 2, &[500.0, 320.0, 240.0, 0.1])];
    let images = [two, image(1, "a.jpg", 3), image(2, "left/b.jpg", 0)];
    [("cameras.bin", cameras.concat()), ("images.bin", images.concat())]
}

fn transforms() -> [(&'static str, Vec<u8>); 1] {
    let json = r#"{"camera_model": "OPENCV", "fl_x": 500.5, "cx": 320, "cy": 240.0, "w": 640, "h": 480, "k1": 0.01,
        "frames": [{"file_path": "images/a.jpg",
        "transform_matrix": [[0.0, -1.0, 0, 1.5], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]},
        {"file_path": "images/b.jpg", "fl_x": 400, "transform_matrix": [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3]]}]}"#;
    [("transforms.json", json.into())]
}

fn scannet() -> Vec<(&'static str, Vec<u8>)> {
    let mut png = std::io::Cursor::new(Vec::new());
    image::RgbImage::new(64, 48).write_to(&mut png, image::ImageFormat::Png).unwrap();
    let pose = |x: f64| format!("0 -1 0 {x}\n1 0 0 2.5\n0 0 1 -3\n0 0 0 1\n").into_bytes();
    vec![
        ("intrinsic/intrinsic_color.txt", b"50.5 0 32 0\n0 50.5 24 0\n0 0 1 0\n0 0 0 1\n".to_vec()),
        ("pose/0.txt", pose(1.5)),
        ("pose/1.txt", pose(1e3)),
        ("pose/2.txt", b"-inf -inf -inf -inf\n".repeat(4)),
        ("color/0.png", png.into_inner()),
    ]
}

/// Reads 1,000 damaged versions of each file and returns the number that still gave views.
fn survive(files: &[(&'static str, Vec<u8>)]) -> usize {
    let dir = tempfile::tempdir().unwrap();
    let write = |name: &str, bytes: &[u8]| {
        let path = dir.path().join(name);
        fs_err::create_dir_all(path.parent().unwrap()).unwrap();
        fs_err::write(path, bytes).unwrap();
    };
    files.iter().for_each(|(name, bytes)| write(name, bytes));
    assert_eq!(poses::read(dir.path(), None).unwrap().views.len(), 2);
    let mut n_read = 0;
    for (name, bytes) in files {
        let mut random = Random::new(bytes.len() as u64);
        for round in 0..1_000 {
            let bad = damaged(bytes, &mut random);
            write(name, &bad);
            let (result, taken) = memory_of(|| poses::read(dir.path(), None));
            // The read buffer (8 KiB) and growing lists of small records; counts are never trusted.
            assert!(taken.largest_bytes <= 16_384 + 8 * bad.len(), "{name} {round}: {taken:?}");
            match result {
                Ok(set) => {
                    n_read += 1;
                    for view in &set.views {
                        assert!(view.camera_from_world.is_finite(), "{name} {round}");
                        assert!(!view.name.is_empty() && view.intrinsics.focal_x_px > 0.0, "{name} {round}");
                    }
                }
                Err(PoseError::Io(error)) => panic!("{name} {round}: {error}"),
                Err(error) => assert!(error.to_string().contains(dir.path().to_str().unwrap()), "{error}"),
            }
        }
        write(name, bytes);
    }
    n_read
}

#[test]
fn damaged_files_are_errors_or_valid() {
    let sets = [text_model().to_vec(), binary_model().to_vec(), transforms().to_vec(), scannet()];
    for files in sets {
        let (n_files, n_read) = (files.len(), survive(&files));
        // Both outcomes must occur, or the damage tests nothing.
        assert!(n_read > 5 && n_read < 800 * n_files, "{}: {n_read}", files[0].0);
    }
}
