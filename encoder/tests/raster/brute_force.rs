//! Contributions, drawings and their invariants on random scenes, against brute force and each other.

use super::*;

use super::backends::backends;

const SIZES_PX: [(u32, u32); 7] = [(1, 1), (16, 16), (17, 15), (5, 40), (33, 31), (64, 48), (70, 3)];

#[test]
fn weights_are_those_of_brute_force() {
    let cases = SIZES_PX.into_iter().enumerate().map(|(seed, (width, height))| {
        let random = &mut Random::new(seed as u64);
        let view = random_view(random, width, height);
        let scene = random_scene(random, 400, &view, 0);
        let regions = random_regions(random, &view, 9);
        Case::new(scene, view, regions)
    });
    let row =
        Row { name: "random scenes", range: "400 Gaussians, 1x1 to 70x3 px", claimed: 1e-5, unit_px: 1.0 };
    row.check(&cases.collect::<Vec<_>>());
}

#[test]
fn drawings_are_those_of_brute_force() {
    for Backend { rasterizer, bound_factor, cut_tolerance, keeps_order, .. } in backends() {
        for (seed, (width, height)) in SIZES_PX.into_iter().enumerate() {
            let random = &mut Random::new(seed as u64);
            let view = random_view(random, width, height);
            let scene = random_scene(random, 300, &view, (seed % 4) as u8);
            let background = [0.1, 0.7, 1.0];
            let found = rasterizer.draw(&scene, &view, background).unwrap();
            let n_px = (width * height) as usize;
            let (mut rgb, mut alpha, mut depth) = (vec![DVec3::ZERO; n_px], vec![0.0; n_px], vec![0.0; n_px]);
            let mut is_on_a_cut = vec![false; n_px];
            oracle::each_weight(&scene, &view, *cut_tolerance, |gaussian, pixel, weight| {
                rgb[pixel] += weight.value * oracle::colour(&scene, gaussian.index, &view);
                alpha[pixel] += weight.value;
                depth[pixel] += weight.value * gaussian.depth;
                is_on_a_cut[pixel] |= weight.high - weight.low > 1e-3 * weight.high;
            });
            let n_on_a_cut = is_on_a_cut.iter().filter(|is| **is).count();
            assert!(!keeps_order || n_on_a_cut * 10 <= n_px, "{width}x{height}");
            for pixel in (0..n_px).filter(|pixel| !is_on_a_cut[*pixel]) {
                let expected = rgb[pixel] + (1.0 - alpha[pixel]) * DVec3::new(0.1, 0.7, 1.0);
                for c in 0..3 {
                    let difference = (f64::from(found.rgb[pixel * 3 + c]) - expected[c]).abs();
                    assert!(difference < 3e-6 * bound_factor, "{width}x{height} pixel {pixel}: {difference}");
                }
                assert!((f64::from(found.coverage[pixel]) - alpha[pixel]).abs() < 1e-6 * bound_factor);
                let expected = if alpha[pixel] > 0.0 { depth[pixel] / alpha[pixel] } else { 0.0 };
                let difference = (f64::from(found.depth[pixel]) - expected).abs();
                assert!(difference < 1e-5 * bound_factor, "{width}x{height} pixel {pixel}: {difference}");
            }
        }
    }
}

#[test]
fn the_number_of_threads_does_not_change_a_bit() {
    for Backend { rasterizer, is_software_gpu, .. } in backends() {
        let random = &mut Random::new(5);
        let view = random_view(random, 150, 130);
        let scene = random_scene(random, if *is_software_gpu { 3_000 } else { 20_000 }, &view, 1);
        let regions = random_regions(random, &view, 300);
        let with_threads = |n| -> (ViewWeights, Drawing) {
            rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap().install(|| {
                (
                    rasterizer.weights(&scene, &view, &regions).unwrap(),
                    rasterizer.draw(&scene, &view, [0.5; 3]).unwrap(),
                )
            })
        };
        let one = with_threads(1);
        assert!(one.0.entries.len() > 1000);
        assert_eq!(one, with_threads(2));
        assert_eq!(one, with_threads(5));
    }
}

#[test]
fn nothing_to_see_is_no_error() {
    for Backend { rasterizer, .. } in backends() {
        let random = &mut Random::new(7);
        let view = random_view(random, 20, 20);
        let regions = random_regions(random, &view, 3);
        let mut behind = random_scene(random, 50, &view, 0);
        let world_from_camera = view.camera_from_world.inverse();
        behind.means_in_world.fill(world_from_camera.transform_point3(DVec3::new(0.1, 0.0, -4.0)));
        for scene in [Gaussians::default(), behind] {
            assert_eq!(rasterizer.weights(&scene, &view, &regions).unwrap(), ViewWeights::default());
            let drawing = rasterizer.draw(&scene, &view, [0.25; 3]).unwrap();
            assert!(drawing.rgb.iter().all(|&c| c == 0.25));
            assert!(drawing.depth.iter().chain(&drawing.coverage).all(|&v| v == 0.0));
        }
    }
}

/// A broken higher coefficient costs only the Gaussian's colour.
#[test]
fn broken_coefficients_cost_a_colour() {
    for Backend { rasterizer, .. } in backends() {
        let random = &mut Random::new(8);
        let view = random_view(random, 40, 40);
        let mut scene = random_scene(random, 100, &view, 1);
        let regions = random_regions(random, &view, 3);
        let weights = |scene: &Gaussians| rasterizer.weights(scene, &view, &regions).unwrap();
        let expected = weights(&scene);
        scene.sh_rest[9 * 50] = f32::NAN;
        assert_eq!(weights(&scene), expected);
        let drawing = rasterizer.draw(&scene, &view, [0.0; 3]).unwrap();
        assert!(drawing.rgb.iter().all(|c| c.is_finite()));
    }
}

#[test]
fn contradictions_are_errors() {
    for Backend { rasterizer, .. } in backends() {
        let random = &mut Random::new(9);
        let view = random_view(random, 20, 10);
        let scene = random_scene(random, 5, &view, 1);
        let regions = random_regions(random, &view, 3);
        let error = |scene: &Gaussians, view: &RasterView, regions: &RegionMap| {
            rasterizer.weights(scene, view, regions).unwrap_err()
        };
        let is_told = |error: RasterError, fault: &str| {
            assert!(matches!(error, RasterError::Input(_)) && error.to_string().contains(fault), "{error}");
        };
        let short = Gaussians { sh_rest: vec![0.0; 44], ..scene.clone() };
        is_told(error(&short, &view, &regions), "scene column sh_rest has 44 values, expected 45");
        let of_degree_4 = Gaussians { sh_degree: 4, ..scene.clone() };
        is_told(error(&of_degree_4, &view, &regions), "harmonics of degree 4");

        let with = |change: fn(&mut RasterView)| {
            let mut view = view;
            change(&mut view);
            error(&scene, &view, &regions)
        };
        is_told(with(|v| v.intrinsics.width_px = 0), "image of 0 x 10 px");
        is_told(with(|v| v.intrinsics.height_px = u32::MAX), "image of 20 x 4294967295 px");
        is_told(with(|v| v.intrinsics.focal_x_px = 0.0), "invalid camera: focal lengths [0.0, ");
        is_told(with(|v| v.intrinsics.centre_y_px = f64::NAN), "NaN] px; correct the intrinsics");
        is_told(with(|v| v.camera_from_world.matrix3 *= 2.0), "not rigid (deviation 3");
        is_told(with(|v| v.camera_from_world.matrix3 *= -1.0), "not rigid (deviation inf)");
        is_told(with(|v| v.camera_from_world.translation.x = f64::NAN), "not rigid (deviation NaN)");
        assert!(matches!(with(|v| v.intrinsics.width_px = 21), RasterError::RegionMapSize { .. }));
        let fisheye = with(|v| v.intrinsics.distortion = Distortion::Fisheye { k: [0.0; 4] });
        is_told(fisheye, "undistort the image");

        let mut wrong = regions.clone();
        wrong.region_of_pixel[33] = 3;
        assert_eq!(error(&scene, &view, &wrong), RasterError::Region { pixel: 33, found: 3, n_regions: 3 });
        wrong.region_of_pixel.pop();
        assert!(matches!(error(&scene, &view, &wrong), RasterError::RegionMapSize { found_values: 199, .. }));
    }
}
