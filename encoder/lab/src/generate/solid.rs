//! Solids: intersections with rays, and points that cover their surfaces.

use glam::{DAffine3, DVec3};

use super::paint::Paint;

/// The shape of a part, around its own origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// Half edges.
    Box(DVec3),
    /// A cylinder or truncated cone around z.
    Cone {
        /// At the lower and the upper end.
        radii_m: [f64; 2],
        half_height_m: f64,
    },
    /// Half axes.
    Ellipsoid(DVec3),
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Part {
    pub shape: Shape,
    /// Pose in the object's or the world's frame: a rotation and a translation.
    pub object_from_part: DAffine3,
    pub paint: Paint,
}

#[derive(Clone, Copy, Debug)]
pub struct Surfel {
    pub position: DVec3,
    pub normal: DVec3,
}

impl Part {
    /// Points on the surface, about `spacing_m` apart, in the object's frame.
    pub fn surfels(&self, spacing_m: f64) -> impl Iterator<Item = Surfel> {
        self.shape.surfels(spacing_m).into_iter().map(|s| Surfel {
            position: self.object_from_part.transform_point3(s.position),
            normal: self.object_from_part.transform_vector3(s.normal),
        })
    }
}

impl Shape {
    /// Radius of a sphere around the origin that encloses it.
    pub fn radius_m(self) -> f64 {
        match self {
            Self::Box(half) => half.length(),
            Self::Cone { radii_m: [a, b], half_height_m } => a.max(b).hypot(half_height_m),
            Self::Ellipsoid(half) => half.max_element(),
        }
    }

    pub fn longest_axis(self) -> usize {
        let half = match self {
            Self::Box(half) | Self::Ellipsoid(half) => half,
            Self::Cone { radii_m: [a, b], half_height_m } => DVec3::new(a.max(b), a.max(b), half_height_m),
        };
        (0..3).max_by(|a, b| half[*a].total_cmp(&half[*b])).unwrap_or(2)
    }

    /// Distance at which a ray enters, in multiples of `direction`, and the normal there; `None` if it misses or starts
    /// inside.
    pub fn hit(self, origin: DVec3, direction: DVec3) -> Option<(f64, DVec3)> {
        match self {
            Self::Box(half) => {
                // Slabs (Kay and Kajiya 1986).
                let inverse = direction.recip();
                let (a, b) = ((-half - origin) * inverse, (half - origin) * inverse);
                let (near, far) = (a.min(b), a.max(b));
                let axis = (0..3).max_by(|i, j| near[*i].total_cmp(&near[*j]))?;
                let enter = near[axis];
                (enter > 0.0 && enter <= far.min_element()).then(|| {
                    let mut normal = DVec3::ZERO;
                    normal[axis] = -direction[axis].signum();
                    (enter, normal)
                })
            }
            Self::Ellipsoid(half) => {
                let (o, d) = (origin / half, direction / half);
                let [enter, _] = roots(d.length_squared(), o.dot(d), o.length_squared() - 1.0)?;
                (enter > 0.0).then(|| (enter, ((o + d * enter) / half).normalize()))
            }
            Self::Cone { radii_m: [below, above], half_height_m } => {
                // x^2 + y^2 = (middle + slope z)^2 along the ray.
                let (middle, slope) = ((below + above) / 2.0, (above - below) / (2.0 * half_height_m));
                let (o, d) = (origin, direction);
                let (radius, growth) = (middle + slope * o.z, slope * d.z);
                let [first, second] = roots(
                    d.x * d.x + d.y * d.y - growth * growth,
                    o.x * d.x + o.y * d.y - radius * growth,
                    o.x * o.x + o.y * o.y - radius * radius,
                )
                .unwrap_or([f64::NAN; 2]);
                // The shape is a piece of the double cone, so the ray may enter it at either crossing.
                let side = |t: f64| {
                    let p = o + d * t;
                    let normal = DVec3::new(p.x, p.y, -slope * (middle + slope * p.z)).normalize();
                    (t > 0.0 && p.z.abs() <= half_height_m && normal.dot(d) < 0.0).then_some((t, normal))
                };
                let side = side(first).or_else(|| side(second));
                let cap_z = -d.z.signum() * half_height_m;
                let cap = Some((cap_z - o.z) / d.z).filter(|t| {
                    let p = o + d * *t;
                    let radius = if cap_z > 0.0 { above } else { below };
                    *t > 0.0 && p.x * p.x + p.y * p.y <= radius * radius
                });
                let cap = cap.map(|t| (t, DVec3::Z * cap_z.signum()));
                match (side, cap) {
                    (Some(side), Some(cap)) => Some(if side.0 < cap.0 { side } else { cap }),
                    (side, cap) => side.or(cap),
                }
            }
        }
    }

    /// Surface included.
    #[cfg(any(test, feature = "measure"))]
    pub fn contains(self, p: DVec3) -> bool {
        match self {
            Self::Box(half) => p.abs().cmple(half).all(),
            Self::Ellipsoid(half) => (p / half).length_squared() <= 1.0,
            Self::Cone { radii_m: [below, above], half_height_m } => {
                let radius_m = below + (above - below) * (p.z / half_height_m + 1.0) / 2.0;
                p.z.abs() <= half_height_m && p.x.hypot(p.y) <= radius_m
            }
        }
    }

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
            Self::Cone { radii_m: [below, above], half_height_m } => {
                let slope = (above - below) / (2.0 * half_height_m);
                let slant = half_height_m * slope.hypot(1.0);
                for offset in grid(slant, spacing_m) {
                    let z = offset * half_height_m / slant;
                    let radius = (below + above) / 2.0 + slope * z;
                    out.extend(ring(radius, spacing_m).map(|u| Surfel {
                        position: u * radius + DVec3::Z * z,
                        normal: (u - DVec3::Z * slope).normalize(),
                    }));
                }
                for (end, side) in [(below, -1.0), (above, 1.0)].into_iter().filter(|(end, _)| *end > 0.0) {
                    let normal = DVec3::Z * side;
                    for r in grid(end / 2.0, spacing_m).map(|r| r + end / 2.0) {
                        out.extend(
                            ring(r, spacing_m)
                                .map(|u| Surfel { position: u * r + normal * half_height_m, normal }),
                        );
                    }
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

/// Solutions of a t^2 + 2 b t + c = 0, ascending.
fn roots(a: f64, b: f64, c: f64) -> Option<[f64; 2]> {
    let discriminant = b * b - a * c;
    (discriminant >= 0.0 && a != 0.0).then(|| {
        let root = discriminant.sqrt();
        let (s, t) = ((-b - root) / a, (-b + root) / a);
        [s.min(t), s.max(t)]
    })
}

/// Middles of equal steps of at most `spacing` over `-half..half`.
fn grid(half: f64, spacing: f64) -> impl Iterator<Item = f64> + Clone {
    let n = (2.0 * half / spacing).ceil().max(1.0) as u32;
    (0..n).map(move |i| half * ((2 * i + 1) as f64 / f64::from(n) - 1.0))
}

/// Unit directions around z, at most `spacing` apart at radius `radius`.
fn ring(radius: f64, spacing: f64) -> impl Iterator<Item = DVec3> {
    let n = (std::f64::consts::TAU * radius / spacing).ceil().max(3.0) as u32;
    (0..n).map(move |i| {
        let (sin, cos) = (std::f64::consts::TAU * f64::from(i) / f64::from(n)).sin_cos();
        DVec3::new(cos, sin, 0.0)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use slag_math::random::Xorshift;

    const HALF: DVec3 = DVec3::new(0.4, 0.3, 0.5);
    const SHAPES: [Shape; 5] = [
        Shape::Box(HALF),
        Shape::Ellipsoid(HALF),
        Shape::Cone { radii_m: [0.3, 0.3], half_height_m: 0.4 },
        Shape::Cone { radii_m: [0.4, 0.1], half_height_m: 0.3 },
        Shape::Cone { radii_m: [0.0, 0.5], half_height_m: 0.2 },
    ];

    /// The implicit equation of each surface: positive outside, negative inside.
    fn outside(shape: Shape, p: DVec3) -> f64 {
        match shape {
            Shape::Box(half) => (p.abs() - half).max_element(),
            Shape::Ellipsoid(half) => (p / half).length() - 1.0,
            Shape::Cone { radii_m: [below, above], half_height_m } => {
                let radius = below + (above - below) * (p.z / half_height_m + 1.0) / 2.0;
                (p.x.hypot(p.y) - radius).max(p.z.abs() - half_height_m)
            }
        }
    }

    #[test]
    fn points_lie_on_the_surface_evenly() {
        let spacing_m = 0.02;
        let tau = std::f64::consts::TAU;
        let areas = [
            8.0 * (HALF.x * HALF.y + HALF.y * HALF.z + HALF.z * HALF.x),
            // Thomsen's formula, within 1%.
            {
                let p = 1.6075;
                let [a, b, c] = HALF.to_array().map(|h| h.powf(p));
                2.0 * tau * ((a * b + a * c + b * c) / 3.0).powf(1.0 / p)
            },
            tau * 0.3 * (0.8 + 0.3),
            tau / 2.0 * (0.5 * 0.3f64.hypot(0.6) + 0.16 + 0.01),
            tau / 2.0 * (0.5 * 0.5f64.hypot(0.4) + 0.25),
        ];
        for (shape, area) in SHAPES.into_iter().zip(areas) {
            let surfels = shape.surfels(spacing_m);
            for s in &surfels {
                assert!(shape.contains(s.position * 0.999) && !shape.contains(s.position + 1e-4 * s.normal));
                assert!(outside(shape, s.position).abs() < 1e-9, "{shape:?} {s:?}");
                assert!((s.normal.length() - 1.0).abs() < 1e-9);
                assert!(outside(shape, s.position + 1e-4 * s.normal) > 0.0, "{shape:?} {s:?}");
            }
            let found = surfels.len() as f64 * spacing_m * spacing_m;
            assert!((found / area - 1.0).abs() < 0.1, "{shape:?}: {found}, {area}");
        }
    }

    /// Oracle: small steps along the ray through the implicit equation.
    #[test]
    fn rays_enter_where_the_surface_is() {
        let mut random = Xorshift::new(11);
        let mut n_hits = 0;
        for shape in SHAPES {
            for _ in 0..2000 {
                let origin = DVec3::from([0; 3].map(|_| 1.5 * random.signed()));
                if outside(shape, origin) < 0.0 {
                    continue;
                }
                let towards = DVec3::from([0; 3].map(|_| 0.6 * random.signed()));
                let direction = (towards - origin).normalize();
                let step = 1e-3;
                let walked = (0..4000)
                    .map(|i| f64::from(i) * step)
                    .find(|t| outside(shape, origin + direction * *t) < -1e-3);
                let found = shape.hit(origin, direction);
                if let Some((t, normal)) = found {
                    let at = origin + direction * t;
                    assert!(outside(shape, at).abs() < 1e-9, "{shape:?} {at}");
                    assert!(normal.dot(direction) <= 1e-9, "{shape:?} {normal}");
                    assert!(outside(shape, at + 1e-5 * normal) > 0.0, "{shape:?} {at} {normal}");
                    n_hits += 1;
                }
                // Steps may miss a grazing ray; `hit` must not miss a ray that the steps find.
                if let Some(walked) = walked {
                    let (t, _) = found.unwrap_or_else(|| panic!("{shape:?} from {origin} along {direction}"));
                    assert!(t <= walked && walked - t < 0.25, "{shape:?}: {t} {walked}");
                }
            }
        }
        assert!(n_hits > 1000, "{n_hits}");
    }
}
