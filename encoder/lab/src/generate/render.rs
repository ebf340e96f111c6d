//! Photos of a generated scene, with the thing at each pixel, by casting one ray per pixel.

use glam::{DAffine3, DVec3};
use image::{Rgb, RgbImage};
use rayon::prelude::*;

use super::solid::{Part, Surfel};
use slag_encoder::raster::RasterView;

/// Edge of a tile. The rays of a tile share one list of candidate things.
const TILE_PX: u32 = 16;
/// Distance from the surface at which shadow rays start.
const OFF_SURFACE_M: f64 = 1e-4;

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Light {
    /// From a direction; unit length.
    Sun(DVec3),
    Lamp(DVec3),
}

impl Light {
    /// Direction from a point to the light (unit length), and its distance in metres.
    fn from(self, at: DVec3) -> (DVec3, f64) {
        match self {
            Self::Sun(direction) => (direction, f64::INFINITY),
            Self::Lamp(position) => {
                let distance_m = position.distance(at);
                ((position - at) / distance_m, distance_m)
            }
        }
    }
}

#[derive(Clone, Debug)]
pub struct Thing {
    pieces: Vec<Piece>,
    pub centre: DVec3,
    /// Radius of a sphere around the centre that encloses it.
    pub radius_m: f64,
}

#[derive(Clone, Debug)]
struct Piece {
    part: Part,
    part_from_world: DAffine3,
    centre: DVec3,
    radius_m: f64,
    longest_axis: usize,
}

#[derive(Clone, Debug)]
pub struct Solids {
    pub things: Vec<Thing>,
    light: Light,
    ambient: f64,
    tint: [f64; 3],
}

#[derive(Clone, Debug)]
pub struct Photo {
    pub image: RgbImage,
    /// Index of the thing at each pixel, row-major; [`NOTHING`] for the sky.
    pub thing_of_pixel: Vec<u16>,
    /// Depth at each pixel along the camera's axis, metres; infinite for the sky.
    pub depth_m: Vec<f32>,
    /// Pixels that each thing would have without the others.
    pub unhidden_px: Vec<u32>,
}

/// Index for pixels without a thing.
pub const NOTHING: u16 = u16::MAX;

struct Hit {
    t: f64,
    normal: DVec3,
    thing: usize,
    piece: usize,
}

impl Thing {
    pub fn new(parts: &[Part], world_from_object: DAffine3) -> Self {
        let pieces: Vec<Piece> = parts
            .iter()
            .map(|part| {
                let world_from_part = world_from_object * part.object_from_part;
                Piece {
                    part: Part { object_from_part: world_from_part, ..*part },
                    part_from_world: world_from_part.inverse(),
                    centre: world_from_part.translation,
                    radius_m: part.shape.radius_m(),
                    longest_axis: part.shape.longest_axis(),
                }
            })
            .collect();
        let centre = pieces.iter().map(|p| p.centre).sum::<DVec3>() / pieces.len().max(1) as f64;
        let radius_m = pieces.iter().map(|p| p.centre.distance(centre) + p.radius_m).fold(0.0, f64::max);
        Self { pieces, centre, radius_m }
    }

    /// Points on its surface about `spacing_m` apart, each with its piece.
    fn surfels(&self, spacing_m: f64) -> impl Iterator<Item = (&Piece, Surfel)> {
        self.pieces.iter().flat_map(move |piece| piece.part.surfels(spacing_m).map(move |s| (piece, s)))
    }
}

impl Piece {
    fn hit(&self, origin: DVec3, direction: DVec3) -> Option<(f64, DVec3)> {
        if misses(self.centre, self.radius_m, origin, direction) {
            return None;
        }
        let (t, normal) = self.part.shape.hit(
            self.part_from_world.transform_point3(origin),
            self.part_from_world.transform_vector3(direction),
        )?;
        Some((t, self.part.object_from_part.transform_vector3(normal)))
    }
}

/// `direction` has unit length.
fn misses(centre: DVec3, radius_m: f64, origin: DVec3, direction: DVec3) -> bool {
    let to_centre = centre - origin;
    let along = to_centre.dot(direction);
    let distance_squared = to_centre.length_squared() - along * along;
    distance_squared > radius_m * radius_m || along < -radius_m
}

impl Solids {
    /// `ambient` is the share of ambient light, `tint` the colour of the light.
    pub fn new(things: Vec<Thing>, light: Light, ambient: f64, tint: [f64; 3]) -> Self {
        Self { things, light, ambient, tint }
    }

    /// Diffuse colour at a point of a surface, and whether the light reaches it.
    fn diffuse(&self, piece: &Piece, at: DVec3, normal: DVec3) -> ([f64; 3], bool) {
        let (towards, far) = self.light.from(at);
        let facing = normal.dot(towards);
        let origin = at + normal * OFF_SURFACE_M;
        let lit = facing > 0.0
            && !self.things.iter().filter(|t| !misses(t.centre, t.radius_m, origin, towards)).any(|thing| {
                thing.pieces.iter().any(|p| p.hit(origin, towards).is_some_and(|(t, _)| t < far))
            });
        let direct = if lit { facing } else { 0.0 };
        // Upward-facing surfaces get more ambient light.
        let everywhere = self.ambient * (0.85 + 0.15 * normal.z);
        let albedo = piece.part.paint.albedo(piece.part_from_world.transform_point3(at), piece.longest_axis);
        let strength = everywhere + (1.0 - self.ambient) * direct;
        let rgb = [0, 1, 2].map(|c| albedo[c] * strength * self.tint[c]);
        (rgb, lit)
    }

    fn nearest(
        &self,
        candidates: &[usize],
        origin: DVec3,
        direction: DVec3,
        seen: &mut [u32],
    ) -> Option<Hit> {
        let mut nearest: Option<Hit> = None;
        for index in candidates {
            let thing = &self.things[*index];
            if misses(thing.centre, thing.radius_m, origin, direction) {
                continue;
            }
            let mut any = false;
            for (i, piece) in thing.pieces.iter().enumerate() {
                if let Some((t, normal)) = piece.hit(origin, direction) {
                    any = true;
                    if nearest.as_ref().is_none_or(|hit| t < hit.t) {
                        nearest = Some(Hit { t, normal, thing: *index, piece: i });
                    }
                }
            }
            seen[*index] += u32::from(any);
        }
        nearest
    }

    pub fn photo(&self, view: &RasterView) -> Photo {
        let k = view.intrinsics;
        let world_from_camera = view.camera_from_world.inverse();
        let origin = world_from_camera.translation;
        let ray = |x: f64, y: f64| {
            let in_camera =
                DVec3::new((x - k.centre_x_px) / k.focal_x_px, (y - k.centre_y_px) / k.focal_y_px, 1.0);
            (world_from_camera.matrix3 * in_camera).normalize()
        };
        let (columns, rows) = (k.width_px.div_ceil(TILE_PX), k.height_px.div_ceil(TILE_PX));
        let tiles: Vec<_> = (0..columns * rows)
            .into_par_iter()
            .map(|tile| {
                let (x0, y0) = (tile % columns * TILE_PX, tile / columns * TILE_PX);
                let (x1, y1) = ((x0 + TILE_PX).min(k.width_px), (y0 + TILE_PX).min(k.height_px));
                let corners = [(x0, y0), (x1, y0), (x0, y1), (x1, y1)].map(|(x, y)| ray(x.into(), y.into()));
                let axis = ray(f64::from(x0 + x1) / 2.0, f64::from(y0 + y1) / 2.0);
                let candidates = self.things_within(origin, axis, &corners);
                let mut seen = vec![0; self.things.len()];
                let mut pixels = Vec::with_capacity((TILE_PX * TILE_PX) as usize);
                for (x, y) in (y0..y1).flat_map(|y| (x0..x1).map(move |x| (x, y))) {
                    let direction = ray(f64::from(x) + 0.5, f64::from(y) + 0.5);
                    let (rgb, thing, t) = match self.nearest(&candidates, origin, direction, &mut seen) {
                        Some(hit) => (self.shade(&hit, origin, direction), hit.thing as u16, hit.t),
                        None => (sky(direction), NOTHING, f64::INFINITY),
                    };
                    let rgb = rgb.map(|c| (c.clamp(0.0, 1.0) * 255.0).round() as u8);
                    let depth_m = t * direction.dot(world_from_camera.matrix3.z_axis);
                    pixels.push((x, y, rgb, thing, depth_m as f32));
                }
                (pixels, seen)
            })
            .collect();
        let mut photo = Photo {
            image: RgbImage::new(k.width_px, k.height_px),
            thing_of_pixel: vec![NOTHING; (k.width_px * k.height_px) as usize],
            depth_m: vec![f32::INFINITY; (k.width_px * k.height_px) as usize],
            unhidden_px: vec![0; self.things.len()],
        };
        for (pixels, seen) in tiles {
            for (x, y, rgb, thing, depth_m) in pixels {
                photo.image.put_pixel(x, y, Rgb(rgb));
                photo.thing_of_pixel[(y * k.width_px + x) as usize] = thing;
                photo.depth_m[(y * k.width_px + x) as usize] = depth_m;
            }
            photo.unhidden_px.iter_mut().zip(seen).for_each(|(sum, n)| *sum += n);
        }
        photo
    }

    /// Returns the things that intersect the cone from `origin` around `axis` that includes all `directions`.
    fn things_within(&self, origin: DVec3, axis: DVec3, directions: &[DVec3]) -> Vec<usize> {
        let angle = |cosine: f64| cosine.clamp(-1.0, 1.0).acos();
        let spread = directions.iter().map(|direction| angle(direction.dot(axis))).fold(0.0, f64::max);
        let intersects = |i: &usize| {
            let to = self.things[*i].centre - origin;
            let (distance, radius) = (to.length(), self.things[*i].radius_m);
            radius >= distance || angle(to.dot(axis) / distance) <= spread + (radius / distance).asin()
        };
        (0..self.things.len()).filter(intersects).collect()
    }

    fn shade(&self, hit: &Hit, origin: DVec3, direction: DVec3) -> [f64; 3] {
        let piece = &self.things[hit.thing].pieces[hit.piece];
        let at = origin + direction * hit.t;
        let (rgb, lit) = self.diffuse(piece, at, hit.normal);
        let [strength, sharpness] = piece.part.paint.material.highlight();
        if !lit || strength == 0.0 {
            return rgb;
        }
        // Phong 1975.
        let mirrored = direction - 2.0 * direction.dot(hit.normal) * hit.normal;
        let highlight = strength * mirrored.dot(self.light.from(at).0).max(0.0).powf(sharpness);
        rgb.map(|c| c + highlight)
    }

    /// Points that cover a thing about `spacing_m` apart, each with its lit colour.
    pub fn covering(&self, thing: usize, spacing_m: f64) -> Vec<(Surfel, [f64; 3])> {
        let surfels: Vec<_> = self.things[thing].surfels(spacing_m).collect();
        surfels.into_par_iter().map(|(piece, s)| (s, self.diffuse(piece, s.position, s.normal).0)).collect()
    }
}

/// Brighter at the horizon.
fn sky(direction: DVec3) -> [f64; 3] {
    let up = direction.z.clamp(0.0, 1.0);
    [0.88 - 0.35 * up, 0.92 - 0.2 * up, 0.97]
}
