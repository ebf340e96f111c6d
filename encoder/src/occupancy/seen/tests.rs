use std::collections::{BTreeMap, BTreeSet};

use glam::{DAffine3, DQuat};
use slag_common::pinhole;
use slag_math::random::Random;

use super::*;

const LATTICE: Lattice = Lattice { voxel: 0.1 };

/// A view near the origin. A third of the pixels show patches of surface 0.3 to 3 m away, the others the sky or
/// something half transparent.
fn random_picture(random: &mut Random) -> (RasterView, Drawing) {
    let rotation = DQuat::from_xyzw(random.normal(), random.normal(), random.normal(), random.normal());
    let place = DVec3::from([0; 3].map(|_| random.between(-1.0, 1.0)));
    let camera_from_world = DAffine3::from_rotation_translation(rotation.normalize(), place);
    let (width_px, height_px) = (40, 30);
    let intrinsics = Intrinsics {
        focal_y_px: 34.0,
        centre_x_px: 18.5,
        centre_y_px: 16.0,
        ..pinhole([width_px, height_px], 30.0)
    };
    // Patches of 8 x 8 pixels, so that neighbours mostly agree.
    let patches: Vec<(f32, f32)> = (0..20)
        .map(|_| (*random_of(random, &[1.0, 0.6, 0.5, 0.4, 0.05, 0.0]), random.between(0.3, 3.0) as f32))
        .collect();
    let of_pixel = |pixel: u32| patches[(pixel / width_px / 8 * 5 + pixel % width_px / 8) as usize];
    let pixels = || (0..width_px * height_px).map(of_pixel);
    let drawing = Drawing {
        width_px,
        height_px,
        coverage: pixels().map(|(coverage, _)| coverage).collect(),
        depth: pixels().map(|(_, depth)| depth).collect(),
        ..Drawing::default()
    };
    (RasterView { camera_from_world, intrinsics }, drawing)
}

fn random_of<'a, T>(random: &mut Random, of: &'a [T]) -> &'a T {
    &of[random.below(of.len() as u64) as usize]
}

/// The definition of `docs/numerics.md`, in f64, pixel by pixel.
fn looks_through(view: &RasterView, drawing: &Drawing, voxel: [i32; 3]) -> bool {
    let centre = (DVec3::from(voxel.map(f64::from)) + 0.5) * LATTICE.voxel;
    let at = view.camera_from_world.matrix3 * centre + view.camera_from_world.translation;
    if at.z < 0.01 {
        return false;
    }
    let of = &view.intrinsics;
    let x = (of.focal_x_px * at.x / at.z + of.centre_x_px).floor();
    let y = (of.focal_y_px * at.y / at.z + of.centre_y_px).floor();
    let is_inside = x >= 0.0 && y >= 0.0 && x < 40.0 && y < 30.0;
    is_inside && {
        let pixel = y as usize * 40 + x as usize;
        match drawing.coverage[pixel] {
            0.5.. => at.z <= f64::from(drawing.depth[pixel]),
            coverage => coverage <= 0.1,
        }
    }
}

/// Oracle: the definition, for every voxel and every view.
#[test]
fn two_views_that_look_through_make_a_voxel_seen() {
    let mut random = Random::new(8);
    let places = (-7..7).flat_map(|x| (-7..7).flat_map(move |y| (-7..7).map(move |z| [x, y, z])));
    let mut found: Vec<Candidate> = places
        .map(|at| Candidate { at, occupied: random.bits() & random.bits(), once: 0, seen: 0 })
        .collect();
    let mut n_views: BTreeMap<[i32; 3], u32> = BTreeMap::new();
    let (mut n_seen, mut n_once) = (0, 0);
    for round in 0..5 {
        let (view, drawing) = random_picture(&mut random);
        Depth::new(view, &drawing).look(LATTICE, &mut found);
        for candidate in &found {
            for bit in (0..64i32).filter(|bit| candidate.occupied >> bit & 1 == 0) {
                let offset = [bit / 16, bit / 4 % 4, bit % 4];
                let voxel = [0, 1, 2].map(|axis| 4 * candidate.at[axis] + offset[axis]);
                let n = n_views.entry(voxel).or_default();
                *n += u32::from(looks_through(&view, &drawing, voxel));
                let is_seen = candidate.seen >> bit & 1 == 1;
                assert_eq!(is_seen, *n >= MIN_VIEWS, "{voxel:?} in round {round}: {n} views");
                n_seen += u32::from(is_seen);
                n_once += u32::from(*n == 1);
            }
        }
    }
    assert!(n_seen > 1000 && n_once > 1000, "{n_seen} {n_once}");
}

/// Oracle: sets. 2.4 m are six blocks of 0.4 m.
#[test]
fn places_above_surfaces_are_looked_at() {
    let mut random = Random::new(21);
    let mut occupied: BTreeMap<BlockAt, u64> = BTreeMap::new();
    for _ in 0..60 {
        occupied.insert([0; 3].map(|_| random.below(20u64) as i32), 1 + random.below(99u64));
    }
    let expected: BTreeSet<BlockAt> =
        occupied.keys().flat_map(|at| (0..=6).map(|up| [at[0], at[1], at[2] + up])).collect();
    let blocks: Vec<(BlockAt, u64)> = occupied.clone().into_iter().collect();
    let found: Vec<Candidate> = candidates(&blocks, LATTICE).collect();
    assert!(found.is_sorted_by(|a, b| a.at < b.at), "each once, by place");
    assert_eq!(found.iter().map(|of| of.at).collect::<BTreeSet<_>>(), expected);
    for of in &found {
        assert_eq!(of.occupied, occupied.get(&of.at).copied().unwrap_or(0), "{:?}", of.at);
    }
}
