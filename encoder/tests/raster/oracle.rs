//! Brute force in float64: every pixel over all Gaussians sorted by depth, no tiles.
//!
//! Written from the conventions of the recorded data; shares no arithmetic with the rasteriser. Where rounding
//! decides the side of a cut (alpha = 1/255, transmittance = 1e-4), both are right: the truth is an interval, and
//! no wider.

use super::*;

use glam::DVec2;

pub struct Projected {
    pub index: usize,
    /// Camera z.
    pub depth: f64,
    mean_px: DVec2,
    /// Principal axes of the ellipse, each divided by its standard deviation.
    axes: [DVec2; 2],
    opacity: f64,
}

/// Visible Gaussians, near to far.
fn project(scene: &Gaussians, view: &RasterView) -> Vec<Projected> {
    let camera = &view.intrinsics;
    let (fx, fy) = (camera.focal_x_px, camera.focal_y_px);
    let (cx, cy) = (camera.centre_x_px, camera.centre_y_px);
    let (w, h) = (f64::from(camera.width_px), f64::from(camera.height_px));
    let mut all = Vec::new();
    for index in 0..scene.len() {
        let p = view.camera_from_world.transform_point3(scene.means_in_world[index]);
        let opacity = f64::from(scene.opacities[index]);
        if !scene.is_usable(index) || p.z < 0.01 || p.z > 1e10 || opacity < 1.0 / 255.0 {
            continue;
        }
        let [qw, qx, qy, qz] = scene.rotations_wxyz[index].map(f64::from);
        let factor = view.camera_from_world.matrix3
            * DMat3::from_quat(DQuat::from_xyzw(qx, qy, qz, qw).normalize())
            * DMat3::from_diagonal(DVec3::from_array(scene.scales[index].map(f64::from)));
        let (margin_x, margin_y) = (0.3 * 0.5 * w / fx, 0.3 * 0.5 * h / fy);
        let tx = p.z * (p.x / p.z).clamp(-cx / fx - margin_x, (w - cx) / fx + margin_x);
        let ty = p.z * (p.y / p.z).clamp(-cy / fy - margin_y, (h - cy) / fy + margin_y);
        let row_x = factor.transpose() * DVec3::new(fx / p.z, 0.0, -fx * tx / (p.z * p.z));
        let row_y = factor.transpose() * DVec3::new(0.0, fy / p.z, -fy * ty / (p.z * p.z));
        all.push(Projected {
            index,
            depth: p.z,
            mean_px: DVec2::new(fx * p.x / p.z + cx, fy * p.y / p.z + cy),
            axes: whitening_axes(row_x, row_y),
            opacity,
        });
    }
    all.sort_by(|a, b| (a.depth as f32).total_cmp(&(b.depth as f32)).then(a.index.cmp(&b.index)));
    all
}

/// Returns the principal axes of `F F' + 0.3 I` over their standard deviations, for the rows of F.
///
/// One-sided Jacobi (Hestenes 1958) makes the rows orthogonal, which gives a needle's short axis to the condition
/// of F; the textbook inverse of the covariance has its square.
fn whitening_axes(row_x: DVec3, row_y: DVec3) -> [DVec2; 2] {
    let angle = 0.5 * (2.0 * row_x.dot(row_y)).atan2(row_x.length_squared() - row_y.length_squared());
    let (sin, cos) = angle.sin_cos();
    [DVec2::new(cos, sin), DVec2::new(-sin, cos)].map(|axis| {
        let along = row_x * axis.x + row_y * axis.y;
        axis / (along.length_squared() + 0.3).sqrt()
    })
}

/// A value, and its bounds if rounding decides on a cut.
#[derive(Clone, Copy, Debug, Default)]
pub struct Truth {
    pub value: f64,
    /// Least right value.
    pub low: f64,
    /// Largest right value.
    pub high: f64,
    /// Change of the value per relative error of every alpha: its own, and, in the light past surfaces of opacity
    /// near 1, the share `alpha / (1 - alpha)` of theirs.
    pub sensitivity: f64,
}

impl Truth {
    /// Distance of a value from the right interval.
    pub fn distance(&self, found: f64) -> f64 {
        (self.low - found).max(found - self.high).max(0.0)
    }
}

impl std::ops::AddAssign for Truth {
    fn add_assign(&mut self, other: Self) {
        self.value += other.value;
        self.low += other.low;
        self.high += other.high;
        self.sensitivity += other.sensitivity;
    }
}

/// Calls `f(Gaussian, pixel, weight)` for each Gaussian that counts at a pixel. `cut_tolerance`: relative error of
/// alpha within which a pixel may fall on either side of a cut.
pub fn each_weight(
    scene: &Gaussians,
    view: &RasterView,
    cut_tolerance: f64,
    mut f: impl FnMut(&Projected, usize, Truth),
) {
    let projected = project(scene, view);
    let width = view.intrinsics.width_px as usize;
    for pixel in 0..width * view.intrinsics.height_px as usize {
        let centre = DVec2::new((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
        let mut light = Truth { value: 1.0, low: 1.0, high: 1.0, sensitivity: 0.0 };
        for gaussian in &projected {
            let d = centre - gaussian.mean_px;
            let falloff = (-0.5 * gaussian.axes.iter().map(|a| a.dot(d).powi(2)).sum::<f64>()).exp();
            let alpha = (gaussian.opacity * falloff).min(0.999);
            let [counts_low, counts, counts_high] =
                [1.0 - cut_tolerance, 1.0, 1.0 + cut_tolerance].map(|factor| alpha * factor >= 1.0 / 255.0);
            if !counts_high {
                continue;
            }
            let gate = |counts: bool, value: f64| if counts { value } else { 0.0 };
            let own_sensitivity = light.sensitivity + 1.0;
            light.sensitivity += alpha / (1.0 - alpha);
            let slack = cut_tolerance * light.sensitivity;
            let goes_on = |light: f64, factor: f64| light * (1.0 - alpha) * factor > 1e-4;
            let low_goes_on = goes_on(light.low, 1.0 - slack);
            let value_goes_on = goes_on(light.value, 1.0);
            let high_goes_on = goes_on(light.high, 1.0 + slack);
            if counts_low && !high_goes_on {
                break;
            }
            let high = gate(high_goes_on, alpha * light.high);
            let weight = Truth {
                value: gate(counts && value_goes_on, alpha * light.value),
                low: gate(counts_low && low_goes_on, alpha * light.low),
                high,
                sensitivity: high * own_sensitivity,
            };
            f(gaussian, pixel, weight);
            // A pixel that may be opaque has no light left in the worst case.
            light.low = gate(low_goes_on, light.low * (1.0 - alpha));
            if counts {
                light.value = gate(value_goes_on, light.value * (1.0 - alpha));
            }
            if counts_low {
                light.high *= 1.0 - alpha;
            }
        }
    }
}

/// Contributions by (Gaussian, region).
pub type Sums = BTreeMap<(u32, u32), Truth>;

pub fn weights(scene: &Gaussians, view: &RasterView, regions: &RegionMap, cut_tolerance: f64) -> Sums {
    let mut sums = Sums::new();
    each_weight(scene, view, cut_tolerance, |gaussian, pixel, weight| {
        let region = regions.region_of_pixel[pixel];
        if region != NO_REGION {
            *sums.entry((gaussian.index as u32, region)).or_default() += weight;
        }
    });
    sums
}

/// Colour by the factored formula of real spherical harmonics (Sloan 2008, A2), not by the renderers' polynomials.
pub fn colour(scene: &Gaussians, index: usize, view: &RasterView) -> DVec3 {
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

/// Real spherical harmonic with the Condon-Shortley phase, as in 3DGS.
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

/// P_l^m with the factor (-1)^m, by recurrence (Press et al., Numerical Recipes, 6.7).
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
