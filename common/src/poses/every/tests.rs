use std::path::PathBuf;

use glam::DAffine3;

use super::*;
use crate::camera::{View, pinhole};
use crate::poses::PoseSource;

fn set(names: &[&str], without_pose: &[&str]) -> ViewSet {
    let view = |name: &&str| View {
        name: (*name).to_owned(),
        image_path: PathBuf::from(name),
        intrinsics: pinhole([8, 6], 8.0),
        camera_from_world: DAffine3::IDENTITY,
    };
    ViewSet {
        views: names.iter().map(view).collect(),
        source: PoseSource::Scannet,
        without_pose: without_pose.iter().map(|name| (*name).to_owned()).collect(),
        damaged: Vec::new(),
        notes: Vec::new(),
        applied: None,
    }
}

fn every(names: &[&str], without_pose: &[&str], n: u32) -> (Vec<String>, Vec<String>) {
    let kept = set(names, without_pose).every(NonZeroU32::new(n).unwrap());
    (kept.views.into_iter().map(|view| view.name).collect(), kept.without_pose)
}

#[test]
fn frames_are_counted_by_number_not_by_place() {
    // Frame 0 has no pose, yet counting begins there; 41 to 59 are not in the set.
    let names = ["1.jpg", "20.jpg", "21.jpg", "40.jpg", "60.jpg", "61.jpg"];
    let (kept, without_pose) = every(&names, &["0.jpg", "10.jpg"], 20);
    assert_eq!(kept, ["20.jpg", "40.jpg", "60.jpg"]);
    assert_eq!(without_pose, ["0.jpg"]);
    assert_eq!(every(&names, &[], 1).0, names);
}

#[test]
fn each_folder_counts_from_its_own_first_frame() {
    let names = ["left/f_0003.v2.jpg", "left/f_0004.v2.jpg", "right/10é.png", "right/12é.png"];
    assert_eq!(number("right/10é.png"), Some(10));
    assert_eq!(number("left/f_0003.v2.jpg"), Some(2), "the last digits count");
    assert_eq!(every(&names[2..], &[], 2).0, ["right/10é.png", "right/12é.png"]);
    let (kept, _) = every(&["a/5.png", "a/6.png", "b/6.png", "b/7.png"], &[], 2);
    assert_eq!(kept, ["a/5.png", "b/6.png"]);
}

#[test]
fn names_without_numbers_count_by_place() {
    assert_eq!(every(&["a.png", "b.png", "c7.png"], &[], 2).0, ["a.png", "c7.png"]);
    assert_eq!(number("99999999999999999999999.png"), None);
}

/// By hand: the last number is the same everywhere, so places count; stamps in steps of 5 are told.
#[test]
fn numbers_that_do_not_count_frames_are_passed_over_or_told() {
    let names = ["f_1_v2.jpg", "f_2_v2.jpg", "f_3_v2.jpg", "f_4_v2.jpg"];
    assert_eq!(every(&names, &[], 3).0, ["f_1_v2.jpg", "f_4_v2.jpg"]);
    let stamps = set(&["1005.jpg", "1010.jpg", "1030.jpg"], &[]).every(NonZeroU32::new(5).unwrap());
    assert!(stamps.views.len() == 3 && stamps.notes[0].contains("multiples of 5"), "{:?}", stamps.notes);
}
