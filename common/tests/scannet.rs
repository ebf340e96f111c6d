//! Scene folders of ScanNet, made here in the layout of its SensReader, and nerfstudio's frames of splats.

use super::*;
use std::num::NonZeroU32;

use glam::{DAffine3, DQuat};
use slag_common::poses;
use slag_common::poses::{Origin, SplatFrame};
use slag_common::{Distortion, Similarity};

const INTRINSICS: &str = "1170.187988 0.000000 647.750000 0.000000\n0.000000 1170.187988 483.750000 0.000000\n\
                          0.000000 0.000000 1.000000 0.000000\n0.000000 0.000000 0.000000 1.000000\n";
const LOST: &str = "-inf -inf -inf -inf\n-inf -inf -inf -inf\n-inf -inf -inf -inf\n-inf -inf -inf -inf\n";

pub fn write(dir: &Path, name: &str, bytes: impl AsRef<[u8]>) {
    let path = dir.join(name);
    fs_err::create_dir_all(path.parent().unwrap()).unwrap();
    fs_err::write(path, bytes).unwrap();
}

fn pose(world_from_camera: DAffine3) -> String {
    let rows = world_from_camera.matrix3.transpose().to_cols_array_2d();
    let t = world_from_camera.translation.to_array();
    let row = |i: usize| format!("{:.6} {:.6} {:.6} {:.6}\n", rows[i][0], rows[i][1], rows[i][2], t[i]);
    [row(0), row(1), row(2), "0.000000 0.000000 0.000000 1.000000\n".to_owned()].concat()
}

fn world_from_camera(number: u32) -> DAffine3 {
    let n = f64::from(number);
    DAffine3::from_rotation_translation(DQuat::from_rotation_y(0.01 * n), DVec3::new(n, 2.0, -0.5 * n))
}

/// Frames 0 to 99; tracking is lost in frames 0 to 4 and 40.
fn scene() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), "intrinsic/intrinsic_color.txt", INTRINSICS);
    fs_err::create_dir_all(dir.path().join("color")).unwrap();
    for number in 0..100 {
        let is_lost = number < 5 || number == 40;
        let text = if is_lost { LOST.to_owned() } else { pose(world_from_camera(number)) };
        write(dir.path(), &format!("pose/{number}.txt"), text);
        if matches!(number, 0 | 20 | 60) {
            image::RgbImage::new(1296, 968).save(dir.path().join(format!("color/{number}.jpg"))).unwrap();
        }
    }
    dir
}

fn refused(dir: &Path, fault: &str) {
    let error = poses::read(dir, None).expect_err("is refused").to_string();
    assert!(error.starts_with(dir.to_str().expect("UTF-8")) && error.contains(fault), "{error}: {fault}");
}

/// By hand: 94 of 100 frames have a pose; of every 20th frame (0, 20, 40, 60, 80) three do.
#[test]
fn a_scene_folder_gives_its_posed_frames() {
    let dir = scene();
    let set = poses::read(dir.path(), None).unwrap();
    assert_eq!((set.source, set.views.len(), set.without_pose.len()), (PoseSource::Scannet, 94, 6));
    let set = set.every(NonZeroU32::new(20).unwrap());
    let names: Vec<&str> = set.views.iter().map(|view| view.name.as_str()).collect();
    assert_eq!(names, ["20.jpg", "60.jpg", "80"], "frame 80 has no photo, so its extension is unknown");
    assert_eq!(set.without_pose, ["0.jpg", "40"]);
    let view = &set.views[1];
    assert_eq!(view.image_path, dir.path().join("color/60.jpg"));
    let camera = view.intrinsics;
    assert_eq!((camera.width_px, camera.height_px, camera.distortion), (1296, 968, Distortion::None));
    assert_eq!((camera.focal_x_px, camera.focal_y_px), (1170.187988, 1170.187988));
    assert_eq!((camera.centre_x_px, camera.centre_y_px), (647.75, 483.75));
    // The file's transform is world from camera in OpenCV axes: the optical axis is its third column.
    assert!((view.position_in_world() - DVec3::new(60.0, 2.0, -30.0)).length() < 1e-9);
    let forward = view.camera_from_world.inverse().transform_vector3(DVec3::Z);
    assert!((forward - DVec3::new(0.6f64.sin(), 0.0, 0.6f64.cos())).length() < 1e-5, "{forward}");
}

#[test]
fn damaged_scene_folders_are_named() {
    let dir = scene();
    let path = dir.path();
    // Only the frame is omitted, with the fault of its pose.
    let posed = pose(world_from_camera(7));
    let texts: [(Vec<u8>, &str); 10] = [
        (posed.replace("0.997551", "nan").into(), "its rotation is off by NaN"),
        (posed.replace("7.000000", "inf").into(), "a translation of at most 1e12"),
        ("0 0 0 0\n".repeat(4).into(), "found \"[0.0, 0.0, 0.0, 0.0]\""),
        ("1 0 0 0\n0 1 0 0\n0 0 one 0\n0 0 0 1\n".into(), "expected a number, found \"one\""),
        ("1 0 0 0\n0 1 0\n0 0 1 0\n0 0 0 1\n".into(), "4 rows of 4 numbers"),
        (Vec::new(), "4 rows of 4 numbers"),
        ("1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1\n".into(), "its matrix mirrors"),
        (" ".repeat(1 << 20).into(), "1048576 bytes"),
        (vec![0xFF; 64], "not UTF-8"),
        (posed.encode_utf16().flat_map(u16::to_le_bytes).collect(), "UTF-16"),
    ];
    for (text, reason) in &texts {
        write(path, "pose/7.txt", text);
        let set = poses::read(path, None).unwrap();
        let [(name, found)] = &set.damaged[..] else { panic!("{:?}", set.damaged) };
        assert!(name == "7" && found.contains(reason), "{name}: {found}, expected {reason}");
        assert_eq!((set.views.len(), set.without_pose.len()), (93, 6));
    }
    write(path, "pose/7.txt", format!("\u{feff}{posed}"));
    assert!(poses::read(path, None).unwrap().damaged.is_empty());
    write(path, "pose/7.txt", LOST);
    // Intrinsics of photos twice as large.
    write(path, "intrinsic/intrinsic_color.txt", INTRINSICS.replace("647.75", "1295.5"));
    refused(path, "far from the middle of images of 1296 x 968 px");
    write(path, "intrinsic/intrinsic_color.txt", INTRINSICS.replace("1170.187988", "-1"));
    refused(path, "focal length x is -1");
    write(path, "intrinsic/intrinsic_color.txt", LOST);
    refused(path, "expected a camera matrix");
    write(path, "intrinsic/intrinsic_color.txt", INTRINSICS);
    for number in [0, 20, 60] {
        fs_err::remove_file(path.join(format!("color/{number}.jpg"))).unwrap();
    }
    refused(path, "no image of the 93 posed frames can be read");
    for number in 0..100 {
        write(path, &format!("pose/{number}.txt"), LOST);
    }
    refused(path, "no posed images");
    write(path, "pose/7.txt", "1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1\n");
    refused(path, "its matrix mirrors");
    fs_err::remove_file(path.join("intrinsic/intrinsic_color.txt")).unwrap();
    assert_error(poses::read(path, None), &["intrinsic_color.txt"]);
}

/// Repeats nerfstudio's dataparsers with 4 x 4 matrices: a camera's trained position is the transformed translation.
#[test]
fn dataparser_transforms_begin_where_their_dataparser_does() {
    let swap = DAffine3::from_mat3(DMat3::from_cols(DVec3::Y, DVec3::X, -DVec3::Z));
    let orient = DAffine3::from_rotation_translation(DQuat::from_rotation_x(0.7), DVec3::new(0.3, -2.0, 1.0));
    let centre = DAffine3::from_translation(DVec3::new(-4.0, 5.0, 0.5));
    let dir = tempfile::tempdir().unwrap();
    let read = |transform: DAffine3, scale: f64| {
        let m = transform.matrix3;
        let t = transform.translation;
        let rows: Vec<[f64; 4]> = (0..3).map(|i| [m.row(i).x, m.row(i).y, m.row(i).z, t[i]]).collect();
        let path = dir.path().join(poses::FRAME_FILE);
        fs_err::write(&path, serde_json::json!({"transform": rows, "scale": scale}).to_string()).unwrap();
        SplatFrame::read(&path).unwrap()
    };
    let point = DVec3::new(1.5, -2.5, 3.5);
    let same = |a: DVec3, b: DVec3| assert!((a - b).length() < 1e-12, "{a} {b}");

    // ScanNet: axes are swapped before the file's transform, a translation, begins.
    let scene = scene();
    let scannet = poses::read(scene.path(), None).unwrap();
    let found = read(centre, 0.25).splat_from_poses(scannet.source, scannet.applied);
    assert_eq!(found.begins_at, Origin::ScannetDataparser);
    same(found.similarity.transform_point(point), (centre * swap).transform_point3(point) * 0.25);
    let found = read(orient, 0.25).splat_from_poses(scannet.source, scannet.applied);
    assert_eq!(found.begins_at, Origin::Poses);
    same(found.similarity.transform_point(point), orient.transform_point3(point) * 0.25);

    // transforms.json of ns-process-data: its poses are `applied_scale * (applied * original)`.
    let json = |extra: &str| {
        let pose = "[[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]";
        let text = format!(
            r#"{{"w": 64, "h": 48, "fl_x": 50, {extra} "frames": [{{"file_path": "images/a.png", "transform_matrix": {pose}}}]}}"#
        );
        fs_err::write(dir.path().join("transforms.json"), text).unwrap();
        poses::read(dir.path(), None)
    };
    let views = json("").unwrap();
    assert_eq!(views.applied, None);
    let found = read(orient, 0.5).splat_from_poses(views.source, views.applied);
    assert_eq!(found.begins_at, Origin::Poses);
    same(found.similarity.transform_point(point), orient.transform_point3(point) * 0.5);
    // The dataparser applies `orient` and 0.5 to the saved poses; its file states `orient * applied` and 0.5 * 4.
    let views =
        json(r#""applied_transform": [[0,1,0,0],[1,0,0,0],[0,0,-1,0]], "applied_scale": 4.0,"#).unwrap();
    let found = read(orient * swap, 0.5 * 4.0).splat_from_poses(views.source, views.applied);
    assert_eq!(found.begins_at, Origin::BeforeAppliedTransform);
    same(found.similarity.transform_point(point), orient.transform_point3(point) * 0.5);
    // Old files do not record it; nerfstudio assumes it beside colmap/sparse/0.
    fs_err::create_dir_all(dir.path().join("colmap/sparse/0")).unwrap();
    let found = read(orient * swap, 0.5).splat_from_poses(PoseSource::Transforms, json("").unwrap().applied);
    same(found.similarity.transform_point(point), orient.transform_point3(point) * 0.5);
    for wrong in [r#""applied_scale": 0,"#, r#""applied_transform": [[2,0,0,0],[0,2,0,0],[0,0,2,0]],"#] {
        assert!(json(wrong).unwrap_err().to_string().contains("transforms.json"), "{wrong}");
    }
}

#[test]
fn a_written_frame_reads_as_itself_whatever_the_poses() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("frame.json");
    let scene = scene();
    let scannet = poses::read(scene.path(), None).unwrap();
    let rotation = DQuat::from_axis_angle(DVec3::new(3.0, 1.0, -2.0).normalize(), 2.0);
    for rotation in [DQuat::IDENTITY, rotation] {
        let stated = Similarity { scale: 3.7, rotation, translation: DVec3::new(10.0, -20.0, 0.125) };
        fs_err::write(&path, SplatFrame::to_json(&stated)).unwrap();
        let found = SplatFrame::read(&path).unwrap().splat_from_poses(scannet.source, scannet.applied);
        assert_eq!(found.begins_at, Origin::Poses);
        for point in [DVec3::ZERO, DVec3::new(1.0, 2.0, 3.0)] {
            let (a, b) = (found.similarity.transform_point(point), stated.transform_point(point));
            assert!((a - b).length() < 1e-9, "{a} {b}");
        }
    }
}

#[test]
fn damaged_frames_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(poses::FRAME_FILE);
    let message = |text: &str| {
        fs_err::write(&path, text).unwrap();
        let message = SplatFrame::read(&path).expect_err(text).to_string();
        assert!(message.contains("dataparser_transforms.json"), "{message}");
        message
    };
    let unit = "[[1,0,0,0],[0,1,0,0],[0,0,1,0]]";
    assert!(message(&format!(r#"{{"transform": {unit}}}"#)).contains("missing field `scale`"));
    assert!(message(&format!(r#"{{"transform": {unit}, "scale": 0}}"#)).contains("a scale from"));
    assert!(message(&format!(r#"{{"transform": {unit}, "scale": -1}}"#)).contains("a scale from"));
    assert!(message(r#"{"transform": [[1,0,0,0]], "scale": 1}"#).contains("3 or 4 rows"));
    let scaled = message(r#"{"transform": [[2,0,0,0],[0,2,0,0],[0,0,2,0]], "scale": 1}"#);
    assert!(scaled.contains("its rotation is off by"), "{scaled}");
    assert!(message(&format!("[{unit}, 1, null]")).contains("members have names"));
    assert!(message(&" ".repeat(70_000)).contains("70000 bytes"));
    fs_err::write(&path, format!("\u{feff}{{\"transform\": {unit}, \"scale\": 2}}")).unwrap();
    assert!(SplatFrame::read(&path).is_ok(), "a byte order mark");
}
