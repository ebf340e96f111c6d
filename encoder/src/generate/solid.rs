//! Solids covered with flat Gaussians.

use glam::{DMat3, DQuat, DVec3};
use slag_common::Gaussians;
use slag_common::gaussians::SH_C0;

/// Distance of the ceiling light's shading from ambient: enough to see shape, not to change a colour's name.
const AMBIENT: f64 = 0.72;
/// Opacity of a surface Gaussian.
const OPACITY: f32 = 0.97;
/// Standard deviation of a surface Gaussian in spacings: neighbours overlap to a closed surface.
const SPREAD: f64 = 0.62;
/// Thickness of a surface Gaussian.
const THICKNESS_M: f32 = 0.002;

/// A pseudo-random sequence (xorshift64*, Vigna 2016); equal on every machine.
pub struct Random(u64);

impl Random {
    /// Starts the sequence of a seed.
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }

    /// Returns the next value, uniform in -1..1.
    pub fn signed(&mut self) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        let bits = self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 11;
        bits as f64 / (1u64 << 52) as f64 - 1.0
    }
}

/// The shape of a part.
#[derive(Clone, Copy, Debug)]
pub enum Shape {
    /// A box with these half edges.
    Box(DVec3),
    /// An upright cylinder.
    Cylinder {
        /// Radius.
        radius_m: f64,
        /// Half the height.
        half_height_m: f64,
    },
    /// An ellipsoid with these half axes.
    Ellipsoid(DVec3),
}

/// A part of an object: a shape at a place, in one colour.
#[derive(Clone, Copy, Debug)]
pub struct Part {
    /// Its shape.
    pub shape: Shape,
    /// Its centre, in the object's frame.
    pub centre: DVec3,
    /// Its colour.
    pub rgb: [f64; 3],
}

/// A point on a surface.
struct Surfel {
    position: DVec3,
    normal: DVec3,
}

impl Shape {
    /// Returns points on the surface, about `spacing_m` apart.
    fn surfels(self, spacing_m: f64) -> Vec<Surfel> {
        let mut out = Vec::new();
        match self {
            Self::Box(half) => {
                for (axis, side) in (0..3).flat_map(|axis| [(axis, 1.0), (axis, -1.0)]) {
                    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
                    for (a, b) in
                        grid(half[u], spacing_m).flat_map(|a| grid(half[v], spacing_m).map(move |b| (a, b)))
                    {
                        let mut position = DVec3::ZERO;
                        (position[axis], position[u], position[v]) = (half[axis] * side, a, b);
                        let mut normal = DVec3::ZERO;
                        normal[axis] = side;
                        out.push(Surfel { position, normal });
                    }
                }
            }
            Self::Cylinder { radius_m, half_height_m } => {
                for z in grid(half_height_m, spacing_m) {
                    out.extend(
                        ring(radius_m, spacing_m)
                            .map(|normal| Surfel { position: normal * radius_m + DVec3::Z * z, normal }),
                    );
                }
                for (r, side) in grid(radius_m / 2.0, spacing_m)
                    .flat_map(|r| [(r + radius_m / 2.0, 1.0), (r + radius_m / 2.0, -1.0)])
                {
                    let normal = DVec3::Z * side;
                    out.extend(
                        ring(r, spacing_m)
                            .map(|u| Surfel { position: u * r + normal * half_height_m, normal }),
                    );
                }
            }
            Self::Ellipsoid(half) => {
                // Rings of a sphere of the mean radius from pole to pole, stretched.
                let mean_m = half.element_sum() / 3.0;
                for offset in grid(std::f64::consts::FRAC_PI_2, spacing_m / mean_m) {
                    let polar = offset + std::f64::consts::FRAC_PI_2;
                    out.extend(ring(polar.sin() * mean_m, spacing_m).map(|u| {
                        let unit = u * polar.sin() + DVec3::Z * polar.cos();
                        Surfel { position: unit * half, normal: (unit / half).normalize() }
                    }));
                }
            }
        }
        out
    }
}

/// Returns the middles of equal steps of at most `spacing` over `-half..half`.
fn grid(half: f64, spacing: f64) -> impl Iterator<Item = f64> + Clone {
    let n = (2.0 * half / spacing).ceil().max(1.0) as u32;
    (0..n).map(move |i| half * ((2 * i + 1) as f64 / f64::from(n) - 1.0))
}

/// Returns unit directions around z, at most `spacing` apart at radius `radius`.
fn ring(radius: f64, spacing: f64) -> impl Iterator<Item = DVec3> {
    let n = (std::f64::consts::TAU * radius / spacing).ceil().max(3.0) as u32;
    (0..n).map(move |i| {
        let (sin, cos) = (std::f64::consts::TAU * f64::from(i) / f64::from(n)).sin_cos();
        DVec3::new(cos, sin, 0.0)
    })
}

/// Covers a part with Gaussians. The object stands at `position`, turned by `yaw_rad` around z.
pub fn cover(
    out: &mut Gaussians,
    part: &Part,
    position: DVec3,
    yaw_rad: f64,
    spacing_m: f64,
    random: &mut Random,
) {
    let world_from_object = DMat3::from_rotation_z(yaw_rad);
    // The light hangs above; faces that look up are brightest, and no two walls are alike.
    let light = DVec3::new(0.25, 0.45, 0.86).normalize();
    for surfel in part.shape.surfels(spacing_m) {
        let normal = world_from_object * surfel.normal;
        let shade = AMBIENT + (1.0 - AMBIENT) * normal.dot(light) + 0.03 * random.signed();
        let rotation = DQuat::from_rotation_arc(DVec3::Z, normal);
        let spread = (spacing_m * SPREAD) as f32;
        out.means_in_world.push(position + world_from_object * (part.centre + surfel.position));
        out.rotations_wxyz.push([rotation.w, rotation.x, rotation.y, rotation.z].map(|q| q as f32));
        out.scales.push([spread, spread, THICKNESS_M]);
        out.opacities.push(OPACITY);
        out.sh_dc.push(part.rgb.map(|c| ((c * shade).clamp(0.0, 1.0) as f32 - 0.5) / SH_C0));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the implicit equation of each surface, and the area that the points stand for.
    #[test]
    fn points_lie_on_the_surface_evenly() {
        let half = DVec3::new(0.4, 0.3, 0.5);
        let spacing_m = 0.02;
        let area_of = |shape: Shape| shape.surfels(spacing_m).len() as f64 * spacing_m * spacing_m;
        for s in Shape::Ellipsoid(half).surfels(spacing_m) {
            assert!(
                ((s.position / half).length() - 1.0).abs() < 1e-9 && (s.normal.length() - 1.0).abs() < 1e-9
            );
        }
        for s in Shape::Box(half).surfels(spacing_m) {
            assert!(((s.position / half).abs().max_element() - 1.0).abs() < 1e-9);
        }
        for shape in [Shape::Box(half), Shape::Ellipsoid(half)] {
            let surfels = shape.surfels(spacing_m);
            let middle = surfels.iter().map(|s| s.position).sum::<DVec3>() / surfels.len() as f64;
            assert!(middle.length() < 1e-9, "{shape:?} is lopsided: {middle}");
        }
        let boxes = 8.0 * (half.x * half.y + half.y * half.z + half.z * half.x);
        assert!((area_of(Shape::Box(half)) / boxes - 1.0).abs() < 0.1);
        let cylinder = Shape::Cylinder { radius_m: 0.3, half_height_m: 0.4 };
        let expected = std::f64::consts::TAU * 0.3 * (0.8 + 0.3);
        assert!((area_of(cylinder) / expected - 1.0).abs() < 0.1);
    }
}
