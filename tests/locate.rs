//! From a photo to a place to stand: the camera's pose, what the robot finds from there, where it may go.

use super::*;
use glam::DMat4;
use slag_tests::*;

/// Photos without landmarks of their own, with known poses.
#[test]
fn a_photo_leads_to_a_place_to_stand() {
    let room = ["--n-views", "24", "--seed", "7"];
    let flags = ["--models", "colours", "--locate", "--appearance", "--occupancy", "0.1"];
    let site = Site::of(&room, &flags);
    let robot = site.robot(&[]);
    let photos = generated(&room).join("test");
    let poses = read_json(&photos.join("transforms.json"));
    let focal_px = poses["fl_x"].to_string();
    let (mut n_found, mut n_drawn, mut n_stood) = (0, 0, 0);
    let frames = poses["frames"].as_array().expect("frames");
    for frame in frames {
        let photo = photos.join(frame["file_path"].as_str().expect("a name"));
        let command = ["locate", text(&photo), "--focal-px", &focal_px, "--cache"];
        let found = run_json(edge(&command).arg(site.cache()));
        println!("{} {found}", photo.display());
        if found["state"] != "found" {
            continue;
        }
        n_found += 1;
        n_drawn += usize::from(found["verified_by"] == "rendering");
        let at: [f64; 3] = serde_json::from_value(found["position_in_world"].clone()).expect("a position");
        assert!(DVec3::from(at).distance(position(&frame["transform_matrix"])) < 0.05, "{found}");
        let goal = robot.get(&format!("/v1/goal?text=yellow&near={},{},0", at[0], at[1]));
        n_stood += usize::from(goal["goals"].as_array().is_some_and(|goals| !goals.is_empty()));
    }
    let n = frames.len();
    // The splat lacks details of the photos.
    assert!(n_drawn >= 3, "{n_drawn} of {n} verified by a drawing");
    assert!(n_found >= 5 && n_stood >= 5, "{n_found} of {n} found, {n_stood} with a place to stand");
}

/// Returns where a camera is, by its row-major matrix.
fn position(matrix: &Value) -> DVec3 {
    let rows: [[f64; 4]; 4] = serde_json::from_value(matrix.clone()).expect("a matrix");
    DMat4::from_cols_array_2d(&rows).row(3).truncate()
}
