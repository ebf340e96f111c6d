use std::path::Path;
use std::time::Duration;

use glam::DAffine3;
use slag_common::Gaussians;
use slag_common::appearance::AppearanceColumns;
use slag_common::container::AlignedBytes;
use slag_common::landmarks::{BuiltLandmarks, Landmark};
use slag_common::shard::{Additions, ShardLayout};
use slag_locate::Reason;
use slag_math::random::Random;
use slag_math::simd::InstructionSet;
use slag_raster::{PreparedScene, RasterView, pinhole};
use slag_test_support::assert_error;

use super::*;
use crate::score::Pool;
use crate::store::EdgeCache;
use crate::testing::{BuiltShard, Member, TestShard, write_cache};

/// A cache with one shard, with landmarks of a version, or none.
fn on_board(dir: &Path, version: Option<u32>) -> Snapshot {
    let plain = TestShard::new(vec![vec![member([0; 3])]]).build(false);
    let landmark = |x: f64| Landmark { position_in_world: DVec3::splat(x), code: 3, view: 0 };
    let built = BuiltLandmarks::pack(version.unwrap_or_default(), &[landmark(1.0), landmark(2.0)]);
    let landmarks = built.view().filter(|_| version.is_some());
    with(dir, &plain, Additions { landmarks, ..Additions::default() })
}

fn member(steps: [u16; 3]) -> Member {
    Member { steps, embedding: vec![1.0, 0.0] }
}

fn with(dir: &Path, plain: &BuiltShard, additions: Additions<'_>) -> Snapshot {
    let mut bytes = Vec::new();
    plain.view().write_with(&mut bytes, additions).expect("writes to memory");
    let bytes = AlignedBytes::copy_of(&bytes);
    let layout = ShardLayout::check(&bytes).expect("a valid shard");
    write_cache(dir, &[BuiltShard { layout, bytes, embeddings: plain.embeddings.clone() }], 1);
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
    let camera = Camera { focal_px: 500.0, centre_px: None, gravity: None, prior: None };
    let photo = png(64, 48);
    let answer = |snapshot: &Snapshot, photo: &[u8]| {
        answer(snapshot, PhotoFile::open(photo)?, &camera, &Budget::default())
    };
    let snapshot = on_board(&dir.path().join("other"), Some(CODE_VERSION + 1));
    let error = answer(&snapshot, &photo).expect_err("another version").to_string();
    assert!(error.contains("encode again"), "{error}");
    let snapshot = on_board(&dir.path().join("none"), None);
    let reason = |reason: Reason| Answer::Lost { reason: reason.to_string() };
    assert_eq!(answer(&snapshot, &photo).expect("an answer"), reason(Reason::EmptyMap));
    let snapshot = on_board(&dir.path().join("some"), Some(CODE_VERSION));
    assert_eq!(answer(&snapshot, &photo).expect("an answer"), reason(Reason::FewFeatures { found: 0 }));
    // Hostile files: text, a truncated picture, and three with gigantic stated sizes.
    let stating = |width: u32, height: u32| {
        let mut bytes = photo.clone();
        bytes[16..20].copy_from_slice(&width.to_be_bytes());
        bytes[20..24].copy_from_slice(&height.to_be_bytes());
        let checksum = crc32(&bytes[12..29]);
        bytes[29..33].copy_from_slice(&checksum.to_be_bytes());
        bytes
    };
    // Photos that decoders may accept or misname: a truncated copy, and other data in a photo's place.
    let jpeg = written(&image::RgbImage::new(64, 48).into(), image::ImageFormat::Jpeg);
    let cases = [
        (jpeg[..jpeg.len() - 20].to_vec(), "ends before"),
        (b"\0\0\0\x24ftypheic\0\0\0\0mif1heic".to_vec(), "heif-convert"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:00\n".to_vec(), "git lfs pull"),
        (b"\n<html>Please log in</html>".to_vec(), "a web page"),
        (written(&DynamicImage::new_rgba8(64, 48), image::ImageFormat::Png), "transparent"),
        (b"hello".to_vec(), "JPEG, PNG or WebP"),
        (photo[..40].to_vec(), "JPEG, PNG or WebP"),
        (stating(0x7fff_ffff, 1), "limit"),
        (stating(17_000, 10), "a side"),
        (stating(16_000, 4_000), "50000000 in all"),
    ];
    for (bytes, expected) in cases {
        assert_error(answer(&snapshot, &bytes), &[expected]);
    }
    // Invisible colours have no features: noise below one white pixel.
    let mut random = Random::new(1);
    let mut hidden = image::RgbaImage::from_fn(640, 480, |_, _| {
        let [r, g, b] = [(); 3].map(|()| random.bits() as u8);
        image::Rgba([r, g, b, 0])
    });
    let noise = DynamicImage::from(hidden.clone()).into_rgb8();
    hidden.put_pixel(0, 0, image::Rgba([255; 4]));
    let found = |photo: &DynamicImage| {
        answer(&snapshot, &written(photo, image::ImageFormat::Png)).expect("an answer")
    };
    let few = reason(Reason::FewFeatures { found: 0 });
    assert_eq!(found(&hidden.into()), few);
    assert_ne!(found(&noise.into()), few);
}

/// The checksum of PNG (ISO 3309), bit by bit.
fn crc32(bytes: &[u8]) -> u32 {
    let shifted = |crc: u32, _: u32| (crc >> 1) ^ (0xedb8_8320 * (crc & 1));
    !bytes.iter().fold(!0, |crc, byte| (0..8).fold(crc ^ u32::from(*byte), shifted))
}

fn png(width: u32, height: u32) -> Vec<u8> {
    written(&image::RgbImage::new(width, height).into(), image::ImageFormat::Png)
}

fn written(photo: &DynamicImage, format: image::ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    photo.write_to(&mut bytes, format).expect("memory");
    bytes.into_inner()
}

/// By hand: of 12 megapixels the grey takes 48 MB, halved once 12 MB; halved twice, doubled, and in ten pictures 120
/// MB; before that, decoding takes 144 MB.
#[test]
fn the_memory_of_a_photo_is_known_before_it_is_read() {
    let bytes = png(4000, 3000);
    let photo = PhotoFile::open(&bytes).expect("a photo");
    assert_eq!(photo.working_bytes(), 180_000_000);
    let bytes = png(640, 480);
    let photo = PhotoFile::open(&bytes).expect("a photo");
    assert!((640 * 480 * 100..640 * 480 * 180).contains(&photo.working_bytes()), "{}", photo.working_bytes());
}

/// By hand: a camera at (1, 2, 3) looking along the world's x with its top up has REP-103's orientation: no rotation.
#[test]
fn the_body_of_a_level_camera_is_not_turned() {
    let dir = tempfile::tempdir().expect("a folder");
    let snapshot = on_board(dir.path(), None);
    let world_from_camera = glam::DAffine3 {
        matrix3: DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X),
        translation: DVec3::new(1.0, 2.0, 3.0),
    };
    let camera_from_world = world_from_camera.inverse();
    let found = Located {
        camera_from_world,
        covariance: [0.0; 36],
        n_inliers: 9,
        is_verified: false,
        other_camera: None,
    };
    let Pose { position_in_world, rotation_xyzw, optical_rotation_xyzw, geographic, .. } =
        pose_of(&snapshot, &found);
    assert!(DVec3::from(position_in_world).distance(DVec3::new(1.0, 2.0, 3.0)) < 1e-12);
    assert!(DQuat::from_array(rotation_xyzw).angle_between(DQuat::IDENTITY) < 1e-6, "{rotation_xyzw:?}");
    let forward = DQuat::from_array(optical_rotation_xyzw) * DVec3::Z;
    assert!(forward.distance(DVec3::X) < 1e-9, "{optical_rotation_xyzw:?}");
    assert_eq!(geographic, None);
}

/// Culling changes no bit of a rendering, and nothing is rendered beyond the budget.
#[test]
fn what_is_beside_a_picture_is_not_drawn() {
    let random = &mut Random::new(3);
    let members = (0..2000).map(|_| member([0; 3].map(|_: i32| random.below(2000) as u16))).collect();
    let plain = TestShard::new(vec![members]).build(false);
    let means: Vec<DVec3> = (0..2000).map(|at| plain.view().position_in_world(at)).collect();
    let unit = |random: &mut Random| random.unit_vector(4).try_into().expect("four components");
    let scene = Gaussians {
        rotations_wxyz: means.iter().map(|_| unit(random)).collect(),
        scales: means.iter().map(|_| [0; 3].map(|_| (4.0 * random.unit() - 5.0).exp() as f32)).collect(),
        opacities: means.iter().map(|_| random.unit() as f32).collect(),
        sh_dc: means.iter().map(|_| [0; 3].map(|_| random.unit() as f32)).collect(),
        means_in_world: means.clone(),
        ..Gaussians::default()
    };
    let columns = AppearanceColumns::of(&scene, &(0..2000).collect::<Vec<_>>());
    let dir = tempfile::tempdir().expect("a folder");
    let appearance = Some(columns.view());
    let snapshot = with(dir.path(), &plain, Additions { appearance, ..Additions::default() });
    let mut all = Gaussians::default();
    means.iter().enumerate().for_each(|(at, mean)| columns.view().add_to(&mut all, at, *mean));
    // In the middle, along the world's x.
    let world_from_camera = DAffine3 {
        matrix3: DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X),
        translation: DVec3::splat(10.0),
    };
    let view =
        RasterView { camera_from_world: world_from_camera.inverse(), intrinsics: pinhole([64, 48], 60.0) };
    let budget = Budget::default();
    let on_board = OnBoard::of(&snapshot, &budget).expect("an appearance");
    let seen = on_board.seen(&view).expect("no bounds");
    assert!((100..1000).contains(&seen.len()), "{}", seen.len());
    let drawn = |scene: &Gaussians| PreparedScene::new(scene).draw(InstructionSet::widest(), &view, [0.5; 3]);
    let (seen, all) = (drawn(&seen), drawn(&all));
    assert!(seen.coverage.iter().any(|coverage| *coverage > 0.9));
    assert_eq!((seen.rgb, seen.depth, seen.coverage), (all.rgb, all.depth, all.coverage));

    // Refused before the list of visible Gaussians, and after it.
    for bytes in [10_000, 2000 * 8 + 64 * 48 * 160] {
        let budget = Budget::new(bytes, Duration::from_secs(60), &Pool::new(1 << 30));
        let on_board = OnBoard::of(&snapshot, &budget).expect("an appearance");
        assert!(on_board.render(&view.camera_from_world, &view.intrinsics).is_none());
        assert_eq!((budget.check(), budget.used_bytes()), (Ok(()), 0));
    }
}
