//! Planned views for splats without photos.

use super::*;
use std::sync::atomic::AtomicBool;

use glam::DQuat;
use slag_common::splat::{self, ReadOptions};
use slag_encoder::encode;
use slag_encoder::raster::Rasterizer;
use slag_encoder::viewpoints::{
    POSES_FILE, SceneKind, ViewpointError, ViewpointPlan, ViewpointSettings, draw, plan,
};
use slag_test_support::nightly;

/// Distance between Gaussians of a surface.
const SPACING: f64 = 0.1;

/// Adds a flat Gaussian every 0.1 units of a rectangle.
fn add_rectangle(scene: &mut Gaussians, corner: DVec3, a: DVec3, b: DVec3) {
    let rotation = DQuat::from_rotation_arc(DVec3::Z, a.cross(b).normalize());
    let n = [a, b].map(|side| (side.length() / SPACING).round() as i32);
    for (i, j) in (0..n[0]).flat_map(|i| (0..n[1]).map(move |j| (i, j))) {
        let at = |k: i32, n: i32| (f64::from(k) + 0.5) / f64::from(n);
        scene.means_in_world.push(corner + a * at(i, n[0]) + b * at(j, n[1]));
        scene.rotations_wxyz.push([rotation.w, rotation.x, rotation.y, rotation.z].map(|q| q as f32));
        scene.scales.push([0.07, 0.07, 0.002]);
        scene.opacities.push(0.97);
        scene.sh_dc.push([0.1; 3]);
    }
}

/// A closed room of 6 x 4 x 2.6, z up, with three tables.
fn room() -> Gaussians {
    let mut scene = Gaussians::default();
    let (x, y, z) = (DVec3::X * 6.0, DVec3::Y * 4.0, DVec3::Z * 2.6);
    for (corner, a, b) in [(DVec3::ZERO, x, y), (DVec3::ZERO, x, z), (DVec3::ZERO, y, z)] {
        add_rectangle(&mut scene, corner, a, b);
        add_rectangle(&mut scene, x + y + z - a - b, a, b);
    }
    for at in [DVec3::new(1.0, 1.0, 0.0), DVec3::new(3.5, 2.0, 0.0), DVec3::new(4.6, 0.4, 0.0)] {
        add_rectangle(&mut scene, at + DVec3::Z * 0.7, DVec3::X, DVec3::Y);
        add_rectangle(&mut scene, at, DVec3::X, DVec3::Z * 0.7);
        add_rectangle(&mut scene, at, DVec3::Y, DVec3::Z * 0.7);
    }
    scene
}

/// Rotates, then scales, then shifts a scene.
fn moved(scene: &Gaussians, turn: DQuat, scale: f64, shift: DVec3) -> Gaussians {
    let turned = |[w, x, y, z]: [f32; 4]| {
        let q = turn * DQuat::from_xyzw(x.into(), y.into(), z.into(), w.into());
        [q.w, q.x, q.y, q.z].map(|v| v as f32)
    };
    Gaussians {
        means_in_world: scene.means_in_world.iter().map(|at| turn * *at * scale + shift).collect(),
        rotations_wxyz: scene.rotations_wxyz.iter().map(|rotation| turned(*rotation)).collect(),
        scales: scene.scales.iter().map(|s| s.map(|s| (f64::from(s) * scale) as f32)).collect(),
        ..scene.clone()
    }
}

fn plan_of(scene: &Gaussians, up: Option<DVec3>) -> Result<ViewpointPlan, ViewpointError> {
    let settings = ViewpointSettings { n_views: 16, up };
    plan(scene, &CpuRasterizer, &settings, 1 << 30, &AtomicBool::new(false))
}

/// Oracle: the room's walls and upward direction.
#[test]
fn views_of_a_room_are_in_the_room_upright_for_any_number_of_threads() {
    let scene = room();
    let with = |n_threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().unwrap();
        pool.install(|| plan_of(&scene, None)).unwrap()
    };
    let plan = with(1);
    assert_eq!(plan, with(3));
    assert_eq!((plan.kind, plan.views.len()), (SceneKind::Indoor, 16));
    assert!(plan.up_in_world.dot(DVec3::Z) > 0.9998, "{:?}", plan.up_in_world);
    assert!(plan.seen > 0.9, "{}", plan.seen);
    for view in &plan.views {
        let at = view.camera_from_world.inverse().translation;
        assert!(at.cmpgt(DVec3::ZERO).all() && at.cmplt(DVec3::new(6.0, 4.0, 2.6)).all(), "{at:?}");
        // Rows of the rotation are the camera's axes in the world; y is down.
        assert!(view.camera_from_world.matrix3.row(1).z < -0.8);
        assert_eq!(view.verdict.fault(plan.kind), None);
    }
}

/// Rotated scenes keep their upward direction; scaled ones give the same views.
#[test]
fn plans_follow_the_scene() {
    let mut random = Random::new(48);
    let scene = room();
    let axis = DVec3::from_slice(&random.unit_vector(3).iter().map(|v| f64::from(*v)).collect::<Vec<_>>());
    let turn = DQuat::from_axis_angle(axis.normalize(), random.between(2.0, 4.0));
    let turned = plan_of(&moved(&scene, turn, 1.0, axis * 30.0), None).unwrap();
    let up = turn * DVec3::Z;
    assert!(turned.up_in_world.dot(up) > 0.9998, "{:?}, not {up:?}", turned.up_in_world);
    let plan = plan_of(&scene, None).unwrap();
    let (scale, shift) = (0.37, DVec3::new(5.0, -2.0, 1.0));
    let scaled = plan_of(&moved(&scene, DQuat::IDENTITY, scale, shift), None).unwrap();
    for (a, b) in plan.views.iter().zip(&scaled.views) {
        let [a, b] = [a, b].map(|view| view.camera_from_world.inverse());
        assert!(a.matrix3.abs_diff_eq(b.matrix3, 1e-5), "{a:?} {b:?}");
        assert!((a.translation * scale + shift).abs_diff_eq(b.translation, 1e-4), "{a:?} {b:?}");
    }
}

/// Rotated 20 times, no labelled scene is upside down; scaled 20 times, each has the same views.
#[needs_shared]
#[nightly("plans 120 times")]
fn labelled_scenes_are_never_upside_down() {
    let mut random = Random::new(4820);
    let mut axis = || DVec3::from([0; 3].map(|_| random.between(-1.0, 1.0)));
    let mut scales = Random::new(4821);
    for name in ["house_a", "yard_d", "site_e"] {
        let file = shared("scenes").join(name).join("point_cloud.ply");
        let scene = splat::read(&file, &ReadOptions::default()).unwrap();
        let plan = plan_of(&scene, None).unwrap();
        assert!(plan.up_in_world.dot(DVec3::Z) > 0.998, "{name}: {:?}", plan.up_in_world);
        for _ in 0..20 {
            let turn = DQuat::from_rotation_arc(axis().normalize(), axis().normalize());
            let turned = plan_of(&moved(&scene, turn, 1.0, DVec3::ZERO), None).unwrap();
            let cosine = turned.up_in_world.dot(turn * DVec3::Z);
            assert!(cosine > 0.998, "{name} turned by {turn:?}: {cosine}");
            let scale = scales.between(-4.0, 4.0).exp();
            let scaled = plan_of(&moved(&scene, DQuat::IDENTITY, scale, DVec3::ZERO), None).unwrap();
            assert_eq!(scaled.views.len(), plan.views.len(), "{name} scaled by {scale}");
            for (a, b) in plan.views.iter().zip(&scaled.views) {
                let [a, b] = [a, b].map(|view| view.camera_from_world.inverse());
                let is_same = a.matrix3.abs_diff_eq(b.matrix3, 1e-3)
                    && (a.translation * scale).distance(b.translation) < 1e-3 * scale;
                assert!(is_same, "{name} scaled by {scale}: {a:?} {b:?}");
            }
        }
    }
}

/// A yard of 12 x 12 with crates; a thirteenth of its Gaussians is a sky 300 away, which counts for nothing.
#[test]
fn a_sky_changes_no_plan() {
    let mut yard = Gaussians::default();
    add_rectangle(&mut yard, DVec3::ZERO, DVec3::X * 12.0, DVec3::Y * 12.0);
    for at in [DVec3::new(2.0, 3.0, 0.0), DVec3::new(8.0, 2.0, 0.0), DVec3::new(5.0, 9.0, 0.0)] {
        let sides = [DVec3::X, DVec3::Y].map(|side| side * 1.2);
        add_rectangle(&mut yard, at + DVec3::Z, sides[0], sides[1]);
        for (corner, side) in
            [(at, sides[0]), (at, sides[1]), (at + sides[0], sides[1]), (at + sides[1], sides[0])]
        {
            add_rectangle(&mut yard, corner, side, DVec3::Z);
        }
    }
    let n = yard.len();
    let mut under_a_sky = yard.clone();
    let mut random = Random::new(31);
    for _ in 0..n / 12 {
        let direction = DVec3::from([0; 3].map(|_| random.between(-1.0, 1.0))).normalize();
        under_a_sky.means_in_world.push(direction * 300.0);
        under_a_sky.rotations_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        under_a_sky.scales.push([9.0; 3]);
        under_a_sky.opacities.push(0.9);
        under_a_sky.sh_dc.push([0.1; 3]);
    }
    let plan = plan_of(&under_a_sky, None).unwrap();
    assert_eq!((plan.kind, plan.views.len()), (SceneKind::Outdoor, 16));
    assert!(plan.up_in_world.dot(DVec3::Z) > 0.9998, "{:?}", plan.up_in_world);
    for view in &plan.views {
        let at = view.camera_from_world.inverse().translation;
        let holds = (0.1..3.0).contains(&at.z) && at.truncate().distance(glam::DVec2::splat(6.0)) < 10.0;
        assert!(holds, "{at:?}");
    }
}

/// Two rooms above two others: half the height of the house is a floor.
#[test]
fn both_storeys_of_a_house_are_seen() {
    let mut house = Gaussians::default();
    for shift in [DVec3::ZERO, DVec3::Y * 4.0].map(|at| [at, at + DVec3::Z * 2.8]).concat() {
        let room = moved(&room(), DQuat::IDENTITY, 1.0, shift);
        house.means_in_world.extend(room.means_in_world);
        house.rotations_wxyz.extend(room.rotations_wxyz);
        house.scales.extend(room.scales);
        house.opacities.extend(room.opacities);
        house.sh_dc.extend(room.sh_dc);
    }
    let plan = plan_of(&house, None).unwrap();
    assert!(plan.up_in_world.dot(DVec3::Z) > 0.9998, "{:?}", plan.up_in_world);
    let heights: Vec<f64> =
        plan.views.iter().map(|view| view.camera_from_world.inverse().translation.z).collect();
    let is_in = |floor: f64| heights.iter().filter(|z| (floor + 0.4..floor + 2.2).contains(*z)).count();
    assert!(is_in(0.0) > 4 && is_in(2.8) > 4 && is_in(0.0) + is_in(2.8) == 16, "{heights:?}");
}

/// A ball alone has no upward direction: it is seen from all sides, with the file's.
#[test]
fn a_thing_by_itself_is_seen_from_around() {
    let mut random = Random::new(9);
    let places = std::iter::repeat_with(|| DVec3::from([0; 3].map(|_| random.between(-1.0, 1.0))));
    let means = places.filter(|at| at.length() <= 1.0).take(6000).collect();
    let mut ball = Gaussians::balls(means, 0.06);
    ball.opacities.fill(0.97);
    ball.sh_dc.fill([0.1; 3]);
    let plan = plan_of(&ball, None).unwrap();
    assert_eq!((plan.kind, plan.views.len()), (SceneKind::Object, 16));
    assert!(plan.up_in_world.dot(DVec3::NEG_Y) > 0.9999, "{:?}", plan.up_in_world);
    let mut sides = [false; 8];
    for view in &plan.views {
        let eye = view.camera_from_world.inverse().translation;
        let forward = view.camera_from_world.matrix3.row(2);
        assert!(eye.length() > 1.2 && forward.dot(-eye.normalize()) > 0.9, "{eye:?} {forward:?}");
        sides[((eye.z.atan2(eye.x) / std::f64::consts::TAU + 0.5) * 8.0) as usize % 8] = true;
    }
    assert_eq!(sides, [true; 8]);
}

/// Splats that cannot be planned are refused, and the message says what to add.
#[test]
fn splats_that_tell_too_little_are_refused() {
    let refused = |scene: &Gaussians, up| plan_of(scene, up).expect_err("refused").to_string();
    let mut point = room();
    point.means_in_world.fill(DVec3::new(1.0, 2.0, 3.0));
    assert!(refused(&point, None).contains("all Gaussians lie at [1, 2, 3]"), "{}", refused(&point, None));
    let message = refused(&Gaussians::default(), None);
    assert!(message.contains("--views"), "{message}");
    let mut random = Random::new(7);
    // A round cave of round Gaussians.
    let mut direction = || DVec3::from([0; 3].map(|_| random.between(-1.0, 1.0))).normalize_or_zero();
    let mut cave = Gaussians::balls((0..6000).map(|_| direction()).collect(), 0.03);
    cave.opacities.fill(0.97);
    assert!(refused(&cave, None).contains("which way is up"));
    // Floaters in all free space of the room.
    let mut floaters = room();
    for _ in 0..3000 {
        let at = [6.0, 4.0, 2.6].map(|side| random.between(0.0, side));
        floaters.means_in_world.push(at.into());
        floaters.rotations_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        floaters.scales.push([0.08; 3]);
        floaters.opacities.push(0.25);
        floaters.sh_dc.push([0.0; 3]);
    }
    let message = refused(&floaters, Some(DVec3::Z));
    assert!(message.contains("haze") && message.contains("--views"), "{message}");
}

/// A generated room without photos becomes a store whose summary and poses say that its images are drawings.
#[test]
fn a_splat_alone_is_encoded() {
    let folder = tempfile::tempdir().unwrap();
    let mut room = Scene::new(&[grammar::SceneKind::Room], 1, 3);
    let files = room.write(folder.path(), &Silent).unwrap();
    let store = folder.path().join("store");
    let poses = store.join("drawn").join(POSES_FILE);
    let mut settings = EncodeSettings::new(files.scene.clone(), poses.clone(), store, true);
    settings.inputs.planned = Some(ViewpointSettings { n_views: 6, up: None });
    settings.view.masks = Masks::Graph;
    settings.run.keep_views = true;
    let (models, session) = (ModelDir::colours(), SessionOptions::new("".into()));
    let engines = Engines::new(&models, &session, &CpuRasterizer);
    let encoded = |settings: &EncodeSettings| encode::encode(settings, &engines, &Silent, &false.into());
    let encode = |settings: &EncodeSettings| encoded(settings).unwrap();
    // Poses and photos of others are not replaced.
    fs_err::create_dir_all(poses.with_file_name("images")).unwrap();
    let others = ["images/a.jpg", POSES_FILE].map(|name| poses.with_file_name(name));
    for path in &others {
        fs_err::write(path, "{}").unwrap();
        assert_error(encoded(&settings), &["was not drawn by slag-encoder"]);
        let loaded = CpuRasterizer.load(&room.gaussians).unwrap();
        let drawn = draw(&poses.with_file_name(""), &mut [], loaded.as_ref(), "scene.ply", false, &Silent);
        assert!(drawn.unwrap_err().to_string().contains("was not drawn by slag-encoder"));
        fs_err::remove_file(path).unwrap();
    }
    let first = encode(&settings);
    assert_eq!((first.n_views, first.n_views_drawn, first.n_views_resumed), (6, 6, 0));
    assert!(first.n_masks > 6 && first.n_without_evidence < first.n_gaussians / 2, "{first:?}");
    assert_eq!(drawn_from(&poses).as_deref(), Some("scene.ply"));
    assert_eq!(drawn_from(&files.views), None);
    // The same plan is not made twice.
    assert_eq!(encode(&settings).n_views_resumed, 6);
}
