//! Against brute force in float64: every pixel over all Gaussians sorted by depth, no tiles.
//!
//! Written from the conventions of the recorded data, with the textbook inverse covariance; it shares
//! no arithmetic with the rasteriser.

use std::collections::BTreeMap;

use glam::{DAffine3, DMat2, DMat3, DQuat, DVec2, DVec3};
use slag_common::{Distortion, Gaussians, Intrinsics};
use slag_encoder::raster::{
    CpuRasterizer, Drawing, RasterError, RasterView, Rasterizer, ViewWeights, WeightKind,
};
use slag_encoder::segment::{NO_REGION, RegionMap};

/// SplitMix64 (Steele et al. 2014): small, seeded, the same everywhere.
struct Random(u64);

impl Random {
    fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (self.bits() >> 11) as f64 * 2.0_f64.powi(-53) * (high - low)
    }

    fn below(&mut self, n: u32) -> u32 {
        (self.bits() % u64::from(n)) as u32
    }

    fn direction(&mut self) -> DVec3 {
        DVec3::from_array(std::array::from_fn(|_| self.between(-1.0, 1.0))).normalize()
    }
}

fn random_view(random: &mut Random, width_px: u32, height_px: u32) -> RasterView {
    let focal = random.between(0.6, 2.0) * f64::from(width_px.max(height_px));
    let rotation = DQuat::from_axis_angle(random.direction(), random.between(0.0, 3.0));
    let position = random.direction() * 3.0;
    let world_from_camera = DAffine3::from_rotation_translation(rotation, position);
    RasterView {
        camera_from_world: world_from_camera.inverse(),
        intrinsics: Intrinsics {
            width_px,
            height_px,
            focal_x_px: focal,
            focal_y_px: focal * random.between(0.9, 1.1),
            centre_x_px: f64::from(width_px) * random.between(0.4, 0.6),
            centre_y_px: f64::from(height_px) * random.between(0.4, 0.6),
            distortion: Distortion::None,
        },
    }
}

/// Gaussians around the view's axis, from before the near plane to 10 units away.
fn random_scene(random: &mut Random, n: usize, view: &RasterView, sh_degree: u8) -> Gaussians {
    let world_from_camera = view.camera_from_world.inverse();
    let mut scene = Gaussians { sh_degree, ..Gaussians::default() };
    for _ in 0..n {
        let z = random.between(-0.5, 10.0);
        let spread = 0.8 * z.abs();
        let mean = DVec3::new(random.between(-spread, spread), random.between(-spread, spread), z);
        scene.means_in_world.push(world_from_camera.transform_point3(mean));
        let axis = random.direction();
        let rotation = DQuat::from_axis_angle(axis, random.between(0.0, 6.0));
        scene.rotations_wxyz.push([rotation.w, rotation.x, rotation.y, rotation.z].map(|c| c as f32));
        scene.scales.push(std::array::from_fn(|_| random.between(-7.0, 0.3).exp() as f32));
        scene.opacities.push(random.between(0.0, 1.0) as f32);
        scene.sh_dc.push(std::array::from_fn(|_| random.between(-2.0, 2.0) as f32));
        for _ in 0..Gaussians::sh_rest_per_channel(sh_degree) * 3 {
            scene.sh_rest.push(random.between(-0.5, 0.5) as f32);
        }
    }
    scene
}

fn random_regions(random: &mut Random, view: &RasterView, n_regions: u32) -> RegionMap {
    let (width_px, height_px) = (view.intrinsics.width_px, view.intrinsics.height_px);
    // Runs of random length, so that there are both uniform and mixed stretches.
    let mut region_of_pixel = Vec::new();
    while region_of_pixel.len() < (width_px * height_px) as usize {
        let region = if random.below(5) == 0 { NO_REGION } else { random.below(n_regions) };
        let run = 1 + random.below(3) * random.below(30);
        region_of_pixel.extend((0..run).map(|_| region));
    }
    region_of_pixel.truncate((width_px * height_px) as usize);
    RegionMap { width_px, height_px, region_of_pixel, n_regions }
}

/// A Gaussian as the oracle sees it.
struct Projected {
    index: usize,
    depth: f64,
    mean: DVec2,
    inverse: DMat2,
    opacity: f64,
}

fn project(scene: &Gaussians, view: &RasterView) -> Vec<Projected> {
    let camera = &view.intrinsics;
    let (fx, fy) = (camera.focal_x_px, camera.focal_y_px);
    let (cx, cy) = (camera.centre_x_px, camera.centre_y_px);
    let (w, h) = (f64::from(camera.width_px), f64::from(camera.height_px));
    let mut all = Vec::new();
    for index in 0..scene.len() {
        let p = view.camera_from_world.transform_point3(scene.means_in_world[index]);
        let opacity = f64::from(scene.opacities[index]);
        if p.z < 0.01 || p.z > 1e10 || opacity < 1.0 / 255.0 {
            continue;
        }
        let [qw, qx, qy, qz] = scene.rotations_wxyz[index].map(f64::from);
        let rs = DMat3::from_quat(DQuat::from_xyzw(qx, qy, qz, qw).normalize())
            * DMat3::from_diagonal(DVec3::from_array(scene.scales[index].map(f64::from)));
        let rotation = view.camera_from_world.matrix3;
        let sigma = rotation * (rs * rs.transpose()) * rotation.transpose();
        let (margin_x, margin_y) = (0.3 * 0.5 * w / fx, 0.3 * 0.5 * h / fy);
        let tx = p.z * (p.x / p.z).clamp(-cx / fx - margin_x, (w - cx) / fx + margin_x);
        let ty = p.z * (p.y / p.z).clamp(-cy / fy - margin_y, (h - cy) / fy + margin_y);
        let jx = DVec3::new(fx / p.z, 0.0, -fx * tx / (p.z * p.z));
        let jy = DVec3::new(0.0, fy / p.z, -fy * ty / (p.z * p.z));
        let xy = jx.dot(sigma * jy);
        let covariance = DMat2::from_cols(
            DVec2::new(jx.dot(sigma * jx) + 0.3, xy),
            DVec2::new(xy, jy.dot(sigma * jy) + 0.3),
        );
        all.push(Projected {
            index,
            depth: p.z,
            mean: DVec2::new(fx * p.x / p.z + cx, fy * p.y / p.z + cy),
            inverse: covariance.inverse(),
            opacity,
        });
    }
    all.sort_by(|a, b| (a.depth as f32).total_cmp(&(b.depth as f32)).then(a.index.cmp(&b.index)));
    all
}

/// Calls `f(Gaussian, pixel, blend weight, falloff)` for each Gaussian that counts at a pixel; with
/// `hidden` also for those behind an opaque surface.
fn each_weight(
    scene: &Gaussians,
    view: &RasterView,
    hidden: bool,
    mut f: impl FnMut(&Projected, usize, f64, f64),
) {
    let projected = project(scene, view);
    let width = view.intrinsics.width_px as usize;
    for pixel in 0..width * view.intrinsics.height_px as usize {
        let centre = DVec2::new((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
        let mut transmittance = 1.0;
        for gaussian in &projected {
            let d = centre - gaussian.mean;
            let falloff = (-0.5 * d.dot(gaussian.inverse * d)).exp();
            let alpha = (gaussian.opacity * falloff).min(0.999);
            if alpha < 1.0 / 255.0 {
                continue;
            }
            if !hidden && transmittance * (1.0 - alpha) <= 1e-4 {
                break;
            }
            f(gaussian, pixel, alpha * transmittance, falloff);
            transmittance *= 1.0 - alpha;
        }
    }
}

fn oracle_weights(
    scene: &Gaussians,
    view: &RasterView,
    regions: &RegionMap,
    kind: WeightKind,
) -> BTreeMap<(u32, u32), f64> {
    let mut sums = BTreeMap::new();
    each_weight(scene, view, kind == WeightKind::Falloff, |gaussian, pixel, weight, falloff| {
        let region = regions.region_of_pixel[pixel];
        if region != NO_REGION {
            let value = if kind == WeightKind::Blend { weight } else { falloff };
            *sums.entry((gaussian.index as u32, region)).or_insert(0.0) += value;
        }
    });
    sums
}

const SIZES_PX: [(u32, u32); 7] = [(1, 1), (16, 16), (17, 15), (5, 40), (33, 31), (64, 48), (70, 3)];
const KINDS: [WeightKind; 2] = [WeightKind::Blend, WeightKind::Falloff];

/// The seeds meet no pixel on the edge of a cut (alpha = 1/255, transmittance = 1e-4), so that only
/// rounding is left: f32 weights below 1, summed over up to 3,072 pixels.
#[test]
fn weights_are_those_of_brute_force() {
    for (seed, (width, height)) in SIZES_PX.into_iter().enumerate() {
        let random = &mut Random(seed as u64);
        let view = random_view(random, width, height);
        let scene = random_scene(random, 400, &view, 0);
        let regions = random_regions(random, &view, 9);
        for kind in KINDS {
            let found = CpuRasterizer.weights(&scene, &view, &regions, kind).unwrap();
            let expected = oracle_weights(&scene, &view, &regions, kind);
            assert!(!expected.is_empty());
            let pairs =
                |e: &ViewWeights| e.entries.iter().map(|e| (e.gaussian, e.region)).collect::<Vec<_>>();
            assert_eq!(pairs(&found), expected.keys().copied().collect::<Vec<_>>(), "{width}x{height}");
            for (entry, (key, expected)) in found.entries.iter().zip(&expected) {
                let difference = (f64::from(entry.weight) - expected).abs();
                assert!(
                    difference < 1e-5 * expected.max(1.0),
                    "{width}x{height} {kind:?} {key:?}: {difference}"
                );
            }
        }
    }
}

/// Colour by the published formula of real spherical harmonics in factored form (Sloan 2008, A2), not
/// by the polynomials that renderers use.
fn oracle_colour(scene: &Gaussians, index: usize, view: &RasterView) -> DVec3 {
    let position = view.camera_from_world.inverse().translation;
    let d = (scene.means_in_world[index] - position).normalize();
    let n = Gaussians::sh_rest_per_channel(scene.sh_degree);
    let mut colour = DVec3::splat(0.5);
    for l in 0..=i32::from(scene.sh_degree) {
        for m in -l..=l {
            let i = (l * l + l + m) as usize;
            let coefficient = DVec3::from_array(std::array::from_fn(|c| {
                f64::from(if i == 0 {
                    scene.sh_dc[index][c]
                } else {
                    scene.sh_rest[(index * n + i - 1) * 3 + c]
                })
            }));
            colour += spherical_harmonic(l, m, d) * coefficient;
        }
    }
    colour.max(DVec3::ZERO)
}

/// Returns the real spherical harmonic with the Condon-Shortley phase, as 3DGS has it.
fn spherical_harmonic(l: i32, m: i32, d: DVec3) -> f64 {
    let (theta_cos, phi) = (d.z, d.y.atan2(d.x));
    let factorial = |n: i32| (1..=n).map(f64::from).product::<f64>();
    let k = ((2 * l + 1) as f64 / (4.0 * std::f64::consts::PI) * factorial(l - m.abs())
        / factorial(l + m.abs()))
    .sqrt();
    let p = associated_legendre(l, m.abs(), theta_cos);
    match m {
        0 => k * p,
        1.. => std::f64::consts::SQRT_2 * k * (f64::from(m) * phi).cos() * p,
        _ => std::f64::consts::SQRT_2 * k * (f64::from(-m) * phi).sin() * p,
    }
}

/// Returns P_l^m with the factor (-1)^m, by recurrence (Press et al., Numerical Recipes, 6.7).
fn associated_legendre(l: i32, m: i32, x: f64) -> f64 {
    let mut p_mm = 1.0;
    for i in 1..=m {
        p_mm *= -f64::from(2 * i - 1) * (1.0 - x * x).sqrt();
    }
    let (mut before, mut p) = (0.0, p_mm);
    for n in m + 1..=l {
        (before, p) = (p, (x * f64::from(2 * n - 1) * p - f64::from(n + m - 1) * before) / f64::from(n - m));
    }
    p
}

#[test]
fn drawings_are_those_of_brute_force() {
    for (seed, (width, height)) in SIZES_PX.into_iter().enumerate() {
        let random = &mut Random(seed as u64);
        let view = random_view(random, width, height);
        let scene = random_scene(random, 300, &view, (seed % 4) as u8);
        let background = [0.1, 0.7, 1.0];
        let found = CpuRasterizer.draw(&scene, &view, background).unwrap();
        let n_px = (width * height) as usize;
        let (mut rgb, mut alpha, mut depth) = (vec![DVec3::ZERO; n_px], vec![0.0; n_px], vec![0.0; n_px]);
        each_weight(&scene, &view, false, |gaussian, pixel, weight, _| {
            rgb[pixel] += weight * oracle_colour(&scene, gaussian.index, &view);
            alpha[pixel] += weight;
            depth[pixel] += weight * gaussian.depth;
        });
        for pixel in 0..n_px {
            let expected = rgb[pixel] + (1.0 - alpha[pixel]) * DVec3::new(0.1, 0.7, 1.0);
            for c in 0..3 {
                let difference = (f64::from(found.rgb[pixel * 3 + c]) - expected[c]).abs();
                assert!(difference < 3e-6, "{width}x{height} pixel {pixel}: {difference}");
            }
            assert!((f64::from(found.coverage[pixel]) - alpha[pixel]).abs() < 1e-6);
            let expected = if alpha[pixel] > 0.0 { depth[pixel] / alpha[pixel] } else { 0.0 };
            assert!((f64::from(found.depth[pixel]) - expected).abs() < 1e-5, "{width}x{height} {pixel}");
        }
    }
}

#[test]
fn the_number_of_threads_does_not_change_a_bit() {
    let random = &mut Random(5);
    let view = random_view(random, 150, 130);
    let scene = random_scene(random, 20_000, &view, 1);
    let regions = random_regions(random, &view, 300);
    let with_threads = |n| -> (Vec<ViewWeights>, Drawing) {
        rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap().install(|| {
            (
                KINDS.map(|kind| CpuRasterizer.weights(&scene, &view, &regions, kind).unwrap()).into(),
                CpuRasterizer.draw(&scene, &view, [0.5; 3]).unwrap(),
            )
        })
    };
    let one = with_threads(1);
    assert!(one.0[0].entries.len() > 1000);
    assert_eq!(one, with_threads(2));
    assert_eq!(one, with_threads(5));
}

/// Sums over a coarser partition are the sums of its parts: to the fixed point's 2^-33 a part and
/// tile, and the final rounding to `f32`.
#[test]
fn sums_over_regions_add_up() {
    let random = &mut Random(6);
    let view = random_view(random, 100, 90);
    let scene = random_scene(random, 3000, &view, 0);
    let fine = random_regions(random, &view, 200);
    let coarse_of = |region: u32| if region == NO_REGION { NO_REGION } else { region % 4 };
    let coarse = RegionMap {
        region_of_pixel: fine.region_of_pixel.iter().map(|&r| coarse_of(r)).collect(),
        n_regions: 4,
        ..fine
    };
    for kind in KINDS {
        let mut sums = BTreeMap::<_, f64>::new();
        let mut n_parts = BTreeMap::<_, usize>::new();
        for entry in CpuRasterizer.weights(&scene, &view, &fine, kind).unwrap().entries {
            let key = (entry.gaussian, coarse_of(entry.region));
            *sums.entry(key).or_default() += f64::from(entry.weight);
            *n_parts.entry(key).or_default() += 1;
        }
        let found = CpuRasterizer.weights(&scene, &view, &coarse, kind).unwrap().entries;
        assert_eq!(found.len(), sums.len());
        assert!(n_parts.values().any(|&n| n > 10));
        for entry in found {
            let key = (entry.gaussian, entry.region);
            let weight = f64::from(entry.weight);
            let allowed = weight * 2.0_f64.powi(-23) + 42.0 * 50.0 * 2.0_f64.powi(-33);
            assert!((weight - sums[&key]).abs() <= allowed, "{key:?}: {weight} {}", sums[&key]);
        }
    }
}

#[test]
fn nothing_to_see_is_no_error() {
    let random = &mut Random(7);
    let view = random_view(random, 20, 20);
    let regions = random_regions(random, &view, 3);
    let mut behind = random_scene(random, 50, &view, 0);
    let world_from_camera = view.camera_from_world.inverse();
    behind.means_in_world.fill(world_from_camera.transform_point3(DVec3::new(0.1, 0.0, -4.0)));
    for scene in [Gaussians::default(), behind] {
        for kind in KINDS {
            assert_eq!(CpuRasterizer.weights(&scene, &view, &regions, kind).unwrap(), ViewWeights::default());
        }
        let drawing = CpuRasterizer.draw(&scene, &view, [0.25; 3]).unwrap();
        assert!(drawing.rgb.iter().all(|&c| c == 0.25));
        assert!(drawing.depth.iter().chain(&drawing.coverage).all(|&v| v == 0.0));
    }
}

/// Broken rows are counted, and change nothing for the others.
#[test]
fn unusable_gaussians_are_skipped_and_counted() {
    let random = &mut Random(8);
    let view = random_view(random, 40, 40);
    let mut scene = random_scene(random, 100, &view, 1);
    let regions = random_regions(random, &view, 3);
    let without = |scene: &Gaussians| {
        let mut scene = scene.clone();
        scene.opacities[..7].fill(0.0);
        CpuRasterizer.weights(&scene, &view, &regions, WeightKind::Blend).unwrap()
    };
    let expected = without(&scene);
    scene.means_in_world[0].y = f64::NAN;
    scene.means_in_world[1].x = f64::INFINITY;
    scene.rotations_wxyz[2] = [0.0; 4];
    scene.scales[3][1] = f32::NAN;
    scene.opacities[4] = f32::NAN;
    scene.sh_dc[5][0] = f32::INFINITY;
    scene.scales[6] = [f32::MAX; 3];
    scene.means_in_world[6] = view.camera_from_world.inverse().transform_point3(DVec3::Z);
    scene.opacities[6] = 0.5;
    // A broken higher coefficient costs the Gaussian its colour, no more.
    scene.sh_rest[9 * 50] = f32::NAN;
    let found = CpuRasterizer.weights(&scene, &view, &regions, WeightKind::Blend).unwrap();
    assert_eq!(found.counters.unusable, 7);
    assert_eq!(found.entries, expected.entries);
    let drawing = CpuRasterizer.draw(&scene, &view, [0.0; 3]).unwrap();
    assert!(drawing.rgb.iter().all(|c| c.is_finite()));
}

#[test]
fn contradictions_are_errors() {
    let random = &mut Random(9);
    let view = random_view(random, 20, 10);
    let scene = random_scene(random, 5, &view, 1);
    let regions = random_regions(random, &view, 3);
    let error = |scene: &Gaussians, view: &RasterView, regions: &RegionMap| {
        CpuRasterizer.weights(scene, view, regions, WeightKind::Blend).unwrap_err()
    };
    let short = Gaussians { sh_rest: vec![0.0; 44], ..scene.clone() };
    assert_eq!(
        error(&short, &view, &regions),
        RasterError::ColumnLength { column: "sh_rest", expected: 45, found: 44 }
    );
    let of_degree_4 = Gaussians { sh_degree: 4, ..scene.clone() };
    assert_eq!(error(&of_degree_4, &view, &regions), RasterError::ShDegree { found: 4 });

    let with = |change: fn(&mut RasterView)| {
        let mut view = view;
        change(&mut view);
        error(&scene, &view, &regions)
    };
    assert!(matches!(with(|v| v.intrinsics.width_px = 0), RasterError::ImageSize { .. }));
    assert!(matches!(with(|v| v.intrinsics.height_px = u32::MAX), RasterError::ImageSize { .. }));
    assert!(matches!(with(|v| v.intrinsics.focal_x_px = 0.0), RasterError::Camera { .. }));
    assert!(matches!(with(|v| v.intrinsics.centre_y_px = f64::NAN), RasterError::Camera { .. }));
    assert!(matches!(with(|v| v.camera_from_world.matrix3 *= 2.0), RasterError::Pose { off } if off > 2.9));
    assert!(
        matches!(with(|v| v.camera_from_world.matrix3 *= -1.0), RasterError::Pose { off } if off.is_infinite())
    );
    assert!(
        matches!(with(|v| v.camera_from_world.translation.x = f64::NAN), RasterError::Pose { off } if off.is_nan())
    );
    assert!(matches!(with(|v| v.intrinsics.width_px = 21), RasterError::RegionMapSize { .. }));
    let fisheye = with(|v| v.intrinsics.distortion = Distortion::Fisheye { k: [0.0; 4] });
    assert_eq!(fisheye, RasterError::Distorted);

    let mut wrong = regions.clone();
    wrong.region_of_pixel[33] = 3;
    assert_eq!(error(&scene, &view, &wrong), RasterError::Region { pixel: 33, found: 3, n_regions: 3 });
    wrong.region_of_pixel.pop();
    assert!(matches!(error(&scene, &view, &wrong), RasterError::RegionMapSize { found_values: 199, .. }));
}
