//! Locates a photo of a painted floor in a map of other photos of it. Truth: the cameras that drew the photos, by
//! intersection of rays and floor.

use glam::{DAffine3, DMat3, DVec2, DVec3};
use slag_common::{Intrinsics, pinhole};
use slag_locate::{
    Grey, Landmark, Located, Map, MappingView, Observation, Outcome, Photo, Prior, Reason, Renderer,
    Rendering, build, code, features, locate,
};
use slag_math::random::mix64;

const INTRINSICS: Intrinsics = pinhole([320, 240], 280.0);

/// Grey of a floor at a place: random squares in four sizes.
fn paint(floor: u64, at: DVec2) -> f32 {
    let of_size = |size: f64| {
        let (x, y) = ((at.x / size).floor() as i64 as u64, (at.y / size).floor() as i64 as u64);
        (mix64(floor ^ mix64(x ^ mix64(y ^ size.to_bits()))) >> 40) as f32 / (1u64 << 24) as f32
    };
    0.25 * [0.05, 0.11, 0.23, 0.47].map(of_size).iter().sum::<f32>()
}

/// Returns a camera above the floor that looks at a place of it.
fn looking(from: DVec3, at: DVec3) -> DAffine3 {
    let z = (at - from).normalize();
    let x = z.cross(DVec3::Z).normalize();
    let world_from_camera = DAffine3 { matrix3: DMat3::from_cols(x, z.cross(x), z), translation: from };
    world_from_camera.inverse()
}

/// Draws the floor z = 0 with 3 x 3 rays per pixel.
fn draw(floor: u64, camera_from_world: &DAffine3, intrinsics: &Intrinsics) -> Rendering {
    let (width, height) = (intrinsics.width_px as usize, intrinsics.height_px as usize);
    let world_from_camera = camera_from_world.inverse();
    let hit = |x: f64, y: f64| {
        let [u, v] = intrinsics.distorted_from_pixel([x, y]);
        let ray = world_from_camera.transform_vector3(DVec3::new(u, v, 1.0));
        let depth = -world_from_camera.translation.z / ray.z;
        (depth, world_from_camera.translation + depth * ray)
    };
    let grey = Grey { width, height, values: Vec::new() };
    let mut drawn = Rendering { grey, depth: Vec::with_capacity(width * height) };
    for (y, x) in (0..height).flat_map(|y| (0..width).map(move |x| (y as f64, x as f64))) {
        let rays =
            (0..9).map(|i| hit(x + f64::from(i % 3 * 2 + 1) / 6.0, y + f64::from(i / 3 * 2 + 1) / 6.0));
        drawn.grey.values.push(rays.map(|(_, at)| paint(floor, at.truncate())).sum::<f32>() / 9.0);
        drawn.depth.push(hit(x + 0.5, y + 0.5).0 as f32);
    }
    drawn
}

struct Floor(u64);

impl Renderer for Floor {
    fn render(&self, camera_from_world: &DAffine3, intrinsics: &Intrinsics) -> Option<Rendering> {
        Some(draw(self.0, camera_from_world, intrinsics))
    }
}

fn map_of(floor: u64) -> Map {
    Map::new(floor_landmarks(floor))
}

fn floor_landmarks(floor: u64) -> Vec<Landmark> {
    let view = |view: u16| {
        let at = DVec3::new(f64::from(view % 3) - 1.0, f64::from(view / 3) - 1.0, 0.0);
        let camera_from_world = looking(at + DVec3::new(0.3, -1.5, 2.0), at);
        let drawn = draw(floor, &camera_from_world, &INTRINSICS);
        let observation = |feature: slag_locate::Feature| {
            let at = DVec2::from(feature.at);
            let depth = drawn.depth_at(at)?;
            let point_in_world = slag_locate::point_in_world(&camera_from_world, &INTRINSICS, at, depth);
            Some(Observation { at, point_in_world, code: code(&feature.descriptor) })
        };
        let observations = features(&drawn.grey, 600).into_iter().filter_map(observation).collect();
        MappingView { view, intrinsics: INTRINSICS, camera_from_world, observations }
    };
    build(&(0..9).map(view).collect::<Vec<_>>(), 3000)
}

#[test]
fn a_photo_is_located_and_another_floor_is_lost() {
    let map = map_of(1);
    let truth = looking(DVec3::new(0.6, -1.1, 1.7), DVec3::new(0.2, 0.3, 0.0));
    let grey = draw(1, &truth, &INTRINSICS).grey;
    let photo = Photo { grey: &grey, intrinsics: &INTRINSICS, gravity_in_camera: None, prior: None };
    for renderer in [None, Some(&Floor(1) as &dyn Renderer)] {
        let Outcome::Found(found) = locate(&map, &photo, renderer) else { panic!("lost") };
        let moved = (found.camera_from_world.inverse().translation - truth.inverse().translation).length();
        let turned = (found.camera_from_world.matrix3 * truth.matrix3.transpose()).to_cols_array();
        let cosine = (turned[0] + turned[4] + turned[8] - 1.0) / 2.0;
        assert!(moved < 0.02 && cosine > 0.9999, "{moved} m, {cosine}, {} inliers", found.n_inliers);
        assert_eq!(found.is_verified, renderer.is_some());
        // The error is within three standard deviations, which do not exceed the required accuracy.
        let sigma = [0, 7, 14].map(|at| found.covariance[at]).iter().sum::<f64>().sqrt();
        assert!(moved < 3.0 * sigma && sigma < 0.05, "{moved} {sigma}");
        assert_eq!(locate(&map, &photo, renderer), Outcome::Found(found), "the same again");
    }
    let gravity = |in_world: DVec3| {
        let gravity_in_camera = Some(truth.transform_vector3(in_world));
        locate(&map, &Photo { gravity_in_camera, ..photo }, None)
    };
    assert!(matches!(gravity(DVec3::NEG_Z), Outcome::Found(_)));
    assert_eq!(gravity(DVec3::new(0.3, 0.0, -1.0)), Outcome::Lost(Reason::Gravity));
    let near = |position_in_world: DVec3| {
        let prior = Some(Prior { position_in_world, sigma: 0.5 });
        locate(&map, &Photo { prior, ..photo }, None)
    };
    assert!(matches!(near(DVec3::new(0.0, 0.0, 1.7)), Outcome::Found(_)));
    assert_eq!(near(DVec3::new(0.6, -1.1, 4.0)), Outcome::Lost(Reason::Prior));
    // Another floor; then the right pose, but a splat of another floor, which verifies nothing.
    let values: Vec<f32> = grey.values.chunks(grey.width).flat_map(|row| row.iter().rev().copied()).collect();
    let mirrored = Grey { values, ..grey };
    for renderer in [None, Some(&Floor(1) as &dyn Renderer)] {
        let outcome = locate(&map, &Photo { grey: &mirrored, ..photo }, renderer);
        assert_eq!(outcome, Outcome::Lost(Reason::Mirrored));
    }
    let other = draw(2, &truth, &INTRINSICS).grey;
    assert!(matches!(locate(&map, &Photo { grey: &other, ..photo }, None), Outcome::Lost(_)));
    let Outcome::Found(found) = locate(&map, &photo, Some(&Floor(2))) else { panic!("lost") };
    assert!(!found.is_verified);
}

/// As of a smaller copy with the whole photo's focal length, another zoom, or a guess; then as of a calibration that is
/// off by 2 %.
#[test]
fn a_wrong_focal_length_is_told_or_held() {
    let map = map_of(1);
    let truth = looking(DVec3::new(0.6, -1.1, 1.7), DVec3::new(0.2, 0.3, 0.0));
    let grey = draw(1, &truth, &INTRINSICS).grey;
    let stated = |factor: f64| {
        let focal_px = factor * INTRINSICS.focal_x_px;
        let intrinsics = Intrinsics { focal_x_px: focal_px, focal_y_px: focal_px, ..INTRINSICS };
        let photo = Photo { grey: &grey, intrinsics: &intrinsics, gravity_in_camera: None, prior: None };
        [None, Some(&Floor(1) as &dyn Renderer)].map(|renderer| locate(&map, &photo, renderer))
    };
    for factor in [0.67, 1.1, 2.0] {
        for outcome in stated(factor) {
            let Outcome::Unsure(candidates) = outcome else { panic!("{factor}: {outcome:?}") };
            let focal_px = candidates[0].other_camera.expect("another").focal.x;
            assert!((focal_px / INTRINSICS.focal_x_px - 1.0).abs() < 0.03, "{factor}: {focal_px}");
        }
    }
    for outcome in stated(1.02) {
        let Outcome::Found(found) = outcome else { panic!("{outcome:?}") };
        let moved = found.camera_from_world.inverse().translation.distance(truth.inverse().translation);
        let sigma = [0, 7, 14].map(|at| found.covariance[at]).iter().sum::<f64>().sqrt();
        assert!(moved < 3.0 * sigma && sigma < 0.05, "{moved} {sigma}");
    }
}

/// As of a crop, and of a copy that was stretched, with the whole photo's camera.
#[test]
fn a_wrong_centre_or_aspect_is_told() {
    let map = map_of(1);
    let truth = looking(DVec3::new(0.6, -1.1, 1.7), DVec3::new(0.2, 0.3, 0.0));
    let grey = draw(1, &truth, &INTRINSICS).grey;
    let of = INTRINSICS;
    let centre = Intrinsics { centre_x_px: 1.4 * of.centre_x_px, ..of };
    let aspect = Intrinsics { focal_y_px: 1.25 * of.focal_y_px, ..of };
    for stated in [centre, aspect] {
        let photo = Photo { grey: &grey, intrinsics: &stated, gravity_in_camera: None, prior: None };
        for renderer in [None, Some(&Floor(1) as &dyn Renderer)] {
            let outcome = locate(&map, &photo, renderer);
            // A plane does not tell by which of them the camera is another.
            let Outcome::Unsure(candidates) = outcome else { panic!("{stated:?}: {outcome:?}") };
            assert!(candidates[0].other_camera.is_some());
        }
    }
}

/// The same floor twice, 50 m apart: both poses are candidates, unless it is known which it is.
#[test]
fn places_that_look_alike_are_candidates() {
    let once = floor_landmarks(1);
    let away = DVec3::new(50.0, 0.0, 0.0);
    let again = once.iter().map(|one| Landmark {
        position_in_world: one.position_in_world + away,
        view: one.view + 9,
        ..*one
    });
    let map = Map::new(once.iter().copied().chain(again).collect());
    let truth = looking(DVec3::new(0.6, -1.1, 1.7), DVec3::new(0.2, 0.3, 0.0));
    let grey = draw(1, &truth, &INTRINSICS).grey;
    let photo = Photo { grey: &grey, intrinsics: &INTRINSICS, gravity_in_camera: None, prior: None };
    let Outcome::Unsure(candidates) = locate(&map, &photo, None) else { panic!("two places") };
    let at = truth.inverse().translation;
    for place in [at, at + away] {
        let is_there = |one: &Located| one.camera_from_world.inverse().translation.distance(place) < 0.1;
        assert_eq!(candidates.iter().filter(|one| is_there(one)).count(), 1, "{place}");
    }
    let prior = Some(Prior { position_in_world: at + away, sigma: 5.0 });
    let Outcome::Found(found) = locate(&map, &Photo { prior, ..photo }, None) else { panic!("one place") };
    assert!(found.camera_from_world.inverse().translation.distance(at + away) < 0.1);
}

#[test]
fn hostile_photos_are_lost() {
    let map = map_of(1);
    let noise = |width: usize, height: usize| {
        let values = (0..(width * height) as u64).map(|at| (mix64(at) >> 40) as f32 / (1u64 << 24) as f32);
        Grey { width, height, values: values.collect() }
    };
    let plain = |value: f32| Grey { width: 640, height: 480, values: vec![value; 640 * 480] };
    let noises = [(640, 480), (1, 1), (5000, 3), (15, 2000)].map(|(width, height)| noise(width, height));
    for grey in noises.into_iter().chain([0.0, f32::NAN, 1e30].map(plain)) {
        let intrinsics =
            Intrinsics { width_px: grey.width as u32, height_px: grey.height as u32, ..INTRINSICS };
        let photo =
            Photo { grey: &grey, intrinsics: &intrinsics, gravity_in_camera: Some(DVec3::NAN), prior: None };
        assert!(matches!(locate(&map, &photo, None), Outcome::Lost(_)), "{} x {}", grey.width, grey.height);
    }
    let grey = noise(64, 64);
    let photo = Photo { grey: &grey, intrinsics: &INTRINSICS, gravity_in_camera: None, prior: None };
    assert_eq!(locate(&Map::new(Vec::new()), &photo, None), Outcome::Lost(Reason::EmptyMap));
}
