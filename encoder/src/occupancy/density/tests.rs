use slag_math::random::Random;

use super::*;

fn random_scene(random: &mut Random, n: usize) -> Gaussians {
    let mut scene = Gaussians::default();
    for _ in 0..n {
        scene.means_in_world.push(DVec3::from([0; 3].map(|_| random.between(-2.0, 2.0))));
        let q = DQuat::from_xyzw(random.normal(), random.normal(), random.normal(), random.normal());
        let q = q.normalize();
        scene.rotations_wxyz.push([q.w, q.x, q.y, q.z].map(|v| v as f32));
        scene.scales.push([0; 3].map(|_| (10f64.powf(random.between(-3.0, -0.7))) as f32));
        scene.opacities.push(random.between(0.05, 1.0) as f32);
        scene.sh_dc.push([0.0; 3]);
    }
    scene
}

/// Oracle: the definition in f64 for every voxel and Gaussian; sums are f32, so voxels within a thousandth of the
/// threshold may differ.
#[test]
fn voxels_are_occupied_as_defined() {
    let mut random = Random::new(17);
    let lattice = Lattice { voxel: 0.1 };
    let scene = random_scene(&mut random, 60);
    let usable: Vec<u32> = (0..60).collect();
    let found: BTreeMap<BlockAt, u64> = occupied(&scene, &usable, lattice).blocks.into_iter().collect();
    let (mut n_occupied, mut n_undecided) = (0, 0);
    for voxel in (-30..30).flat_map(|x| (-30..30).flat_map(move |y| (-30..30).map(move |z| [x, y, z]))) {
        let centre = (DVec3::from(voxel.map(f64::from)) + 0.5) * lattice.voxel;
        let sum: f64 = (0..scene.len())
            .map(|k| {
                let [w, x, y, z] = scene.rotations_wxyz[k].map(f64::from);
                let own =
                    DQuat::from_xyzw(x, y, z, w).normalize().inverse() * (centre - scene.means_in_world[k]);
                // In the Gaussian's own axes the widened covariance stays diagonal.
                let d2: f64 = (0..3)
                    .map(|axis| {
                        let scale = f64::from(scene.scales[k][axis]);
                        own[axis].powi(2) / (scale * scale + VOXEL_VARIANCE * lattice.voxel.powi(2))
                    })
                    .sum();
                if d2 <= 9.0 { f64::from(scene.opacities[k]) * (-0.5 * d2).exp() } else { 0.0 }
            })
            .sum();
        let opacity = 1.0 - (-sum).exp();
        let block = voxel.map(|v: i32| v.div_euclid(4));
        let [x, y, z] = voxel.map(|v: i32| v.rem_euclid(4));
        let is_occupied = found.get(&block).is_some_and(|mask| mask >> (16 * x + 4 * y + z) & 1 == 1);
        n_occupied += usize::from(is_occupied);
        if (opacity - 0.1).abs() < 1e-3 {
            n_undecided += 1;
            continue;
        }
        assert_eq!(is_occupied, opacity >= 0.1, "{voxel:?}: {opacity}");
    }
    assert!(n_occupied > 200 && n_undecided < n_occupied / 20, "{n_occupied} {n_undecided}");
}

/// By hand: a wide thin Gaussian is a surface; a ball of fog and a Gaussian wider than 8 tiles of 64 voxels are not.
#[test]
fn background_is_left_out() {
    let mut scene = Gaussians::balls((0..3).map(|k| DVec3::X * 100.0 * f64::from(k)).collect(), 0.0);
    scene.scales = vec![[1.0, 1.0, 0.02], [0.3, 0.25, 0.3], [4.4, 4.4, 0.02]];
    scene.opacities.fill(0.9);
    let found = occupied(&scene, &[0, 1, 2], Lattice { voxel: 0.05 });
    assert_eq!(found.n_background, 2);
    assert!(!found.blocks.is_empty() && found.blocks.iter().all(|([x, ..], _)| x.abs() < 20));
}

/// Reaches beyond 32 bits of tiles or 64 bits of voxels, and means beyond the lattice, are background.
#[test]
fn the_largest_gaussians_are_background() {
    for scale in [1.5e9, 1e15, 1e25, f32::MAX] {
        let scene = Gaussians {
            scales: vec![[scale, scale, 0.01], [0.1, 0.1, 0.01], [0.1, 0.1, 0.01]],
            opacities: vec![0.9; 3],
            ..Gaussians::balls(vec![DVec3::ZERO, DVec3::splat(1e30), DVec3::ONE], 0.1)
        };
        let found = occupied(&scene, &[0, 1, 2], Lattice { voxel: 0.05 });
        assert_eq!(found.n_background, 2, "{scale}");
        assert!(!found.blocks.is_empty());
    }
}

/// Voxels of a power of two make the offset exact, up to the lattice's last block. Beyond it nothing is stored, and
/// everything is counted.
#[test]
fn places_at_the_ends_of_the_lattice_are_the_same() {
    let mut random = Random::new(8);
    let lattice = Lattice { voxel: 0.0625 };
    // On a grid of 2^-12, which doubles resolve even at the ends of the lattice.
    let mut mean = || DVec3::from([0; 3].map(|_| random.below(1 << 14) as f64 / 4096.0 - 2.0));
    let mut scene = Gaussians::balls((0..60).map(|_| mean()).collect(), 0.0);
    scene.scales.fill([0.2, 0.1, 0.01]);
    scene.opacities.fill(0.9);
    let usable: Vec<u32> = (0..scene.len() as u32).collect();
    let near = occupied(&scene, &usable, lattice);
    assert!(near.blocks.len() > 20 && near.n_background == 0);
    let moved = |shift: [i32; 3]| {
        let offset = DVec3::from(shift.map(f64::from)) * lattice.block();
        let mut scene = scene.clone();
        scene.means_in_world.iter_mut().for_each(|mean| *mean += offset);
        occupied(&scene, &usable, lattice)
    };
    const LAST: i32 = (1 << 26) - 100;
    for shift in [[1 << 20, -(1 << 20), 0], [LAST, -LAST, LAST]] {
        let place = |(at, voxels): &(BlockAt, u64)| ([0, 1, 2].map(|axis| at[axis] + shift[axis]), *voxels);
        let expected: Vec<_> = near.blocks.iter().map(place).collect();
        let found = moved(shift);
        assert_eq!((found.n_background, found.blocks), (0, expected), "{shift:?}");
    }
    let beyond = moved([1 << 27, 0, 0]);
    assert_eq!((beyond.n_background, beyond.blocks.len()), (scene.len(), 0));
}

/// A plane of opaque Gaussians, 2 mm thick, in any direction: every voxel that it cuts is occupied, and none with its
/// centre farther than one and a half edges.
#[test]
fn a_thin_surface_has_no_holes() {
    let mut random = Random::new(5);
    let lattice = Lattice { voxel: 0.05 };
    for spacing in [0.012, 0.05, 0.11] {
        let normal = DVec3::new(random.normal(), random.normal(), random.normal()).normalize();
        let (u, v) = (normal.any_orthonormal_vector(), normal.cross(normal.any_orthonormal_vector()));
        let middle = DVec3::from([0; 3].map(|_| random.between(-5.0, 5.0)));
        let rotation = DQuat::from_rotation_arc(DVec3::Z, normal);
        let n = (0.8 / spacing) as i32;
        let places = (-n..=n).flat_map(|i| (-n..=n).map(move |j| (f64::from(i), f64::from(j))));
        let means = places.map(|(i, j)| middle + u * (i * spacing) + v * (j * spacing)).collect();
        let mut scene = Gaussians::balls(means, 0.0);
        let rotation = [rotation.w, rotation.x, rotation.y, rotation.z].map(|q| q as f32);
        scene.rotations_wxyz.fill(rotation);
        scene.scales.fill([(0.62 * spacing) as f32, (0.62 * spacing) as f32, 0.002]);
        scene.opacities.fill(0.97);
        let usable: Vec<u32> = (0..scene.len() as u32).collect();
        let found: BTreeMap<BlockAt, u64> = occupied(&scene, &usable, lattice).blocks.into_iter().collect();
        let is_occupied = |voxel: [i32; 3]| {
            let [x, y, z] = voxel.map(|v| v.rem_euclid(4));
            let mask = found.get(&voxel.map(|v| v.div_euclid(4)));
            mask.is_some_and(|mask| mask >> (16 * x + 4 * y + z) & 1 == 1)
        };
        for _ in 0..20_000 {
            let at = middle + u * random.between(-0.5, 0.5) + v * random.between(-0.5, 0.5);
            let voxel = (at / lattice.voxel).floor().to_array().map(|v| v as i32);
            assert!(is_occupied(voxel), "{spacing}: {at}");
            let beside = at + normal * random.between(1.5, 3.0) * lattice.voxel;
            let voxel = (beside / lattice.voxel).floor().to_array().map(|v| v as i32);
            let centre = (DVec3::from(voxel.map(f64::from)) + 0.5) * lattice.voxel;
            let is_far = (centre - middle).dot(normal) > 1.5 * lattice.voxel;
            assert!(!is_far || !is_occupied(voxel), "{spacing}: {beside}");
        }
    }
}
