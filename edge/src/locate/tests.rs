use slag_common::container::AlignedBytes;
use slag_common::landmarks::{BuiltLandmarks, Landmark};
use slag_common::shard::{Additions, ShardLayout};
use slag_locate::Reason;

use super::*;
use crate::store::EdgeCache;
use crate::testing::{BuiltShard, Member, TestShard, write_cache};

/// A cache whose one shard has landmarks of a version, or none.
fn on_board(dir: &Path, version: Option<u32>) -> Snapshot {
    let plain = TestShard::new(vec![vec![Member { steps: [0; 3], embedding: vec![1.0, 0.0] }]]).build(false);
    let landmark = |x: f64| Landmark { position_in_world: DVec3::splat(x), code: 3, view: 0 };
    let built = BuiltLandmarks::pack(version.unwrap_or_default(), &[landmark(1.0), landmark(2.0)]);
    let additions =
        Additions { landmarks: built.view().filter(|_| version.is_some()), ..Additions::default() };
    let mut bytes = Vec::new();
    plain.view().write_with(&mut bytes, additions).expect("writes to memory");
    let bytes = AlignedBytes::copy_of(&bytes);
    let layout = ShardLayout::check(&bytes).expect("a valid shard");
    write_cache(dir, &[BuiltShard { layout, bytes, embeddings: plain.embeddings }], 1);
    Snapshot::open(&EdgeCache::open(dir)).expect("opens")
}

#[test]
fn landmarks_on_board_make_the_map() {
    let dir = tempfile::tempdir().expect("a folder");
    let map = map_on_board(&on_board(dir.path(), Some(CODE_VERSION))).expect("of this version");
    assert_eq!(map.len(), 2);
}

#[test]
fn what_cannot_be_matched_is_told() {
    let dir = tempfile::tempdir().expect("a folder");
    let camera = Camera { focal_px: 500.0, centre_px: None, gravity: None };
    let photo = dir.path().join("photo.png");
    image::RgbImage::new(64, 48).save(&photo).expect("writes");
    let snapshot = on_board(&dir.path().join("other"), Some(CODE_VERSION + 1));
    let error = answer(&snapshot, &photo, &camera).expect_err("another version").to_string();
    assert!(error.contains("encode again"), "{error}");
    let snapshot = on_board(&dir.path().join("none"), None);
    let reason = |reason: Reason| Answer::Lost { reason: reason.to_string() };
    assert_eq!(answer(&snapshot, &photo, &camera).expect("an answer"), reason(Reason::EmptyMap));
    let snapshot = on_board(&dir.path().join("some"), Some(CODE_VERSION));
    let lost = answer(&snapshot, &photo, &camera).expect("an answer");
    assert_eq!(lost, reason(Reason::FewFeatures { found: 0 }));
    // Hostile files: text, a cut picture, and one that states a gigantic size.
    let whole = fs_err::read(&photo).expect("reads");
    let mut vast = whole.clone();
    vast[16..24].fill(0x7f);
    for bytes in [b"hello".as_slice(), &whole[..40], &vast] {
        fs_err::write(&photo, bytes).expect("writes");
        let error = answer(&snapshot, &photo, &camera).expect_err("no picture").to_string();
        assert!(error.contains("photo.png") && error.contains("JPEG, PNG or WebP"), "{error}");
    }
}

/// By hand: a camera at (1, 2, 3) that looks along the world's x with its top up stands as REP-103 stands: its
/// rotation is none.
#[test]
fn the_body_of_a_level_camera_is_not_turned() {
    let dir = tempfile::tempdir().expect("a folder");
    let snapshot = on_board(dir.path(), None);
    let world_from_camera = glam::DAffine3 {
        matrix3: DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X),
        translation: DVec3::new(1.0, 2.0, 3.0),
    };
    let camera_from_world = world_from_camera.inverse();
    let found = Located { camera_from_world, covariance: [0.0; 36], n_inliers: 9, is_verified: false };
    let Answer::Found { position_in_world, rotation_xyzw, optical_rotation_xyzw, geographic, .. } =
        found_answer(&snapshot, &found)
    else {
        panic!("found")
    };
    assert!(DVec3::from(position_in_world).distance(DVec3::new(1.0, 2.0, 3.0)) < 1e-12);
    assert!(DQuat::from_array(rotation_xyzw).angle_between(DQuat::IDENTITY) < 1e-6, "{rotation_xyzw:?}");
    let forward = DQuat::from_array(optical_rotation_xyzw) * DVec3::Z;
    assert!(forward.distance(DVec3::X) < 1e-9, "{optical_rotation_xyzw:?}");
    assert_eq!(geographic, None);
}
