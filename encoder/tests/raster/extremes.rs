//! Geometry and opacity at the extremes: rows of the table in docs/numerics.md, against float64.

use super::*;
use slag_encoder::raster::RegionWeight;
use slag_encoder::raster::constants::{MAX_IMAGE_PX, MAX_SIDE_PX, SUM_FRACTION_BITS};

use super::backends::backends;
use slag_test_support::{is_nightly, trials};

/// Many views of few Gaussians, so that none hides the others. Focal lengths lie within a range.
fn cases(
    n: u64,
    size_px: [u32; 2],
    [shortest_px, longest_px]: [f64; 2],
    fill: impl Fn(&mut Gaussians, &RasterView, &mut Random),
) -> Vec<Case> {
    let case = |seed| {
        let random = &mut Random::new(seed);
        let is_fixed = shortest_px == longest_px;
        let focal_px = if is_fixed { shortest_px } else { random.log_between(shortest_px, longest_px) };
        let view = posed(random, size_px, focal_px);
        let mut scene = Gaussians::default();
        fill(&mut scene, &view, random);
        let regions = random_regions(random, &view, 5);
        Case::new(scene, view, regions)
    };
    (0..n).map(case).collect()
}

#[test]
fn scales() {
    let cases = cases(60, [40, 30], [50.0; 2], |scene, view, random| {
        for _ in 0..12 {
            let mean = random.in_view(view, [0.3, 8.0]);
            let scales = std::array::from_fn(|_| random.log_between(1e-6, 1e3));
            let opacity = random.between(0.05, 1.0);
            push(scene, view, random, mean, scales, opacity);
        }
    });
    let range = "1e-6 to 1e3 world units, each axis its own";
    Row { name: "scales", range, claimed: 1e-5, unit_px: 1.0 }.check(&cases);
}

/// Views of needles and discs whose axes differ by up to `max_ratio`.
fn needles(max_ratio: f64, focal_px: [f64; 2]) -> Vec<Case> {
    cases(60, [40, 30], focal_px, |scene, view, random| {
        for _ in 0..12 {
            let mean = random.in_view(view, [0.3, 8.0]);
            let longest = random.log_between(1e-2, 1e3);
            let ratio = random.log_between(1.0, max_ratio);
            let middle = random.log_between(1.0, ratio);
            let opacity = random.between(0.05, 1.0);
            push(scene, view, random, mean, [longest, longest / middle, longest / ratio], opacity);
        }
    })
}

#[test]
fn anisotropy() {
    let range = "longest to shortest axis 1 to 1e4, to 1e5 px long";
    Row { name: "anisotropy", range, claimed: 1e-5, unit_px: 1.0 }.check(&needles(1e4, [50.0; 2]));
}

/// As a difference, the determinant of such a covariance has no correct digit in float64.
#[test]
fn anisotropy_through_long_lenses() {
    let range = "ratio to 1e9, focal lengths 2,000 to 20,000 px, to 6e7 px long";
    let cases = needles(1e9, [2_000.0, 20_000.0]);
    Row { name: "long needles", range, claimed: 1e-5, unit_px: 1.0 }.check(&cases);
}

#[test]
fn opacities() {
    let cases = cases(40, [24, 20], [30.0; 2], |scene, view, random| {
        for i in 0..24 {
            let mean = random.in_view(view, [0.5, 8.0]);
            let scales = std::array::from_fn(|_| random.log_between(0.02, 1.0));
            // Dense at both ends.
            let share = random.log_between(1e-4, 1.0);
            push(scene, view, random, mean, scales, if i % 2 == 0 { share } else { 1.0 - share });
        }
    });
    Row { name: "opacities", range: "1e-4 to 0.9999", claimed: 1e-5, unit_px: 1.0 }.check(&cases);
}

/// A trainer's PLY, with double properties.
fn ply(rows: &[[f64; 14]]) -> Vec<u8> {
    let names = "x y z rot_0 rot_1 rot_2 rot_3 scale_0 scale_1 scale_2 opacity f_dc_0 f_dc_1 f_dc_2";
    let mut bytes = format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n", rows.len());
    names.split(' ').for_each(|name| bytes += &format!("property double {name}\n"));
    let mut bytes = (bytes + "end_header\n").into_bytes();
    rows.as_flattened().iter().for_each(|value| bytes.extend(value.to_le_bytes()));
    bytes
}

pub fn read_ply(rows: &[[f64; 14]]) -> Gaussians {
    let file = tempfile::Builder::new().suffix(".ply").tempfile().unwrap();
    fs_err::write(file.path(), ply(rows)).unwrap();
    splat::read(file.path(), &ReadOptions::default()).unwrap()
}

/// Oracle: the logistic function by hyperbolic tangent.
#[test]
fn logits() {
    let read = cases(40, [24, 20], [30.0; 2], |scene, view, random| {
        let rows: Vec<[f64; 14]> = (0..24)
            .map(|i| {
                let [x, y, z] = {
                    let mean = random.in_view(view, [0.5, 8.0]);
                    view.camera_from_world.inverse().transform_point3(mean).to_array()
                };
                let [a, b, c] = std::array::from_fn(|_| random.between(-4.0, 0.0));
                let logit = [-50.0, 50.0, f64::INFINITY, f64::NEG_INFINITY];
                let logit = logit.get(i).copied().unwrap_or_else(|| random.between(-50.0, 50.0));
                let [w, i] = [random.between(0.5, 1.0), random.between(-1.0, 1.0)];
                [x, y, z, w, i, 0.1, 0.2, a, b, c, logit, 0.0, 0.0, 0.0]
            })
            .collect();
        *scene = read_ply(&rows);
        for (row, opacity) in rows.iter().zip(&scene.opacities) {
            let expected = 0.5 + 0.5 * (row[10] / 2.0).tanh();
            assert!((f64::from(*opacity) - expected).abs() <= 1e-7, "logit {}: {opacity}", row[10]);
        }
    });
    let range = "-50 to 50 and infinite, through the PLY reader";
    Row { name: "logits", range, claimed: 1e-5, unit_px: 1.0 }.check(&read);
}

/// Pixels within a few f32 steps of both cuts, beside an isolated Gaussian, so that pixels on a cut are few.
#[test]
fn on_the_cuts() {
    let steps = |value: f32, n: i32| f64::from(f32::from_bits(value.to_bits().wrapping_add_signed(n)));
    let cases = cases(8, [48, 32], [50.0; 2], |scene, view, random| {
        for i in 0..20 {
            let (x, y) = (f64::from(4 * (i % 5)) + 2.5, f64::from(4 * (i / 5)) + 2.5);
            let (dx, dy) = (random.between(0.0, 0.05), random.between(0.0, 0.05));
            // Without an extent of its own, a Gaussian has the blur's variance.
            let falloff = (-0.5 * (dx * dx + dy * dy) / 0.3).exp();
            let mut layer = |depth: f64, alpha: f64| {
                let mean = unproject(view, x + dx, y + dy, depth);
                push(scene, view, random, mean, [1e-6; 3], alpha / falloff);
            };
            let n = i % 7 - 3;
            if i % 2 == 0 {
                layer(1.0, steps(1.0 / 255.0, n));
            } else {
                // 0.01 of the light passes each; what is behind gets all or nothing of the rest.
                layer(1.0, f64::from(0.99_f32));
                layer(2.0, steps(0.99, n));
                layer(3.0, 0.5);
            }
        }
        push(scene, view, random, unproject(view, 36.0, 20.0, 1.0), [0.2; 3], 0.9);
    });
    let range = "alpha within 3 steps of f32 of 1/255, transmittance of 1e-4";
    Row { name: "on the cuts", range, claimed: 1e-5, unit_px: 1e-2 }.check(&cases);
}

/// Relative to themselves: 2,300 layers of alpha 1/255 leave 1e-4 for the last.
#[test]
fn pile() {
    let n_gaussians = trials(20_000, 100_000);
    let case = |[low, high]: [f64; 2]| {
        let random = &mut Random::new(3);
        let view = posed(random, [2, 2], 50.0);
        let mut scene = Gaussians::default();
        for _ in 0..n_gaussians {
            // 8,000 different depths in f32: most are ties, broken by index.
            let mean = unproject(
                &view,
                random.between(0.0, 2.0),
                random.between(0.0, 2.0),
                random.between(1.0, 1.001),
            );
            let opacity = random.between(low, high);
            push(&mut scene, &view, random, mean, [1.0; 3], opacity);
        }
        let regions =
            RegionMap { width_px: 2, height_px: 2, n_regions: 2, region_of_pixel: vec![0, 1, 1, 0] };
        Case::new(scene, view, regions)
    };
    let cases: Vec<Case> = [[0.00394, 0.00394], [0.0, 0.01], [0.9, 1.0]].map(case).into();
    let range = "20,000 Gaussians on a pixel (100,000 in the nightly checks), to 2,300 blended";
    Row { name: "pile", range, claimed: 1e-5, unit_px: 1e-4 }.check(&cases);
}

#[test]
fn near_plane() {
    let cases = cases(60, [40, 30], [50.0; 2], |scene, view, random| {
        for i in 0..40 {
            // A quarter each: about the plane, in front of it, behind the camera, at the scene's depth.
            let depth = [0.01, 0.05, -1.0, 3.0][i % 4] * random.log_between(0.5, 2.0);
            let mean = unproject(view, random.between(-20.0, 60.0), random.between(-15.0, 45.0), depth);
            let scales = std::array::from_fn(|_| random.log_between(1e-4, 1.0));
            let opacity = random.between(0.05, 0.5);
            push(scene, view, random, mean, scales, opacity);
        }
    });
    let range = "depths 0.005 to 0.02 about the plane at 0.01, and behind";
    Row { name: "near plane", range, claimed: 1e-5, unit_px: 1.0 }.check(&cases);
}

/// The oracle sees the scene at the origin: coordinates are multiples of 2^-20, so moving it by whole units is exact.
#[test]
fn far_from_the_origin() {
    let case = |seed: u64| {
        let random = &mut Random::new(seed);
        let view = random_view(random, 40, 30);
        let mut scene = random_scene(random, 200, &view, 0);
        scene.means_in_world.iter_mut().for_each(|mean| *mean = (*mean * 1048576.0).round() / 1048576.0);
        let regions = random_regions(random, &view, 5);
        let offset = (random.direction() * 1e6).round();
        let mut moved = scene.clone();
        moved.means_in_world.iter_mut().for_each(|mean| *mean += offset);
        let camera_from_world = view.camera_from_world * DAffine3::from_translation(-offset);
        let moved_view = RasterView { camera_from_world, ..view };
        Case { exact: Some((scene, view)), ..Case::new(moved, moved_view, regions) }
    };
    let range = "means and camera 1e6 units from the origin";
    Row { name: "far", range, claimed: 1e-5, unit_px: 1.0 }.check(&(0..12).map(case).collect::<Vec<_>>());
}

#[test]
fn focal_lengths() {
    let cases = cases(60, [40, 30], [50.0, 20_000.0], |scene, view, random| {
        for _ in 0..16 {
            let mean = random.in_view(view, [0.05, 500.0]);
            let unit_of_px = mean.z / view.intrinsics.focal_x_px;
            let scales = std::array::from_fn(|_| random.log_between(0.01, 100.0) * unit_of_px);
            let opacity = random.between(0.05, 1.0);
            push(scene, view, random, mean, scales, opacity);
        }
    });
    Row { name: "focal lengths", range: "50 to 20,000 px", claimed: 1e-5, unit_px: 1.0 }.check(&cases);
}

#[test]
fn image_sizes() {
    let sizes_px = [[1, 1], [8192, 5], [1, 8192], [MAX_SIDE_PX, 1], [2, MAX_SIDE_PX]];
    let of_size = |size_px| {
        cases(3, size_px, [4000.0; 2], |scene, view, random| {
            for _ in 0..20 {
                let mean = random.in_view(view, [0.5, 8.0]);
                let scales = std::array::from_fn(|_| random.log_between(1e-5, 1.0));
                let opacity = random.between(0.05, 0.7);
                push(scene, view, random, mean, scales, opacity);
            }
        })
    };
    let cases: Vec<Case> = sizes_px.into_iter().flat_map(of_size).collect();
    let range = "1x1, 8192x5, 1x8192, 32768x1, 2x32768 px";
    Row { name: "image sizes", range, claimed: 1e-5, unit_px: 1.0 }.check(&cases);
    for size_px in [[MAX_SIDE_PX + 1, 1], [1, 1 << 24]] {
        let Case { scene, regions, view, .. } = &cases[0];
        let view = RasterView { intrinsics: pinhole(size_px, 4000.0), ..*view };
        for Backend { rasterizer, .. } in backends() {
            assert_error(rasterizer.weights(scene, &view, regions), &["sides of at most 32768 px"]);
        }
    }
}

/// Closed form: a very wide Gaussian adds its opacity at every pixel, the one behind it the rest. A running sum in
/// f32 stops growing at 2^24 steps.
#[test]
fn sums_over_many_pixels() {
    let random = &mut Random::new(1);
    let (width_px, height_px) = (8192, 2048);
    let view = posed(random, [width_px, height_px], 4000.0);
    let mut scene = Gaussians::default();
    for (depth, opacity) in [(1.0, 0.7), (2.0, 0.999), (3.0, 0.01)] {
        push(&mut scene, &view, random, DVec3::Z * depth, [1e7; 3], opacity);
    }
    let n_px = (width_px * height_px) as usize;
    let regions = RegionMap { width_px, height_px, n_regions: 1, region_of_pixel: vec![0; n_px] };
    let cap = 0.999;
    let weights = [0.7, 0.3 * cap, 0.3 * (1.0 - cap) * 0.01].map(|weight| weight * n_px as f64);
    for Backend { name, rasterizer, bound_factor, keeps_order, is_software_gpu, .. } in backends() {
        if *is_software_gpu && !is_nightly() {
            println!("left to the nightly checks: {name}");
            continue;
        }
        let found = rasterizer.weights(&scene, &view, &regions).unwrap();
        if !keeps_order {
            // Wider than f32 holds squared.
            assert_eq!((found.counters.unusable, found.entries.len()), (3, 0));
            println!("| sums | {n_px} px of one region | {name} | rejected, counted |");
            continue;
        }
        assert_eq!(found.entries.len(), 3);
        let error =
            |(entry, expected): (&RegionWeight, f64)| (f64::from(entry.weight) / expected - 1.0).abs();
        let measured = found.entries.iter().zip(weights).map(error).fold(0.0, f64::max);
        println!("| sums | {n_px} px of one region | {name} | measured {measured:.1e} | claimed 2e-5 |");
        assert!(measured <= 2e-5 * bound_factor, "{name}: {measured}");
    }
}

/// The largest view, and four times as much, stay within 64 bits at 2^32 steps a pixel.
#[test]
fn fixed_point_sums_hold_a_billion_pixels() {
    for n_px in [MAX_IMAGE_PX, 1_000_000_000] {
        assert!(n_px.checked_mul(1 << SUM_FRACTION_BITS).is_some(), "{n_px}");
    }
}
