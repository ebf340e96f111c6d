//! Poses of real scenes, and of small files written for one case each.

use super::*;

use serde_json::{Value, json};
use slag_common::camera::{Distortion, View};
use slag_common::poses;
use slag_common::poses::{PoseError, ViewSet};
use slag_test_support::{needs_shared, shared};

use super::scannet::write;

fn largest_difference(a: &View, b: &View) -> f64 {
    let columns = |view: &View| view.camera_from_world.to_cols_array();
    columns(a).iter().zip(columns(b)).map(|(x, y)| (x - y).abs()).fold(0.0, f64::max)
}

fn read_files(files: &[(&str, &[u8])]) -> Result<ViewSet, PoseError> {
    let dir = tempfile::tempdir().unwrap();
    files.iter().for_each(|(name, bytes)| write(dir.path(), name, bytes));
    poses::read(dir.path(), None)
}

fn read_text(cameras: &str, images: &str) -> Result<ViewSet, PoseError> {
    read_files(&[("cameras.txt", cameras.as_bytes()), ("images.txt", images.as_bytes())])
}

/// `cameras.bin` with one camera of 64 x 48 pixels; `model`: COLMAP's number.
fn camera_bytes(id: u32, model: i32, params: &[f64]) -> Vec<u8> {
    let mut out = [&1_u64.to_le_bytes()[..], &id.to_le_bytes(), &model.to_le_bytes()].concat();
    out.extend([64_u64.to_le_bytes(), 48_u64.to_le_bytes()].concat());
    out.extend(params.iter().flat_map(|p| p.to_le_bytes()));
    out
}

/// A record of `images.bin`, up to its 2D features. `pose`: QW QX QY QZ TX TY TZ.
fn image_bytes(pose: [f64; 7], camera_id: u32, name: &str, n_features: u64) -> Vec<u8> {
    let mut out = 3_u32.to_le_bytes().to_vec();
    out.extend(pose.iter().flat_map(|v| v.to_le_bytes()));
    out.extend(camera_id.to_le_bytes());
    out.extend([name.as_bytes(), b"\0"].concat());
    out.extend(n_features.to_le_bytes());
    out
}

/// Oracle: camera centres in geo.json (`cam_enu`), computed by another program and rounded to a millimetre.
#[needs_shared]
fn brighton_text_is_its_binary_and_lies_where_its_georeference_says() {
    let scene = shared("scenes/brighton");
    let binary = poses::read(&scene, None).unwrap();
    let text = poses::read(&scene.join("sparse/0/images.txt"), None).unwrap();
    assert_eq!((binary.source, text.source), (PoseSource::ColmapBinary, PoseSource::ColmapText));
    assert_eq!((binary.views.len(), text.views.len()), (18, 18));
    for (b, t) in binary.views.iter().zip(&text.views) {
        assert_eq!((&b.name, &b.image_path, b.intrinsics), (&t.name, &t.image_path, t.intrinsics));
        assert!(largest_difference(b, t) < 1e-12, "{}: {}", b.name, largest_difference(b, t));
        assert!(b.image_path.is_file(), "{}", b.image_path.display());
    }
    let camera = binary.views[0].intrinsics;
    assert_eq!((camera.width_px, camera.height_px, camera.distortion), (1574, 884, Distortion::None));
    assert_eq!((camera.focal_x_px, camera.focal_y_px), (924.0, 924.0));
    assert_eq!((camera.centre_x_px, camera.centre_y_px), (787.0, 442.0));

    let geo: Value = serde_json::from_slice(&fs_err::read(scene.join("geo.json")).unwrap()).unwrap();
    for view in &binary.views {
        let stated = &geo["per_image"][&view.name]["cam_enu"];
        let stated = DVec3::from_array([0, 1, 2].map(|axis| stated[axis].as_f64().unwrap()));
        let found = view.position_in_world();
        assert!((found - stated).abs().max_element() < 2e-3, "{}: {found} {stated}", view.name);
        // An aerial photo: the optical axis points down.
        let forward_in_world = view.camera_from_world.inverse().transform_vector3(DVec3::Z);
        assert!(forward_in_world.z < -0.9, "{}: {forward_in_world}", view.name);
    }
}

/// Oracle: the generator's 96 poses, world from camera in OpenGL axes and camera from world in OpenCV axes.
#[needs_shared]
fn house_transforms_and_colmap_agree() {
    let scene = shared("scenes/house_a");
    let colmap = poses::read(&scene, None).unwrap();
    let transforms = poses::read(&scene.join("transforms.json"), None).unwrap();
    assert_eq!((colmap.source, transforms.source), (PoseSource::ColmapText, PoseSource::Transforms));
    assert_eq!((colmap.views.len(), transforms.views.len()), (96, 96));
    for (c, t) in colmap.views.iter().zip(&transforms.views) {
        assert_eq!((&c.name, c.intrinsics), (&t.name, t.intrinsics));
        assert!(largest_difference(c, t) < 1e-5, "{}: {}", c.name, largest_difference(c, t));
        assert!(c.image_path.is_file() && t.image_path.is_file());
        for view in [c, t] {
            let rotation = view.camera_from_world.matrix3;
            let gram = rotation.transpose() * rotation - DMat3::IDENTITY;
            assert!(gram.to_cols_array().iter().all(|v| v.abs() < 1e-14), "{}", view.name);
        }
    }
    let test_views = poses::read(&scene.join("test"), None).unwrap();
    assert_eq!(test_views.views.len(), 10);
    assert!(test_views.views.iter().all(|view| view.image_path.is_file()));
}

#[needs_shared]
fn a_given_image_folder_replaces_the_default() {
    let scene = shared("scenes/house_a");
    for path in [scene.clone(), scene.join("transforms.json")] {
        let views = poses::read(&path, Some(Path::new("photos"))).unwrap().views;
        assert_eq!(views[7].image_path, Path::new("photos/0007.jpg"));
    }
}

/// Every lens model, as text and binary; the test builds the binary files itself.
#[test]
fn lens_models() {
    const EIGHT: [f64; 8] = [50.0, 51.0, 32.0, 24.0, 0.1, -0.2, 0.3, 0.4];
    let fisheye = Distortion::Fisheye { k: [0.1, -0.2, 0.3, 0.4] };
    let brown = |k1, k2, p| Distortion::Brown { k: [k1, k2, 0.0], p };
    type Case = (i32, &'static str, &'static [f64], [f64; 4], Distortion);
    let cases: [Case; 7] = [
        (0, "SIMPLE_PINHOLE", &[50.0, 32.0, 24.0], [50.0, 50.0, 32.0, 24.0], Distortion::None),
        (1, "PINHOLE", &[50.0, 51.0, 32.0, 24.0], [50.0, 51.0, 32.0, 24.0], Distortion::None),
        (2, "SIMPLE_RADIAL", &[50.0, 32.0, 24.0, 0.1], [50.0, 50.0, 32.0, 24.0], brown(0.1, 0.0, [0.0; 2])),
        (2, "SIMPLE_RADIAL", &[50.0, 32.0, 24.0, 0.0], [50.0, 50.0, 32.0, 24.0], Distortion::None),
        (3, "RADIAL", &[50.0, 32.0, 24.0, 0.1, -0.2], [50.0, 50.0, 32.0, 24.0], brown(0.1, -0.2, [0.0; 2])),
        (4, "OPENCV", &EIGHT, [50.0, 51.0, 32.0, 24.0], brown(0.1, -0.2, [0.3, 0.4])),
        (5, "OPENCV_FISHEYE", &EIGHT, [50.0, 51.0, 32.0, 24.0], fisheye),
    ];
    for (number, model, params, [fx, fy, cx, cy], distortion) in cases {
        let words: Vec<String> = params.iter().map(f64::to_string).collect();
        let text = read_text(
            &format!("# cameras\n7 {model} 64 48 {}\n", words.join(" ")),
            "3 1 0 0 0 1 2 3 7 with space/a b.jpg\n\n",
        );

        let cameras = camera_bytes(7, number, params);
        let image = image_bytes([1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0], 7, "with space/a b.jpg", 2);
        let images = [&1_u64.to_le_bytes()[..], &image, &[0xFF; 48]].concat();
        let binary = read_files(&[("sparse/cameras.bin", &cameras), ("sparse/images.bin", &images)]);

        for set in [text.unwrap(), binary.unwrap()] {
            let view = &set.views[0];
            assert_eq!(view.name, "with space/a b.jpg");
            assert!(view.image_path.ends_with("images/with space/a b.jpg"));
            assert_eq!(view.position_in_world(), DVec3::new(-1.0, -2.0, -3.0));
            let camera = view.intrinsics;
            let size_px = [camera.width_px, camera.height_px];
            assert_eq!((size_px, camera.distortion), ([64, 48], distortion), "{model}");
            assert_eq!([camera.focal_x_px, camera.focal_y_px], [fx, fy]);
            assert_eq!([camera.centre_x_px, camera.centre_y_px], [cx, cy]);
        }
    }
}

#[test]
fn colmap_errors_have_place_and_fault() {
    const CAMERA: &str = "1 PINHOLE 64 48 50 50 32 24\n";
    const IMAGE: &str = "1 1 0 0 0 0 0 0 1 a.jpg\n\n";

    for unused in ["2 FOV 64 48 50 50 32 24 0.1", "2 SPHERE 64 48", "2 PINHOLE 0 0 0 0 0 0", "2"] {
        assert_eq!(read_text(&format!("{unused}\n{CAMERA}"), IMAGE).unwrap().views.len(), 1, "{unused}");
    }
    for (images, parts) in [
        ("1 1 0 0 0 0 0 0 2 a.jpg\n\n", ["images.txt: line 1: ", "\"a.jpg\" uses camera 2"]),
        ("1 1.1 0 0 0 0 0 0 1 a.jpg\n\n", ["\"a.jpg\": its rotation is off by 1.000e-1", "without scale"]),
        ("1 1 0 0 0 0 0 0 1 a.jpg\n1 2 three\n", ["line 2: ", "three"]),
        (&IMAGE.repeat(2), ["two images have the name \"a.jpg\"", "rename"]),
        ("# nothing\n", ["no posed images", "check that"]),
    ] {
        assert_error(read_text(CAMERA, images), &parts);
    }
    for (cameras, parts) in [
        (
            "# comment\n1 FULL_OPENCV 64 48 1 1 1 1 0 0 0 0 0 0 0 0\n",
            ["cameras.txt: line 2: camera 1: model FULL_OPENCV is not supported", "image_undistorter"],
        ),
        ("1 OPENCV 64 48 50 50 32 24 0.1 0.2\n", ["line 1: ", "OPENCV has 8 parameters, found 6"]),
        ("1 PINHOLE 0 48 50 50 32 24", ["line 1: ", "width is 0, expected a whole number"]),
        ("1 PINHOLE 64 48 -50 50 32 24", ["line 1: ", "focal length x is -50"]),
        ("1 PINHOLE 64 48 50 50 inf 24", ["line 1: ", "principal point x is inf"]),
        (&CAMERA.repeat(2), ["line 2: ", "two cameras have the id 1"]),
    ] {
        assert_error(read_text(cameras, IMAGE), &parts);
    }
    for name in ["..", "/", "", "a/../../b.jpg"] {
        let read = read_text(CAMERA, &format!("1 1 0 0 0 0 0 0 1 {name}\n\n"));
        assert_error(read, &["is not a relative path inside the image folder"]);
    }
    assert_error(
        read_files(&[("cameras.txt", b"")]),
        &["no poses found", "give the folder of a COLMAP model"],
    );
    assert_error(
        read_files(&[("transforms_train.json", b"{}")]),
        &["no poses found", "give /", "/transforms_train.json"],
    );
}

#[test]
fn poses_that_are_no_file_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let json = dir.path().join("transforms.json");
    std::os::unix::fs::symlink(&json, &json).unwrap();
    assert_error(poses::read(dir.path(), None), &["/transforms.json: it is a folder, a pipe or a link"]);
    assert_error(
        poses::read(Path::new("/dev/null"), None),
        &["/dev/null: it is neither a file nor a folder"],
    );
}

/// Lines of features may be missing, names may have several words; images without a pose are omitted and named.
#[test]
fn every_image_of_a_model_is_read_or_named() {
    const CAMERA: &str = "\u{feff}1 PINHOLE 64 48 50 50 32 24\r\n";
    for name in ["a.jpg", "IMG 1 (2).jpg", "a b.jpg"] {
        for features in ["", "\n", "775.2 1029.3 8574 1183 971 -1\n"] {
            let line = |id: u32| format!("{id} 1 0 0 0 0 0 0 1 {id}{name}\n{features}");
            let set = read_text(CAMERA, &(1..=5).map(line).collect::<String>()).unwrap();
            assert_eq!(set.views.len(), 5, "{name} {features:?}");
            assert_eq!(set.views[4].name, format!("5{name}"));
        }
    }
    let lost = "1 1 0 0 0 0 0 0 1 a.jpg\n\n2 0 0 0 0 0 0 0 1 b.jpg\n\n3 NaN 0 0 0 0 0 0 1 c.jpg\n\n";
    let set = read_text(CAMERA, lost).unwrap();
    assert_eq!((set.views.len(), set.damaged.len()), (1, 2));
    assert!(set.left_out().is_some_and(|text| text.contains("2 of 3") && text.contains("b.jpg")));
}

/// A frame with an invalid pose is omitted and named in every format; if all are invalid, the first is the error.
#[test]
fn frames_without_a_valid_pose_are_left_out() {
    const CAMERA: &str = "1 PINHOLE 64 48 50 50 32 24\n";
    let good = "1 0 0 0 0 0 0";
    for bad in [
        "1 0 0 0 nan 0 0",
        "1 0 0 0 0 inf 0",
        "1 0 0 0 0 0 1e308",
        "1e200 0 0 0 0 0 0",
        "inf 0 0 0 0 0 0",
        "1.1 0 0 0 0 0 0",
    ] {
        let text = read_text(CAMERA, &format!("1 {good} 1 a.jpg\n\n2 {bad} 1 b.jpg\n\n")).unwrap();
        let record = |name: &str, pose: &str| {
            let numbers: Vec<f64> = pose.split(' ').map(|v| v.parse().unwrap()).collect();
            image_bytes(numbers.try_into().unwrap(), 1, name, 0)
        };
        let cameras = camera_bytes(1, 0, &[50.0, 32.0, 24.0]);
        let images = [2_u64.to_le_bytes().to_vec(), record("a.jpg", good), record("b.jpg", bad)].concat();
        let binary = read_files(&[("cameras.bin", &cameras), ("images.bin", &images)]).unwrap();
        for set in [text, binary] {
            assert_eq!((set.views.len(), &set.damaged[0].0[..], set.damaged.len()), (1, "b.jpg", 1), "{bad}");
        }
        assert_error(read_text(CAMERA, &format!("2 {bad} 1 b.jpg\n")), &["images.txt: line 1: \"b.jpg\": "]);
    }
    let mut bad = vec![frame("b.jpg"); 5];
    bad[0].as_object_mut().unwrap().remove("transform_matrix");
    bad[1]["transform_matrix"] = Value::Null;
    bad[2]["transform_matrix"] = json!([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]);
    bad[3]["transform_matrix"][0][0] = (-1).into();
    bad[4]["transform_matrix"] = json!([[2, 0, 0, 1], [0, 2, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]]);
    let read = |frames: &[Value]| read_json(json!({"fl_x": 60, "w": 64, "h": 48, "frames": frames}));
    for bad in bad {
        let set = read(&[frame("a.jpg"), bad.clone()]).unwrap();
        assert_eq!((set.views.len(), &set.damaged[0].0[..]), (1, "b.jpg"), "{bad}");
        assert!(set.left_out().unwrap().contains("1 of 2 frames have no pose"), "{bad}");
        assert_error(read(&[bad.clone(), bad]), &["transforms.json: frames[0]: \"b.jpg\": "]);
    }
    let mut rounded = frame("a.jpg");
    rounded["transform_matrix"][3] = json!([1e-9, 0, -1e-8, 1.0000001]);
    assert!(read(&[rounded]).unwrap().damaged.is_empty());
    // Frames that --every skips are not reported.
    let mut lost = frame("2.jpg");
    lost["transform_matrix"] = Value::Null;
    let set = read(&[frame("1.jpg"), lost, frame("3.jpg")]).unwrap();
    let set = set.every(std::num::NonZeroU32::new(2).unwrap());
    assert_eq!((set.views.len(), set.damaged.len()), (2, 0));
}

/// Two cameras' photos in one folder are ambiguous. Names from another machine or in another Unicode form are found.
#[test]
fn a_photo_is_that_of_one_view() {
    let dir = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| write(dir.path(), name, text);
    let images = |names: &[&str]| {
        let image = |(id, name): (usize, &&str)| format!("{id} 1 0 0 0 0 0 0 1 {name}\n");
        write("sparse/0/images.txt", &names.iter().enumerate().map(image).collect::<String>());
        poses::read(dir.path(), None).unwrap()
    };
    write("sparse/0/cameras.txt", "1 PINHOLE 64 48 50 50 32 24\n");
    for name in ["0000.jpg", "0001.jpg", "cafe\u{301}.jpg"] {
        write(&format!("images/{name}"), "");
    }
    let rig = ["left/0000.jpg", "right/0000.jpg", "left/0001.jpg", "0001.jpg", "left/caf\u{e9}.jpg"];
    let set = images(&rig);
    let found: Vec<&str> =
        set.views.iter().filter(|view| view.image_path.is_file()).map(|view| &view.name[..]).collect();
    assert_eq!(found, ["0001.jpg", "left/caf\u{e9}.jpg"]);
    let note = |start: &str| set.notes.iter().any(|note| note.starts_with(start));
    assert!(note("3 photos are ambiguous") && note("1 photos have other names"), "{:?}", set.notes);

    let set = images(&["/home/anna/images/0000.jpg", "../images/0001.jpg", "C:\\garden\\caf\u{e9}.jpg"]);
    let names: Vec<&str> = set.views.iter().map(|view| &view.name[..]).collect();
    assert_eq!(names, ["0000.jpg", "0001.jpg", "caf\u{e9}.jpg"]);
    assert!(set.views.iter().all(|view| view.image_path.is_file()));

    let frames = ["left/0000.jpg", "right/0000.jpg", "left/0001.jpg"].map(frame);
    let json = json!({"fl_x": 60, "w": 64, "h": 48, "frames": frames});
    write("transforms.json", &json.to_string());
    let set = poses::read(&dir.path().join("transforms.json"), None).unwrap();
    let found: Vec<(&str, bool)> =
        set.views.iter().map(|view| (&view.name[..], view.image_path.is_file())).collect();
    assert_eq!(found, [("0001.jpg", true), ("left/0000.jpg", false), ("right/0000.jpg", false)]);
    assert!(set.notes[0].starts_with("2 photos are ambiguous"), "{:?}", set.notes);
}

/// Editors and shells of Windows write a byte order mark, or UTF-16.
#[test]
fn texts_of_other_encodings_are_read_or_named() {
    let cameras = "1 PINHOLE 64 48 50 50 32 24\n";
    let json = json!({"fl_x": 60, "w": 64, "h": 48, "frames": [frame("a.jpg")]}).to_string();
    let utf16 = |text: &str| -> Vec<u8> { text.encode_utf16().flat_map(u16::to_le_bytes).collect() };
    for text in [json.clone(), format!("\u{feff}{json}")] {
        assert_eq!(read_files(&[("transforms.json", text.as_bytes())]).unwrap().views.len(), 1);
        let error = read_files(&[("transforms.json", &utf16(&text))]).unwrap_err().to_string();
        assert!(error.contains("transforms.json") && error.contains("UTF-16, expected UTF-8"), "{error}");
    }
    let images = b"1 1 0 0 0 0 0 0 1 a.jpg\n";
    let error = read_files(&[("cameras.txt", &utf16(cameras)), ("images.txt", images)]).unwrap_err();
    assert!(error.to_string().contains("cameras.txt: line 1: the text is UTF-16"), "{error}");
}

/// Photos under other paths, extensions or case; several models; a second form of the model.
#[test]
fn photos_and_models_are_found_and_choices_are_said() {
    let dir = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| write(dir.path(), name, text);
    let image = |id: u32| format!("{id} 1 0 0 0 0 0 0 1 {id}.JPG\n");
    for (model, ids) in [("sparse/0", 1..3), ("sparse/1", 3..9)] {
        write(&format!("{model}/cameras.txt"), "1 PINHOLE 64 48 50 50 32 24\n");
        write(&format!("{model}/images.txt"), &ids.map(image).collect::<String>());
    }
    for name in ["3.jpg", "4.png", "5.JPG"] {
        write(&format!("images/{name}"), "");
    }
    // A folder and a link to itself are no photos.
    fs_err::create_dir(dir.path().join("images/6.JPG")).unwrap();
    fs_err::os::unix::fs::symlink("7.JPG", dir.path().join("images/7.JPG")).unwrap();
    for path in ["", "sparse", "sparse/1"] {
        let set = poses::read(&dir.path().join(path), None).unwrap();
        assert_eq!(set.views.len(), 6, "{path}");
        let found: Vec<bool> = set.views.iter().map(|view| view.image_path.is_file()).collect();
        assert_eq!(found, [true, true, true, false, false, false]);
        assert!(
            set.notes.iter().any(|note| note.starts_with("2 photos have other names")),
            "{:?}",
            set.notes
        );
        // The choice of the larger one is reported too.
        assert!(set.notes.iter().any(|note| note.contains("0 beside it has 2: COLMAP made several models")));
    }
    let small = poses::read(&dir.path().join("sparse/0"), None).unwrap();
    assert!(small.notes.iter().any(|note| note.contains("several models")), "{:?}", small.notes);
    write("sparse/1/images.bin", "");
    let text = poses::read(&dir.path().join("sparse/1/images.txt"), None).unwrap();
    assert!(
        text.notes.iter().any(|note| note.contains("images.bin, which is newer, is ignored")),
        "{:?}",
        text.notes
    );
    write("transforms.json", &json!({"fl_x": 60, "w": 64, "h": 48, "frames": [frame("1.JPG")]}).to_string());
    let both = poses::read(dir.path(), None).unwrap();
    assert!(both.notes.iter().any(|note| note.contains("transforms.json is ignored")));
    fs_err::create_dir(dir.path().join("colmap")).unwrap();
    fs_err::rename(dir.path().join("sparse"), dir.path().join("colmap/sparse")).unwrap();
    let both = poses::read(dir.path(), None).unwrap();
    assert!(both.views.len() == 1 && both.notes.iter().any(|note| note.contains("sparse/0 is ignored")));
}

/// NaN and a byte order mark are not JSON; paths of another machine are found by their suffix.
#[test]
fn transforms_of_other_programs_are_read() {
    let dir = tempfile::tempdir().unwrap();
    fs_err::create_dir(dir.path().join("images")).unwrap();
    fs_err::create_dir(dir.path().join("images/left")).unwrap();
    for name in ["a.jpg", "left/a.jpg", "my photo ä.jpg"] {
        fs_err::write(dir.path().join("images").join(name), "").unwrap();
    }
    let matrix = "[[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]";
    let frame = |path: &str, matrix: &str| {
        format!(r#"{{"file_path": "{path}", "sharpness":NaN, "transform_matrix": {matrix}}}"#)
    };
    let frames = [
        frame("C:\\\\Users\\\\anna\\\\a.jpg", matrix),
        frame("images/my%20photo%20%c3%a4.jpg", matrix),
        frame("/data/left/a.jpg", matrix),
        frame("/home/NaN/b.jpg", &matrix.replace('3', "-Infinity")),
    ];
    let json = format!("\u{feff}{{\"fl_x\": 60, \"w\": 64, \"h\": 48, \"frames\": [{}]}}", frames.join(","));
    fs_err::write(dir.path().join("transforms.json"), json).unwrap();
    for images in [None, Some(dir.path().join("images"))] {
        let set = poses::read(dir.path(), images.as_deref()).unwrap();
        assert!(set.views.iter().all(|view| view.image_path.is_file()), "{:?}", set.views);
        let name = |view: &View| view.name.trim_start_matches("images/").to_owned();
        let mut names: Vec<String> = set.views.iter().map(name).collect();
        names.sort_unstable();
        assert_eq!(names, ["a.jpg", "left/a.jpg", "my photo ä.jpg"]);
        assert_eq!(set.damaged[0].0, "home/NaN/b.jpg");
    }
    assert_error(read_files(&[("transforms.json", b"[{\"id\": 0}]")]), &["cameras.json"]);
}

/// Counts of 2D features beyond the file's end, by one record and by overflow.
#[test]
fn counts_are_not_trusted() {
    let cameras = camera_bytes(1, 0, &[50.0, 32.0, 24.0]);
    for n_features in [2, u64::MAX / 24, u64::MAX] {
        let image = image_bytes([1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0], 1, "a.jpg", n_features);
        let images = [&1_u64.to_le_bytes()[..], &image, &[0; 24]].concat();
        let place = format!("images.bin: byte {}: ", 8 + 4 + 56 + 4 + 6 + 8);
        let read = read_files(&[("cameras.bin", &cameras), ("images.bin", &images)]);
        assert_error(read, &[&place, "ends before the image's 2D features"]);
    }
}

fn read_json(json: Value) -> Result<ViewSet, PoseError> {
    read_files(&[("transforms.json", json.to_string().as_bytes())])
}

fn frame(file_path: &str) -> Value {
    json!({"file_path": file_path,
        "transform_matrix": [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]})
}

#[test]
fn transforms_cameras_are_shared_or_per_frame() {
    let mut own = frame("images/b.jpg");
    own["fl_x"] = 70.into();
    own["w"] = 100.0.into();
    own["k1"] = 0.2.into();
    own["camera_model"] = "OPENCV_FISHEYE".into();
    let views = read_json(json!({
        "camera_model": "OPENCV", "fl_x": 60.5, "fl_y": 61, "cx": 31, "cy": 25, "w": 64, "h": 48,
        "k1": 0.1, "p2": 0.3, "applied_transform": [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]], "frames": [own, frame("images/left/a.jpg")],
    }))
    .unwrap()
    .views;
    assert_eq!((views[0].name.as_str(), views[1].name.as_str()), ("b.jpg", "left/a.jpg"));
    let [b, a] = [views[0].intrinsics, views[1].intrinsics];
    assert_eq!((a.focal_x_px, a.focal_y_px, a.centre_x_px, a.centre_y_px), (60.5, 61.0, 31.0, 25.0));
    assert_eq!(a.distortion, Distortion::Brown { k: [0.1, 0.0, 0.0], p: [0.0, 0.3] });
    assert_eq!((b.focal_x_px, b.focal_y_px, b.width_px, b.height_px), (70.0, 61.0, 100, 48));
    assert_eq!(b.distortion, Distortion::Fisheye { k: [0.2, 0.0, 0.0, 0.0] });
    let listed = json!({"fl_x": 60, "w": 64, "h": 48, "k1": 9, "frames": [frame("a.jpg")],
        "distortion_params": [0.1, -0.2, 0.3, 0, 0.4, 0.5]});
    let listed = read_json(listed).unwrap().views[0].intrinsics.distortion;
    assert_eq!(listed, Distortion::Brown { k: [0.1, -0.2, 0.3], p: [0.4, 0.5] });
    let short = json!({"fl_x": 60, "w": 64, "h": 48, "frames": [frame("a.jpg")],
        "distortion_params": [0.1, -0.2, 0.3, 0.4]});
    assert_error(read_json(short), &["6 numbers in distortion_params", "found 4"]);
    // OpenGL cameras look along -z with y up: the point is 5 ahead of the camera and 1 above it.
    let in_camera = a_point_in_camera(&views[1], DVec3::new(1.0, 3.0, -2.0));
    assert!((in_camera - DVec3::new(0.0, -1.0, 5.0)).length() < 1e-12, "{in_camera}");
}

fn a_point_in_camera(view: &View, point_in_world: DVec3) -> DVec3 {
    view.camera_from_world.transform_point3(point_in_world)
}

/// A mask that is not read, and an angle that contradicts the focal length, are reported.
#[test]
fn what_transforms_say_in_vain_is_told() {
    let with = |angle: f64| {
        let mut masked = frame("b.jpg");
        masked["mask_path"] = "masks/b.png".into();
        let json = json!({"fl_x": 60, "camera_angle_x": angle, "w": 64, "h": 48, "frames": [frame("a.jpg"), masked]});
        read_json(json).unwrap().notes
    };
    let notes = with(2.0 * (32.0_f64 / 60.0).atan());
    assert!(notes.len() == 1 && notes[0].starts_with("1 frames have a mask_path"), "{notes:?}");
    let notes = with(1.6);
    assert!(notes[1].contains("31.1 px, fl_x says 60.0 px"), "{notes:?}");
}

/// NeRF's first data sets have only an angle, no extension and no size.
#[test]
fn transforms_with_an_angle_and_bare_names() {
    let dir = tempfile::tempdir().unwrap();
    fs_err::create_dir(dir.path().join("train")).unwrap();
    image::RgbImage::new(40, 30).save(dir.path().join("train/r_0.01.png")).unwrap();
    let json = json!({"camera_angle_x": 90_f64.to_radians(), "frames": [frame("./train/r_0.01")]});
    fs_err::write(dir.path().join("transforms.json"), json.to_string()).unwrap();
    let view = &poses::read(dir.path(), None).unwrap().views[0];
    assert_eq!(view.name, "train/r_0.01.png");
    assert!(view.image_path.is_file());
    let camera = view.intrinsics;
    assert_eq!([camera.width_px, camera.height_px], [40, 30]);
    assert_eq!([camera.centre_x_px, camera.centre_y_px], [20.0, 15.0]);
    assert!((camera.focal_x_px - 20.0).abs() < 1e-12 && (camera.focal_y_px - 20.0).abs() < 1e-12);
    assert_eq!(camera.distortion, Distortion::None);
}

#[test]
fn transforms_errors_have_place_and_fault() {
    let with = |key: &str, value: Value| {
        let mut json = json!({"fl_x": 60, "w": 64, "h": 48, "frames": [frame("a.jpg"), frame("b.jpg")]});
        json[key] = value;
        read_json(json)
    };
    for (key, value, fault) in [
        ("camera_model", "EQUIRECTANGULAR".into(), "lens model EQUIRECTANGULAR is not supported"),
        ("k4", 0.1.into(), "lens model OPENCV with k4 is not supported"),
        ("k5", 0.1.into(), "lens model OPENCV with k5 is not supported"),
        ("b2", 0.1.into(), "lens model OPENCV with b2 is not supported"),
        ("w", 64.5.into(), "width is 64.5"),
        ("h", Value::Null, "its size is unknown"),
        ("fl_x", Value::Null, "fl_x, or camera_angle_x within 0..pi radians, is missing"),
    ] {
        assert_error(with(key, value), &["transforms.json: frames[0]: ", fault]);
    }
    for (row, column, value, fault) in [
        (0, 0, 1.1, "\"b.jpg\": its rotation is off by"),
        (0, 0, -1.0, "\"b.jpg\": its matrix mirrors"),
        (1, 0, 0.1, "\"b.jpg\": its rotation is off by"),
        (3, 3, 2.0, "the fourth row being 0 0 0 1"),
    ] {
        let mut bad = frame("b.jpg");
        bad["transform_matrix"][row][column] = value.into();
        assert_error(with("frames", json!([bad, bad])), &["frames[0]: ", fault]);
    }
    let twice = json!([frame("images/a.jpg"), frame("images_2/a.jpg")]);
    assert_error(with("frames", twice), &["two images have the name \"a.jpg\""]);
    assert_error(
        read_files(&[("transforms.json", b"{\"frames\": 3}")]),
        &["export the file again with nerfstudio"],
    );
}

/// Two images of one file name are two views if their folders differ.
#[test]
fn transforms_names_keep_the_folders_that_tell_images_apart() {
    let cases = [
        (["left/a.png", "right/a.png"], ["left/a.png", "right/a.png"]),
        (["images/left/a.png", "images/right/a.png"], ["left/a.png", "right/a.png"]),
        (["left/images/a.png", "right/images/a.png"], ["left/images/a.png", "right/images/a.png"]),
        (
            ["../rig/left/images/a.png", "../rig/right/images_2/a.png"],
            ["left/images/a.png", "right/images_2/a.png"],
        ),
        (["/data/images/a.png", "/data/images/b.png"], ["a.png", "b.png"]),
    ];
    for (paths, expected) in cases {
        let frames = paths.map(frame);
        let set = read_json(json!({"fl_x": 60, "w": 64, "h": 48, "frames": frames}));
        let names: Vec<String> = set.unwrap().views.into_iter().map(|view| view.name).collect();
        assert_eq!(names, expected);
    }
}

#[test]
fn a_missing_pose_file_is_named_once() {
    let error = poses::read(Path::new("absent.json"), None).unwrap_err();
    let chain = std::iter::successors(Some(&error as &dyn std::error::Error), |error| error.source());
    let text = chain.map(ToString::to_string).collect::<Vec<_>>().join(": ");
    assert_eq!(text.matches("absent.json").count(), 1, "{text}");
}

/// Sizes come from the photos' content; a frame whose photo is lost or damaged is left out by name.
#[test]
fn frames_of_unknown_size_are_left_out() {
    let mut png = std::io::Cursor::new(Vec::new());
    image::RgbImage::new(8, 6).write_to(&mut png, image::ImageFormat::Png).unwrap();
    let frames = ["a.jpg", "b.jpg", "c.jpg"].map(frame);
    let json = json!({"fl_x": 60, "frames": frames}).to_string();
    let files: [(&str, &[u8]); 3] =
        [("transforms.json", json.as_bytes()), ("a.jpg", png.get_ref()), ("c.jpg", b"damaged")];
    let set = read_files(&files).unwrap();
    assert_eq!((set.views.len(), set.views[0].intrinsics.width_px), (1, 8));
    let names: Vec<&str> = set.damaged.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(names, ["b.jpg", "c.jpg"]);
    assert!(set.left_out().unwrap().contains("b.jpg"), "{:?}", set.left_out());
}
