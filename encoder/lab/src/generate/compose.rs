//! Layout of a scene: poses of things, light, and cameras.

use glam::{DAffine3, DMat3, DVec2, DVec3};
use slag_common::Intrinsics;
use slag_common::frames::Aabb;

use super::grammar::{NOUNS, Noun, Object, Place, SceneKind};
use super::paint::Colour;
use super::render::{Light, Solids, Thing};
use slag_math::random::Xorshift;

use super::solid::{Part, Shape};
use slag_encoder::raster::{self, RasterView};

pub(super) const PHOTO_PX: [u32; 2] = [640, 480];
/// Horizontal field of view, 75 degrees: a phone's wide camera.
pub(super) const FIELD_OF_VIEW_RAD: f64 = 75.0 * std::f64::consts::PI / 180.0;
const CAMERA_HEIGHT_M: f64 = 1.5;
const ROBOT_HEIGHT_M: f64 = 0.6;
/// Gap between things on the ground, so that cameras can walk around them.
const GAP_M: f64 = 0.3;
const CAMERA_CLEARANCE_M: f64 = 0.35;
/// Poses tried for a thing before it is left out.
const N_TRIES: usize = 30;
const SHELL_M: f64 = 0.04;
/// Distance between the rows of a warehouse.
const ROW_M: f64 = 2.6;
/// Kinds of things that stand in a warehouse's rows; those of a kind are equal.
const N_ALIKE: usize = 6;
/// Roberts' R2.
const STEP: DVec2 = DVec2::new(0.754_877_666_246_692_7, 0.569_840_290_998_053_2);
const GOLDEN_ANGLE: f64 = 2.399_963_229_728_653;

#[derive(Clone, Debug)]
pub struct Placed {
    pub noun: usize,
    pub object: Object,
    pub world_from_object: DAffine3,
    pub bounds: Aabb,
    /// Whether it is part of the scene's shell, such as floor and walls.
    pub shell: bool,
}

/// Where a scene's photos are taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Walk {
    /// On an oval through the middle of each area.
    #[default]
    Oval,
    /// All over each area, as of somebody who shows a robot where it may drive.
    Everywhere,
    /// From 6 to 18 m above the ground, as of a drone; for scenes without a roof.
    Above,
}

/// A piece of ground that things stand on and cameras walk through.
#[derive(Clone, Copy, Debug)]
struct Area {
    kind: SceneKind,
    corner: DVec2,
    size: DVec2,
    height_m: f64,
}

#[derive(Clone, Debug)]
pub struct Layout {
    pub placed: Vec<Placed>,
    areas: Vec<Area>,
    light: Light,
    ambient: f64,
    tint: [f64; 3],
}

/// Returns whether a noun's things may have a colour.
pub type Colours<'a> = &'a dyn Fn(&Noun, Colour) -> bool;

impl Layout {
    /// Furnishes scenes side by side along x. Equal seeds give equal layouts.
    pub fn new(kinds: &[SceneKind], seed: u64, colours: Colours<'_>) -> Self {
        let mut random = Xorshift::new(seed);
        let outdoors = kinds.iter().any(|kind| !kind.has_roof());
        let mut layout = Self {
            placed: Vec::new(),
            areas: Vec::new(),
            light: Light::Sun(DVec3::Z),
            ambient: random.between(0.45, 0.7),
            tint: [random.between(0.92, 1.0), random.between(0.94, 1.0), random.between(0.9, 1.0)],
        };
        let mut corner = DVec2::ZERO;
        for kind in kinds {
            let (size, height_m) = match kind {
                SceneKind::Room => {
                    (DVec2::new(random.between(5.5, 8.0), random.between(4.5, 6.5)), random.between(2.5, 2.8))
                }
                SceneKind::Yard => (DVec2::new(random.between(10.0, 14.0), random.between(9.0, 12.0)), 4.0),
                SceneKind::Street => {
                    (DVec2::new(random.between(20.0, 26.0), random.between(13.0, 15.0)), 6.0)
                }
                SceneKind::Warehouse => {
                    (DVec2::new(random.between(15.0, 19.0), random.between(12.0, 14.0)), 5.0)
                }
            };
            let area = Area { kind: *kind, corner, size, height_m };
            layout.furnish(&area, colours, &mut random);
            layout.areas.push(area);
            corner.x += size.x + 0.5;
        }
        let first = layout.areas[0];
        layout.light = if outdoors {
            let angle = random.between(0.0, std::f64::consts::TAU);
            Light::Sun(DVec3::new(angle.cos(), angle.sin(), random.between(0.9, 2.5)).normalize())
        } else {
            let at =
                first.corner + first.size * DVec2::new(random.between(0.3, 0.7), random.between(0.3, 0.7));
            Light::Lamp(at.extend(first.height_m - 0.15))
        };
        // No sunlight gets under the roof, so a room needs more ambient light.
        if outdoors && kinds.iter().any(|kind| kind.has_roof()) {
            layout.ambient = 0.75;
        }
        layout
    }

    /// Furnishes a training scene. Consecutive seeds cycle through the kinds.
    pub fn of_any_kind(seed: u64, colours: Colours<'_>) -> Self {
        let kinds = [SceneKind::Room, SceneKind::Yard, SceneKind::Street];
        Self::new(&[kinds[(seed % 3) as usize]], seed, colours)
    }

    /// Solids to cast rays at, in the order of [`Layout::placed`].
    pub fn solids(&self) -> Solids {
        let things = self.placed.iter().map(|p| Thing::new(&p.object.parts, p.world_from_object)).collect();
        Solids::new(things, self.light, self.ambient, self.tint)
    }

    fn furnish(&mut self, area: &Area, colours: Colours<'_>, random: &mut Xorshift) {
        let make = |noun: &Noun, random: &mut Xorshift| noun.make(random, |colour| colours(noun, colour));
        let of_place = |place: Place| -> Vec<usize> {
            (0..NOUNS.len()).filter(|i| NOUNS[*i].found.contains(&(area.kind, place))).collect()
        };
        for noun in of_place(Place::Shell) {
            let mut object = make(&NOUNS[noun], random);
            object.parts = area.shell(&NOUNS[noun].name, &object);
            if !object.parts.is_empty() {
                self.place(noun, object, DAffine3::IDENTITY, true);
            }
        }
        let n_of_place = match area.kind {
            SceneKind::Room => {
                vec![(Place::Wall, 8), (Place::Floor, 4), (Place::Hung, 3), (Place::On, 5)]
            }
            SceneKind::Yard => vec![(Place::Wall, 7), (Place::Floor, 9), (Place::On, 2)],
            SceneKind::Street => vec![(Place::Wall, 8), (Place::Floor, 10), (Place::On, 1)],
            SceneKind::Warehouse => {
                vec![(Place::Row, 48), (Place::Wall, 8), (Place::Floor, 5), (Place::On, 10)]
            }
        };
        for (place, n) in n_of_place {
            let mut choice = of_place(place);
            random.shuffle(&mut choice);
            let mut alike = Vec::new();
            if place == Place::Row {
                choice.truncate(N_ALIKE);
                alike = choice.iter().map(|noun| make(&NOUNS[*noun], random)).collect();
            }
            for (i, noun) in choice.iter().copied().cycle().take(n).enumerate() {
                let object = match alike.get(i % choice.len()) {
                    Some(object) => object.clone(),
                    None => make(&NOUNS[noun], random),
                };
                let vehicle = NOUNS[noun].kinds.iter().any(|kind| kind == "vehicle");
                for _ in 0..N_TRIES {
                    let Some(pose) = self.propose(area, place, &object, vehicle, random) else { break };
                    let bounds = bounds(&object.parts, pose);
                    if area.holds(&bounds) && self.is_free(&bounds, place) {
                        self.place(noun, object, pose, false);
                        break;
                    }
                }
            }
        }
    }

    fn place(&mut self, noun: usize, object: Object, world_from_object: DAffine3, shell: bool) {
        let bounds = bounds(&object.parts, world_from_object);
        self.placed.push(Placed { noun, object, world_from_object, bounds, shell });
    }

    /// `None` if there is no such place.
    fn propose(
        &self,
        area: &Area,
        place: Place,
        object: &Object,
        vehicle: bool,
        random: &mut Xorshift,
    ) -> Option<DAffine3> {
        let own = bounds(&object.parts, DAffine3::IDENTITY);
        let (low, high) = (area.corner, area.corner + area.size);
        let pi = std::f64::consts::PI;
        Some(match place {
            Place::Wall | Place::Hung => {
                // Quarter turns, with the back (-y) to the wall.
                let side = random.below(4);
                let back_m = -own.min.y + SHELL_M + if place == Place::Hung { 0.0 } else { 0.02 };
                let along = [random.between(low.x, high.x), random.between(low.y, high.y)];
                let (yaw, at) = match side {
                    0 => (0.0, DVec2::new(along[0], low.y + back_m)),
                    1 => (pi / 2.0, DVec2::new(high.x - back_m, along[1])),
                    2 => (pi, DVec2::new(along[0], high.y - back_m)),
                    _ => (-pi / 2.0, DVec2::new(low.x + back_m, along[1])),
                };
                around_z(yaw, at.extend(0.0))
            }
            Place::Floor if vehicle && area.kind == SceneKind::Street => {
                let lane = if random.below(2) == 0 { 1.0 } else { -1.0 };
                let at = DVec2::new(
                    random.between(low.x, high.x),
                    (low.y + high.y) / 2.0 + lane * 1.8 + 0.2 * random.signed(),
                );
                around_z(-lane * pi / 2.0 + 0.05 * random.signed(), at.extend(0.0))
            }
            Place::Floor => {
                let at = DVec2::new(random.between(low.x, high.x), random.between(low.y, high.y));
                around_z(random.between(-pi, pi), at.extend(0.0))
            }
            Place::Row => {
                let n_rows = ((high.y - low.y - 4.0) / ROW_M).floor() as u32;
                let row = random.below(n_rows as usize) as f64;
                let at =
                    DVec2::new(random.between(low.x + 1.0, high.x - 1.0), low.y + 2.0 + (row + 0.5) * ROW_M);
                around_z(pi * random.below(2) as f64 + 0.04 * random.signed(), at.extend(0.0))
            }
            Place::On => return self.on_top(area, own.size(), random),
            Place::Shell => return None,
        })
    }

    fn on_top(&self, area: &Area, size: DVec3, random: &mut Xorshift) -> Option<DAffine3> {
        let tops: Vec<(&Placed, _)> = self
            .placed
            .iter()
            .filter(|p| p.bounds.min.x >= area.corner.x - 0.1)
            .filter_map(|p| p.object.top.map(|top| (p, top)))
            .collect();
        if tops.is_empty() {
            return None;
        }
        let (below, top) = *random.pick(&tops);
        let half = [0, 1].map(|i| top.size_m[i] / 2.0 - size[i] / 2.0);
        if half.iter().any(|h| *h < 0.0) {
            // Too large for this top; another try may pick a larger one.
            return Some(around_z(0.0, DVec3::splat(f64::MAX)));
        }
        let at = DVec3::new(half[0] * random.signed(), half[1] * random.signed(), top.z_m);
        Some(below.world_from_object * around_z(0.3 * random.signed(), at))
    }

    fn is_free(&self, bounds: &Aabb, place: Place) -> bool {
        let gap = match place {
            Place::Wall | Place::Floor => DVec3::new(GAP_M, GAP_M, 0.0),
            Place::Row => DVec3::new(0.05, 0.05, 0.0),
            _ => DVec3::splat(0.02),
        };
        self.placed.iter().filter(|p| !p.shell).all(|p| {
            // A thing touches the top it stands on.
            let slack = if place == Place::On { DVec3::new(0.0, 0.0, -0.03) } else { DVec3::ZERO };
            let (low, high) = (bounds.min - gap - slack, bounds.max + gap);
            low.cmpgt(p.bounds.max).any() || p.bounds.min.cmpgt(high).any()
        })
    }

    pub fn is_walkable(&self, at: DVec3) -> bool {
        let inside = self.areas.iter().any(|area| {
            let p = at.truncate();
            p.cmpgt(area.corner + 0.2).all()
                && p.cmplt(area.corner + area.size - 0.2).all()
                && at.z < area.height_m - 0.1
        });
        inside
            && self.placed.iter().filter(|p| !p.shell).all(|p| p.bounds.distance_to(at) > CAMERA_CLEARANCE_M)
    }

    pub fn photos(&self, walk: Walk, n_views: u32) -> Vec<RasterView> {
        match walk {
            Walk::Oval => self.walk(n_views, 0.0, photo_intrinsics()),
            Walk::Everywhere => self.roam(n_views, photo_intrinsics()),
            Walk::Above => self.fly(n_views, 0, 6.0..18.0, photo_intrinsics()),
        }
    }

    /// Returns cameras above all areas, which look down by 45 to 80 degrees in headings of [`Layout::roam`], from step
    /// `start` on.
    pub fn fly(
        &self,
        n_views: u32,
        start: u32,
        heights_m: std::ops::Range<f64>,
        intrinsics: Intrinsics,
    ) -> Vec<RasterView> {
        let (low, last) = (self.areas[0].corner, self.areas[self.areas.len() - 1]);
        let size = last.corner + last.size - low;
        let camera = |i: u32| {
            let i = f64::from(i);
            let spread = (STEP * (i + 1.0)).fract();
            let height_m = heights_m.start + (heights_m.end - heights_m.start) * (GOLDEN_ANGLE * i).fract();
            let down = (45.0 + 35.0 * (STEP.x * GOLDEN_ANGLE * i).fract()).to_radians().tan();
            let (sin, cos) = (GOLDEN_ANGLE * i).sin_cos();
            // What the camera looks at lies over the area, not the camera.
            let at = low + size * spread - DVec2::new(cos, sin) * height_m / down;
            looking(at.extend(height_m), DVec3::new(cos, sin, -down))
        };
        (start..start + n_views).map(|i| RasterView { camera_from_world: camera(i), intrinsics }).collect()
    }

    /// Returns cameras all over the walkable places, with low-discrepancy places (Roberts' R2) and headings (golden
    /// angle); fewer than `n_views` if there is hardly room.
    fn roam(&self, n_views: u32, intrinsics: Intrinsics) -> Vec<RasterView> {
        let tries = (0..20 * n_views).flat_map(|i| self.areas.iter().map(move |area| (f64::from(i), area)));
        let cameras = tries.filter_map(|(i, area)| {
            let at = area.corner + area.size * (0.5 + STEP * (i + 1.0)).fract();
            // Every second one is a robot's, which looks below tables.
            let (height, down) = if i % 2.0 == 0.0 { (CAMERA_HEIGHT_M, 0.5) } else { (ROBOT_HEIGHT_M, 0.2) };
            let position = at.extend(height);
            let heading = DVec3::new((GOLDEN_ANGLE * i).cos(), (GOLDEN_ANGLE * i).sin(), -down);
            let camera_from_world = looking(position, heading);
            self.is_walkable(position).then_some(RasterView { camera_from_world, intrinsics })
        });
        cameras.take(n_views as usize).collect()
    }

    /// Returns cameras on an oval walk through each area, looking outwards and across in turn, from step `start` on.
    pub fn walk(&self, n_views: u32, start: f64, intrinsics: Intrinsics) -> Vec<RasterView> {
        let n_areas = self.areas.len() as u32;
        (0..n_views)
            .map(|i| {
                let area = &self.areas[(i % n_areas) as usize];
                let (i, n) = (i / n_areas, n_views.div_ceil(n_areas));
                let across = i % 2 == 1;
                let middle = area.corner + area.size / 2.0;
                let mut angle = std::f64::consts::TAU * (f64::from(i) + start) / f64::from(n);
                let mut away = if across { 0.36 } else { 0.14 };
                // Moves on where a thing is in the way.
                for _ in 0..60 {
                    let direction = DVec2::new(angle.cos(), angle.sin());
                    if self.is_walkable((middle + direction * area.size * away).extend(CAMERA_HEIGHT_M)) {
                        break;
                    }
                    angle += 0.11;
                    away = if away > 0.4 { 0.1 } else { away + 0.037 };
                }
                let direction = DVec2::new(angle.cos(), angle.sin());
                let position = (middle + direction * area.size * away).extend(CAMERA_HEIGHT_M);
                let heading = if across { -direction } else { direction }.extend(-0.35);
                RasterView { camera_from_world: looking(position, heading), intrinsics }
            })
            .collect()
    }
}

impl Area {
    fn holds(&self, bounds: &Aabb) -> bool {
        let (low, high) = (self.corner, self.corner + self.size);
        bounds.min.truncate().cmpge(low).all()
            && bounds.max.truncate().cmple(high).all()
            && bounds.max.z <= if self.kind.has_roof() { self.height_m } else { f64::INFINITY }
    }

    fn shell(&self, name: &str, object: &Object) -> Vec<Part> {
        let (middle, size) = (self.corner + self.size / 2.0, self.size);
        let slab = |centre: DVec3, size: DVec3| Part {
            shape: Shape::Box(size / 2.0),
            object_from_part: DAffine3::from_translation(centre),
            paint: object.paint,
        };
        let ground = |y_m: f64, depth_m: f64, z_m: f64| {
            let height_m = SHELL_M + z_m.max(0.0);
            slab(DVec3::new(middle.x, y_m, z_m - height_m / 2.0), DVec3::new(size.x, depth_m, height_m))
        };
        match name {
            "floor" | "grass" => vec![ground(middle.y, size.y, 0.0)],
            "ceiling" => vec![ground(middle.y, size.y, self.height_m + SHELL_M)],
            "road" => vec![ground(middle.y, 8.0, 0.0)],
            "pavement" => {
                let depth_m = (size.y - 8.0) / 2.0;
                [-1.0, 1.0].map(|side| ground(middle.y + side * (4.0 + depth_m / 2.0), depth_m, 0.0)).to_vec()
            }
            "wall" => [(0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)]
                .map(|(axis, side)| {
                    let mut centre = middle.extend(self.height_m / 2.0);
                    centre[axis] += side * (size[axis] - SHELL_M) / 2.0;
                    let mut edges = size.extend(self.height_m);
                    edges[axis] = SHELL_M;
                    slab(centre, edges)
                })
                .to_vec(),
            _ => Vec::new(),
        }
    }
}

fn bounds(parts: &[Part], world_from_object: DAffine3) -> Aabb {
    let mut bounds = Aabb::EMPTY;
    for part in parts {
        let pose = world_from_object * part.object_from_part;
        let m = pose.matrix3;
        let half = match part.shape {
            Shape::Box(half) => m.x_axis.abs() * half.x + m.y_axis.abs() * half.y + m.z_axis.abs() * half.z,
            Shape::Ellipsoid(half) => {
                let row = |r: usize| (DVec3::new(m.x_axis[r], m.y_axis[r], m.z_axis[r]) * half).length();
                DVec3::new(row(0), row(1), row(2))
            }
            Shape::Cone { radii_m: [a, b], half_height_m } => {
                // A disc's reach along an axis is its radius times the sine to the disc's normal.
                let sine = m.z_axis.map(|c| (1.0 - c * c).max(0.0).sqrt());
                m.z_axis.abs() * half_height_m + sine * a.max(b)
            }
        };
        bounds.min = bounds.min.min(pose.translation - half);
        bounds.max = bounds.max.max(pose.translation + half);
    }
    bounds
}

/// Pose of an upright camera at `position` that looks along `heading`.
pub fn looking(position: DVec3, heading: DVec3) -> DAffine3 {
    let forward = heading.normalize();
    let right = forward.cross(DVec3::Z).normalize();
    let down = forward.cross(right);
    let camera_from_world = DMat3::from_cols(right, down, forward).transpose();
    DAffine3::from_mat3_translation(camera_from_world, -(camera_from_world * position))
}

fn around_z(yaw_rad: f64, at: DVec3) -> DAffine3 {
    DAffine3::from_mat3_translation(DMat3::from_rotation_z(yaw_rad), at)
}

pub fn photo_intrinsics() -> Intrinsics {
    pinhole(PHOTO_PX, FIELD_OF_VIEW_RAD)
}

pub fn pinhole([width_px, height_px]: [u32; 2], field_of_view_rad: f64) -> Intrinsics {
    raster::pinhole([width_px, height_px], f64::from(width_px) / 2.0 / (field_of_view_rad / 2.0).tan())
}
