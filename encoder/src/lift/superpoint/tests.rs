use slag_common::Gaussians;

use super::*;

/// Two flat squares of 20 x 20 Gaussians side by side, the right one red, and over the left a wall.
fn scene() -> Gaussians {
    let mut scene = Gaussians::default();
    let mut push = |position: [f64; 3], rotation: [f32; 4], dc: f32| {
        scene.means_in_world.push(position.into());
        scene.rotations_wxyz.push(rotation);
        scene.scales.push([0.01, 0.01, 0.001]);
        scene.opacities.push(0.9);
        scene.sh_dc.push([dc, 0.0, 0.0]);
    };
    let half = std::f32::consts::FRAC_1_SQRT_2;
    for i in 0..400 {
        let (x, y) = (f64::from(i % 20) * 0.02, f64::from(i / 20) * 0.02);
        push([x, y, 0.0], [1.0, 0.0, 0.0, 0.0], 0.0);
        push([x + 0.4, y, 0.0], [1.0, 0.0, 0.0, 0.0], 3.0);
        // A quarter turn about x: its normal is y.
        push([x, 0.0, y + 0.02], [half, half, 0.0, 0.0], 0.0);
    }
    scene
}

#[test]
fn pieces_end_where_colour_or_direction_changes() {
    let settings = SuperpointSettings { scale: 1.0, ..SuperpointSettings::default() };
    let found = Superpoints::new(&scene(), &Standing::default(), &settings);
    assert_eq!(found.n, 3);
    for kind in 0..3 {
        assert!((0..400).all(|i| found.of_gaussian[i * 3 + kind] == found.of_gaussian[kind]), "{kind}");
    }
}

#[test]
fn sketches_separate_what_looks_alike_and_unknown_ones_do_not() {
    let mut scene = scene();
    scene.sh_dc.fill([0.0; 3]);
    let settings = SuperpointSettings { normal: 0.0, scale: 1.0, ..SuperpointSettings::default() };
    let n_with = |sketches: &[i8]| {
        Graph::new(&scene, &Standing::default(), Some(Sketches { width: 2, values: sketches }), &settings)
            .superpoints(&settings)
            .n
    };
    let of = |left: [i8; 2], right: [i8; 2]| -> Vec<i8> {
        (0..1200).flat_map(|i| if i % 3 == 1 { right } else { left }).collect()
    };
    assert_eq!(n_with(&of([127, 0], [0, 127])), 2);
    assert_eq!(n_with(&of([127, 0], [127, 0])), 1);
    assert_eq!(n_with(&of([127, 0], [0, 0])), 1);
}

#[test]
fn small_pieces_are_joined_and_unusable_gaussians_have_none() {
    let mut scene = scene();
    scene.sh_dc[10] = [3.0; 3];
    scene.means_in_world[700].x = f64::NAN;
    let found = Superpoints::new(&scene, &Standing::default(), &SuperpointSettings::default());
    assert_eq!(found.of_gaussian[700], NO_SUPERPOINT);
    assert!(found.sizes().iter().all(|size| *size >= 20), "{:?}", found.sizes());
}

/// Twelve Gaussians in the ground's colour and direction stay separate, though superpoints have twenty.
#[test]
fn what_stands_on_the_ground_is_no_part_of_it() {
    let ground = (0..10_000).map(|i| [f64::from(i % 100) * 0.02, f64::from(i / 100) * 0.02, 0.0]);
    let cone = (0..12).map(|i| [1.0 + f64::from(i % 4) * 0.02, 1.0 + f64::from(i / 4) * 0.02, 0.06]);
    let mut scene = Gaussians::balls(ground.chain(cone).map(Into::into).collect(), 0.01);
    scene.scales.fill([0.01, 0.01, 0.001]);
    scene.opacities.fill(0.9);
    let standing = Standing::find(&scene, &[]);
    let found = Superpoints::new(&scene, &standing, &SuperpointSettings::default());
    let cone = found.of_gaussian[10_000];
    assert!(found.of_gaussian[10_000..].iter().all(|superpoint| *superpoint == cone));
    assert_eq!(found.sizes()[cone as usize], 12);
}
