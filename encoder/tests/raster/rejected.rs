//! Gaussians that cannot be drawn are rejected and counted, and do not affect the others.

use super::*;

use super::backends::backends;
use super::extremes::read_ply;

type Edit = Box<dyn Fn(&mut Gaussians, usize)>;

fn poisons() -> Vec<(String, Edit)> {
    let mut all: Vec<(String, Edit)> = Vec::new();
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        let single = bad as f32;
        for axis in 0..3 {
            all.push((format!("mean[{axis}] {bad}"), Box::new(move |s, i| s.means_in_world[i][axis] = bad)));
            all.push((format!("scale[{axis}] {bad}"), Box::new(move |s, i| s.scales[i][axis] = single)));
            all.push((format!("colour[{axis}] {bad}"), Box::new(move |s, i| s.sh_dc[i][axis] = single)));
        }
        for part in 0..4 {
            all.push((
                format!("rotation[{part}] {bad}"),
                Box::new(move |s, i| s.rotations_wxyz[i][part] = single),
            ));
        }
        all.push((format!("opacity {bad}"), Box::new(move |s, i| s.opacities[i] = single)));
    }
    for (opacity, scale) in [(-1e-7, 0.1), (1.0 + 1e-6, 0.1), (0.5, -1e-30)] {
        let name = format!("opacity {opacity}, scale {scale}");
        all.push((
            name,
            Box::new(move |s, i| {
                s.opacities[i] = opacity;
                s.scales[i][1] = scale;
            }),
        ));
    }
    all
}

#[test]
fn values_that_are_no_numbers() {
    let random = &mut Random::new(8);
    let view = posed(random, [30, 20], 30.0);
    let mut scene = random_scene(random, 60, &view, 0);
    push(&mut scene, &view, random, DVec3::Z * 0.02, [0.1; 3], 0.9);
    let victim = scene.len() - 1;
    let regions = random_regions(random, &view, 4);
    let mut without = scene.clone();
    without.opacities[victim] = 0.0;
    let poisons = poisons();
    for Backend { name, rasterizer, .. } in backends() {
        let weights = |scene: &Gaussians| rasterizer.weights(scene, &view, &regions).unwrap();
        let expected = weights(&without);
        assert_eq!(expected.counters.unusable, 0);
        assert_ne!(expected.entries, weights(&scene).entries, "the victim must be seen");
        for (what, poison) in &poisons {
            let mut poisoned = scene.clone();
            poison(&mut poisoned, victim);
            let found = weights(&poisoned);
            assert_eq!(found.counters.unusable, 1, "{name}: {what}");
            assert_eq!(found.entries, expected.entries, "{name}: {what}");
            let drawing = rasterizer.draw(&poisoned, &view, [0.0; 3]).unwrap();
            assert_eq!(drawing.counters.unusable, 1);
            assert!(drawing.rgb.iter().chain(&drawing.depth).all(|v| v.is_finite()), "{name}: {what}");
        }
        println!(
            "| no numbers | {} fields and values | {name} | rejected and counted, others bit-equal |",
            poisons.len()
        );
    }
}

/// Finite numbers beyond the arithmetic: invisible or rejected, never an infinity in the result.
#[test]
fn numbers_beyond_the_arithmetic() {
    let random = &mut Random::new(9);
    let view = posed(random, [30, 20], 30.0);
    let scene = random_scene(random, 60, &view, 0);
    let regions = random_regions(random, &view, 4);
    let world_from_camera = view.camera_from_world.inverse();
    let ahead = world_from_camera.transform_vector3(DVec3::Z);
    let mut beyond = scene.clone();
    // A variance beyond f32, a mean beyond the far plane, and products that overflow f64.
    for (mean, scale) in [
        (world_from_camera.transform_point3(DVec3::Z), f64::from(f32::MAX)),
        (ahead * 1e20, 1.0),
        (ahead * f64::MAX, 1.0),
        (DVec3::splat(f64::MAX), 1.0),
        (DVec3::splat(f64::MIN), f64::from(f32::MAX)),
    ] {
        push(&mut beyond, &view, random, DVec3::Z, [scale; 3], 0.9);
        *beyond.means_in_world.last_mut().unwrap() = mean;
    }
    for Backend { name, rasterizer, .. } in backends() {
        let weights = |scene| rasterizer.weights(scene, &view, &regions).unwrap();
        let found = weights(&beyond);
        assert!(found.counters.unusable >= 1, "{name}");
        assert_eq!(found.entries, weights(&scene).entries, "{name}");
        let n_rejected = found.counters.unusable;
        println!(
            "| beyond range | means to 1.8e308, scales to 3.4e38 | {name} | {n_rejected} rejected, 5 unseen |"
        );
    }
}

/// Rotations in files, and whether a reader can normalise them.
const QUATERNIONS: [([f64; 4], bool); 9] = [
    ([0.0; 4], false),
    ([f64::NAN, 0.0, 0.0, 1.0], false),
    ([f64::INFINITY, 0.0, 0.0, 1.0], false),
    ([0.3, -0.1, 0.2, 0.4], true),
    ([-3e9, 2e9, 1e9, 0.0], true),
    ([1e-30, 2e-30, -1e-30, 1e-30], true),
    // Denormal as f32.
    ([3e-42, -1e-42, 2e-42, 0.0], true),
    ([1e-45, 0.0, 0.0, 1e-45], true),
    ([3e38, -1e38, 2e38, 0.0], true),
];

/// Oracle: normalisation after scaling by the largest component.
#[test]
fn rotations_through_the_readers() {
    let cases: Vec<Case> = (0..20)
        .map(|seed| {
            let random = &mut Random::new(seed);
            let view = posed(random, [30, 20], 30.0);
            let rows: Vec<[f64; 14]> = (0..QUATERNIONS.len())
                .map(|i| {
                    let mean = random.in_view(&view, [0.5, 5.0]);
                    let [x, y, z] = view.camera_from_world.inverse().transform_point3(mean).to_array();
                    let [w, i, j, k] = QUATERNIONS[i].0.map(|c| f64::from(c as f32));
                    let [a, b, c] = [-3.0, -1.0, -2.0];
                    [x, y, z, w, i, j, k, a, b, c, 0.3, 0.0, 0.0, 0.0]
                })
                .collect();
            let scene = read_ply(&rows);
            let mut exact = scene.clone();
            for (i, (_, is_rotation)) in QUATERNIONS.iter().enumerate() {
                assert_eq!(scene.is_usable(i), *is_rotation, "{:?}", QUATERNIONS[i]);
                let raw = [rows[i][3], rows[i][4], rows[i][5], rows[i][6]];
                let largest = raw.iter().fold(0.0_f64, |m, c| m.max(c.abs()));
                let scaled = raw.map(|c| c / largest);
                let norm = scaled.iter().map(|c| c * c).sum::<f64>().sqrt();
                if *is_rotation {
                    exact.rotations_wxyz[i] = scaled.map(|c| (c / norm) as f32);
                }
            }
            let regions = random_regions(random, &view, 3);
            let n_unusable = QUATERNIONS.iter().filter(|q| !q.1).count();
            Case { exact: Some((exact, view)), n_unusable, ..Case::new(scene, view, regions) }
        })
        .collect();
    let range = "unnormalised 1e-45 to 3e38 as read; zero and not finite rejected";
    Row { name: "rotations", range, claimed: 1e-5, unit_px: 1.0 }.check(&cases);
}

/// .splat files store rotations as bytes; four zeros are invalid.
#[test]
fn rotations_of_dot_splat() {
    let row = |rotation: [u8; 4]| {
        let mut row: Vec<u8> =
            [0.0_f32, 0.0, 2.0, 0.1, 0.1, 0.1].into_iter().flat_map(f32::to_le_bytes).collect();
        row.extend([255, 0, 0, 128]);
        row.extend(rotation);
        row
    };
    let file = tempfile::Builder::new().suffix(".splat").tempfile().unwrap();
    fs_err::write(file.path(), [row([128; 4]), row([255, 128, 128, 128]), row([1, 2, 3, 4])].concat())
        .unwrap();
    let scene = splat::read(file.path(), &ReadOptions::default()).unwrap();
    assert_eq!((0..3).map(|i| scene.is_usable(i)).collect::<Vec<_>>(), [false, true, true]);
    let mut scene = Gaussians { sh_degree: 1, sh_rest: vec![0.1; 27], ..scene };
    scene.sh_rest[26] = f32::NAN;
    assert_eq!((scene.drop_broken_harmonics(), scene.drop_broken_harmonics()), (1, 0));
    assert_eq!(scene.sh_rest, [[0.1; 18].as_slice(), &[0.0; 9]].concat());
}

/// In memory, a rotation must have unit length to 5e-4; it is then normalised in f64.
#[test]
fn rotations_in_memory() {
    let lengths = [0.0, 1e-45, 1e-20, 0.5, 0.999, 0.9996, 1.0, 1.0004, 1.001, 2.0, 1e20, 3e38];
    let is_unit = |length: f64| (length - 1.0).abs() < 5e-4;
    let cases: Vec<Case> = (0..20)
        .map(|seed| {
            let random = &mut Random::new(seed);
            let view: RasterView = random_view(random, 30, 20);
            let mut scene = Gaussians::default();
            for length in lengths {
                let mean = unproject(&view, random.between(0.0, 30.0), random.between(0.0, 20.0), 2.0);
                push(&mut scene, &view, random, mean, [0.5, 0.02, 0.1], 0.3);
                let rotation = scene.rotations_wxyz.last_mut().unwrap();
                *rotation = rotation.map(|c| (f64::from(c) * length) as f32);
            }
            let regions = random_regions(random, &view, 3);
            let n_unusable = lengths.iter().filter(|length| !is_unit(**length)).count();
            Case { n_unusable, ..Case::new(scene, view, regions) }
        })
        .collect();
    let range = "lengths 0 to 3e38 in memory; off by 5e-4 rejected";
    Row { name: "rotations", range, claimed: 1e-5, unit_px: 1.0 }.check(&cases);
}
