use std::f64::consts::TAU;

use super::*;

const BROWN: Distortion =
    Distortion::Brown { k: [-0.28340811, 0.07395907, 0.01], p: [0.00019359, 1.76187114e-05] };
const FISHEYE: Distortion = Distortion::Fisheye { k: [0.0034, 0.0007, -0.0018, 0.0004] };

/// Oracle: OpenCV 4 (`cv2.projectPoints` and `cv2.fisheye.projectPoints`, identity camera), recorded; the Brown
/// coefficients are those of the EuRoC data set.
#[test]
fn distortion_is_opencvs() {
    let recorded: &[(Distortion, [f64; 2], [f64; 2])] = &[
        (BROWN, [0.0, 0.0], [0.0, 0.0]),
        (BROWN, [0.3, -0.2], [0.289310878195434, -0.19284722514196803]),
        (BROWN, [-0.55, 0.4], [-0.48721972669222113, 0.35443708108135896]),
        (BROWN, [0.01, 0.7], [0.008811785885914027, 0.6163154453409821]),
        (FISHEYE, [0.0, 0.0], [0.0, 0.0]),
        (FISHEYE, [0.3, -0.2], [0.2880477031744145, -0.19203180211627635]),
        (FISHEYE, [-0.55, 0.4], [-0.48359139982530824, 0.3517028362365878]),
        (FISHEYE, [0.01, 0.7], [0.008735619095397057, 0.6114933366777938]),
        (FISHEYE, [1.7, -2.0], [0.7836748590380883, -0.921970422397751]),
    ];
    for (distortion, ideal, expected) in recorded {
        let found = distortion.distort(*ideal);
        assert!((found[0] - expected[0]).abs() < 1e-12, "{distortion:?} {ideal:?}: {found:?}");
        assert!((found[1] - expected[1]).abs() < 1e-12, "{distortion:?} {ideal:?}: {found:?}");
    }
}

/// Oracle: a dense scan (to radius 5) for the first radius at which the imaged radius stops growing.
#[test]
fn the_monotonic_radius_is_where_the_image_folds() {
    let cases = [
        Distortion::Brown { k: [-0.3, 0.0, 0.0], p: [0.0; 2] },
        Distortion::Brown { k: [-0.3, 0.09, -0.02], p: [0.0; 2] },
        Distortion::Brown { k: [0.1, -0.2, 0.0], p: [0.0; 2] },
        Distortion::Fisheye { k: [0.1, -0.3, 0.0, 0.0] },
        FISHEYE,
    ];
    for distortion in cases {
        let step = 1e-4;
        let scanned = (0..50_000)
            .map(|i| f64::from(i) * step)
            .find(|r| distortion.distort([r + step, 0.0])[0] < distortion.distort([*r, 0.0])[0]);
        let found = distortion.monotonic_radius();
        match scanned {
            Some(r) => assert!((found - r).abs() < 2.0 * step, "{distortion:?}: {found}, scanned {r}"),
            None => assert!(found > 4.9, "{distortion:?}: {found}"),
        }
    }
}

/// Tangential terms fold the image along one axis first, farther out along the other too. Oracle: a dense scan
/// along each direction for the first place where a numeric derivative stops being positive.
#[test]
fn nothing_beyond_a_fold_has_a_place() {
    for p in [[0.1, 0.0], [0.0, -0.2], [0.05, 0.08]] {
        let lens = Distortion::Brown { k: [-0.01, 0.0, 0.0], p };
        let mut n_twice_folded = 0;
        for direction in 0..64 {
            let (sin, cos) = (f64::from(direction) * TAU / 64.0).sin_cos();
            let mut is_beyond = false;
            for step in 1..400 {
                let r = f64::from(step) * 0.02;
                let at = [r * cos, r * sin];
                let across = |axis: usize| {
                    let moved = |by: f64| {
                        lens.distort(std::array::from_fn(|a| at[a] + if a == axis { by } else { 0.0 }))
                    };
                    let (low, high) = (moved(-1e-6), moved(1e-6));
                    [0, 1].map(|a| (high[a] - low[a]) / 2e-6)
                };
                let (x, y) = (across(0), across(1));
                let determinant = x[0] * y[1] - x[1] * y[0];
                is_beyond |= determinant < -1e-6;
                n_twice_folded += usize::from(is_beyond && determinant > 1e-3);
                if is_beyond && r < lens.monotonic_radius() {
                    assert!(lens.folds_at(at), "{p:?}: {at:?}");
                }
            }
        }
        assert!(n_twice_folded > 0, "{p:?}: the scan must reach a second fold");
    }
}

#[test]
fn an_equidistant_fisheye_is_not_a_pinhole() {
    let [x, _] = Distortion::Fisheye { k: [0.0; 4] }.distort([1.0, 0.0]);
    assert!((x - std::f64::consts::FRAC_PI_4).abs() < 1e-15);
}
