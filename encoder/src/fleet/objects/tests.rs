use glam::DVec3;

use super::*;

#[test]
fn a_view_comes_back_and_a_cut_one_is_refused() {
    let record = ViewRecord { raster_width_px: 640, secs: 0.25 };
    let bytes = pack_view(record, b"outlines", b"contributions").expect("packs");
    let (found, outlines, contributions) = unpack_view(&bytes).expect("whole");
    assert_eq!((found, &outlines[..], &contributions[..]), (record, &b"outlines"[..], &b"contributions"[..]));
    for cut in 0..bytes.len() {
        assert!(unpack_view(&bytes[..cut]).is_err(), "{cut}");
    }
}

#[test]
fn a_scene_comes_back_bit_by_bit() {
    let scene = Gaussians {
        means_in_world: vec![DVec3::new(0.1, f64::NAN, -1e300), DVec3::splat(1.0 / 3.0)],
        rotations_wxyz: vec![[1.0, 0.0, 0.0, -0.0], [0.5; 4]],
        scales: vec![[0.1; 3], [f32::INFINITY; 3]],
        opacities: vec![0.25, 1.0],
        sh_dc: vec![[0.5; 3], [-0.5; 3]],
        sh_rest: Vec::new(),
        sh_degree: 0,
    };
    let bytes = pack_scene(&scene).expect("packs");
    // NaN differs from itself, so bytes are compared.
    assert_eq!(pack_scene(&unpack_scene(&bytes).expect("reads")).expect("packs"), bytes);
    unpack_scene(&bytes[..bytes.len() - 1]).expect_err("cut");
}
