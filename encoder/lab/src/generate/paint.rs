//! Looks of surfaces: named colours, and materials.

use clap::ValueEnum;
use glam::DVec3;
use serde::Serialize;
use slag_math::random::Xorshift;

/// The eleven basic colour terms of English (Berlin and Kay 1969).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Colour {
    Black,
    White,
    Grey,
    Red,
    Green,
    Blue,
    Yellow,
    Orange,
    Brown,
    Purple,
    Pink,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Material {
    /// Long grain along the part's longest edge.
    Wood,
    /// Brushed, with a strong highlight.
    Metal,
    /// Even, with a highlight.
    Plastic,
    /// Fine weave, no highlight.
    Fabric,
    /// Dark patches, a soft highlight.
    Leather,
    /// Mottled.
    Stone,
    /// Courses of bricks with mortar.
    Brick,
    /// Smooth and glossy.
    Ceramic,
    /// Glossy, with a reflected streak.
    Glass,
    /// Even and dull.
    Paper,
    /// Even, dull, rough.
    Rubber,
    /// Coarse light and dark.
    Leaf,
    /// Even, with faint patches.
    Skin,
    /// Even, with faint unevenness.
    Plaster,
    /// Squares with joints.
    Tile,
}

/// The word for a colour or a material.
pub fn word(of: impl std::fmt::Debug) -> String {
    format!("{of:?}").to_lowercase()
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Paint {
    /// Colour under white light, 0 to 1.
    pub rgb: [f64; 3],
    pub material: Material,
    pub seed: u32,
}

impl Colour {
    pub fn shade(self, random: &mut Xorshift) -> [f64; 3] {
        // Ranges of hue in degrees, saturation and value that clearly belong to the name.
        let [hue, saturation, value] = match self {
            Self::Black => [[0.0, 360.0], [0.0, 0.15], [0.05, 0.14]],
            Self::White => [[0.0, 360.0], [0.0, 0.04], [0.92, 1.0]],
            Self::Grey => [[0.0, 360.0], [0.0, 0.06], [0.38, 0.66]],
            Self::Red => [[-8.0, 6.0], [0.75, 0.95], [0.6, 0.88]],
            Self::Green => [[95.0, 145.0], [0.5, 0.85], [0.32, 0.7]],
            Self::Blue => [[208.0, 236.0], [0.6, 0.9], [0.45, 0.85]],
            Self::Yellow => [[48.0, 57.0], [0.72, 0.95], [0.88, 0.98]],
            Self::Orange => [[22.0, 32.0], [0.82, 0.98], [0.88, 0.98]],
            Self::Brown => [[18.0, 32.0], [0.5, 0.7], [0.3, 0.5]],
            Self::Purple => [[268.0, 288.0], [0.45, 0.8], [0.4, 0.7]],
            Self::Pink => [[325.0, 345.0], [0.3, 0.55], [0.88, 0.98]],
        }
        .map(|[low, high]| low + (high - low) * random.unit());
        // HSV to RGB (Smith 1978).
        [5.0, 3.0, 1.0].map(|n| {
            let k = (n + hue.rem_euclid(360.0) / 60.0) % 6.0;
            value * (1.0 - saturation * k.min(4.0 - k).clamp(0.0, 1.0))
        })
    }
}

impl Material {
    /// Strength and sharpness (Phong's exponent) of its highlight.
    pub fn highlight(self) -> [f64; 2] {
        match self {
            Self::Metal => [0.45, 18.0],
            Self::Glass => [0.5, 50.0],
            Self::Ceramic => [0.35, 40.0],
            Self::Plastic => [0.22, 25.0],
            Self::Leather | Self::Tile => [0.12, 12.0],
            Self::Wood => [0.05, 10.0],
            _ => [0.0, 1.0],
        }
    }
}

impl Paint {
    /// Colour at a point of a part, in its own frame. `longest` is the part's longest axis.
    pub fn albedo(&self, at: DVec3, longest: usize) -> [f64; 3] {
        let noise = |scale: DVec3| value_noise(at * scale, self.seed);
        let even = |per_m: f64| noise(DVec3::splat(per_m));
        let factor = match self.material {
            Material::Wood => {
                let mut scale = DVec3::splat(45.0);
                scale[longest] = 3.0;
                let mut wide = DVec3::splat(12.0);
                wide[longest] = 0.8;
                1.0 + 0.16 * noise(scale) + 0.12 * noise(wide)
            }
            Material::Metal => {
                let mut scale = DVec3::splat(4.0);
                scale[longest] = 120.0;
                1.0 + 0.07 * noise(scale)
            }
            Material::Fabric => 1.0 + 0.12 * even(160.0) + 0.06 * even(14.0),
            Material::Leather => 0.95 + 0.09 * even(18.0),
            Material::Stone => 0.97 + 0.16 * even(9.0) + 0.12 * even(45.0),
            Material::Leaf => 0.9 + 0.32 * even(16.0) + 0.16 * even(50.0),
            Material::Paper | Material::Rubber => 1.0 + 0.03 * even(60.0),
            Material::Skin | Material::Plaster => 1.0 + 0.02 * even(3.0),
            Material::Glass => 1.0 + 0.25 * noise(DVec3::new(2.5, 2.5, 0.8)).max(0.0),
            Material::Brick | Material::Tile => {
                let [width, height] =
                    if self.material == Material::Brick { [0.24, 0.08] } else { [0.3, 0.3] };
                // Courses run along x and y alike, to continue around corners, and rise along z (on floors, y).
                let up = if longest == 2 { at.z } else { at.z + at.y };
                let course = (up / height).floor();
                let shift = if self.material == Material::Brick { 0.5 * course } else { 0.0 };
                let along = (at.x + if longest == 0 { 0.0 } else { at.y }) / width + shift;
                let joint = (up / height - course) < 0.14 || along - along.floor() < 0.05;
                if joint {
                    1.25
                } else {
                    0.95 + 0.08 * value_noise(DVec3::new(along.floor(), course, 0.0), self.seed)
                }
            }
            Material::Plastic | Material::Ceramic => 1.0,
        };
        self.rgb.map(|c| (c * factor).clamp(0.0, 1.0))
    }
}

/// Smooth noise of -1 to 1 with features one unit wide (value noise).
fn value_noise(at: DVec3, seed: u32) -> f64 {
    let low = at.floor();
    let t = at - low;
    let t = t * t * (DVec3::splat(3.0) - 2.0 * t);
    let corner = |x: i64, y: i64, z: i64| {
        let mut h = u64::from(seed);
        for v in [low.x as i64 + x, low.y as i64 + y, low.z as i64 + z] {
            h = (h ^ v as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15);
            h ^= h >> 29;
        }
        (h >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    };
    let along = |a: f64, b: f64, t: f64| a + (b - a) * t;
    let plane = |z: i64| {
        along(along(corner(0, 0, z), corner(1, 0, z), t.x), along(corner(0, 1, z), corner(1, 1, z), t.x), t.y)
    };
    along(plane(0), plane(1), t.z)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the definition of hue, saturation and value from RGB.
    #[test]
    fn shades_keep_to_their_names() {
        let mut random = Xorshift::new(5);
        for colour in Colour::value_variants() {
            for _ in 0..100 {
                let rgb = colour.shade(&mut random);
                let (low, high) =
                    (rgb.iter().copied().fold(1.0, f64::min), rgb.iter().copied().fold(0.0, f64::max));
                let saturation = if high > 0.0 { (high - low) / high } else { 0.0 };
                let dull = matches!(colour, Colour::Black | Colour::White | Colour::Grey);
                assert_eq!(saturation < 0.2, dull, "{colour:?} {rgb:?}");
                let [r, g, b] = rgb;
                match colour {
                    Colour::Red => assert!(r > 2.0 * g && r > 2.0 * b),
                    Colour::Green => assert!(g > r && g > b),
                    Colour::Blue => assert!(b > r && b > g),
                    Colour::Yellow => assert!(r > b && g > 0.6 * r && g > 2.0 * b),
                    Colour::Black => assert!(high < 0.2),
                    Colour::White => assert!(low > 0.85),
                    _ => {}
                }
            }
        }
    }

    #[test]
    fn noise_is_smooth_bounded_and_of_mean_zero() {
        let mut sum = 0.0;
        for i in 0..10_000 {
            let at = DVec3::new(f64::from(i) * 0.37, f64::from(i) * 0.11, -7.3);
            let here = value_noise(at, 3);
            assert!(here.abs() <= 1.0);
            assert!((value_noise(at + 1e-6, 3) - here).abs() < 1e-4);
            sum += here;
        }
        assert!((sum / 1e4).abs() < 0.05, "{sum}");
        assert_ne!(value_noise(DVec3::splat(0.5), 1), value_noise(DVec3::splat(0.5), 2));
    }
}
