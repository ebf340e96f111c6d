//! Where a robot can truly stand, and what it truly sees from there: from the solids of a layout.

use std::f64::consts::PI;

use anyhow::{Result, anyhow};
use glam::{DVec2, DVec3};
use slag_encoder::raster::RasterView;
use slag_math::distance_transform::squared_distances;

use crate::generate::compose::{Layout, looking, pinhole};
use crate::generate::render::Solids;

pub(super) const RADIUS_M: f64 = 0.3;
/// Largest horizontal distance to the thing.
const REACH_M: f64 = 0.8;
pub(super) const SENSOR_HEIGHT_M: f64 = 0.4;
const HEIGHT_M: f64 = 0.5;
const STEP_M: f64 = 0.1;
/// Least visible share of the thing's Gaussians. From one side hardly half of them are seen.
const MIN_VISIBLE: f64 = 0.02;
/// Least visible share of the thing's outline.
pub(super) const MIN_SHOWN: f64 = 0.1;
const CELL_M: f64 = 0.02;
/// Spacing of the tested surface points.
const SPACING_M: f64 = 0.01;
const MAX_PLACES: usize = 60;
/// The picture that decides whether a thing is shown.
const PICTURE_PX: [u32; 2] = [240, 240];
const FIELD_OF_VIEW_RAD: f64 = 110.0 * PI / 180.0;
const MIN_SHOWN_PX: u32 = 12;

/// Returns the path that asks for places to stand near a thing, for a robot on the floor. `what`: `id=` or `text=`.
pub(super) fn goal_request(what: &str, at: DVec3) -> String {
    format!(
        "/v1/goal?{what}&near={},{},0&radius_m={RADIUS_M}&reach_m={REACH_M}&sensor_height_m={SENSOR_HEIGHT_M}&height_m={HEIGHT_M}&step_m={STEP_M}&min_visible={MIN_VISIBLE}",
        at.x, at.y
    )
}

pub(super) struct Truth<'a> {
    layout: &'a Layout,
    solids: Solids,
    origin: DVec2,
    width: usize,
    /// Squared distance of each cell to the nearest obstacle.
    squared: Vec<u32>,
    is_reached: Vec<bool>,
    pub(super) start: DVec3,
}

impl<'a> Truth<'a> {
    /// Makes the true map of a robot that starts below the first camera with room for it.
    pub(super) fn new(layout: &'a Layout, cameras: impl Iterator<Item = DVec3>) -> Result<Self> {
        let shell = || layout.placed.iter().filter(|placed| placed.shell);
        let low = shell().fold(DVec2::INFINITY, |low, placed| low.min(placed.bounds.min.truncate()));
        let high = shell().fold(DVec2::NEG_INFINITY, |high, placed| high.max(placed.bounds.max.truncate()));
        let origin = low - 2.0 * CELL_M;
        let size = (high - origin) / CELL_M;
        let (width, height) = (size.x.ceil() as usize + 3, size.y.ceil() as usize + 3);
        // The robot cannot stand beyond the ground.
        let mut is_obstacle: Vec<bool> = (0..width * height)
            .map(|cell| {
                let at =
                    origin + DVec2::new((cell % width) as f64 + 0.5, (cell / width) as f64 + 0.5) * CELL_M;
                at.cmplt(low).any() || at.cmpgt(high).any()
            })
            .collect();
        let cell_of = |at: DVec3| {
            let offset = (at.truncate() - origin) / CELL_M;
            let inside =
                offset.cmpge(DVec2::ZERO).all() && offset.x < width as f64 && offset.y < height as f64;
            inside.then(|| offset.y as usize * width + offset.x as usize)
        };
        for index in 0..layout.placed.len() {
            for point in surface(layout, index, SPACING_M) {
                if (STEP_M..=HEIGHT_M).contains(&point.z) {
                    cell_of(point).into_iter().for_each(|cell| is_obstacle[cell] = true);
                }
            }
        }
        let squared = squared_distances(&is_obstacle, width);
        let least = (RADIUS_M / CELL_M).powi(2);
        let is_safe = |cell: usize| f64::from(squared[cell]) >= least;
        let mut starts = cameras.filter_map(|at| Some((cell_of(at).filter(|cell| is_safe(*cell))?, at)));
        let (first, at) =
            starts.next().ok_or_else(|| anyhow!("no camera stands where the robot has room"))?;
        let mut is_reached = vec![false; squared.len()];
        let mut open = vec![first];
        is_reached[first] = true;
        while let Some(cell) = open.pop() {
            for beside in [cell.wrapping_sub(1), cell + 1, cell.wrapping_sub(width), cell + width] {
                if beside < squared.len() && is_safe(beside) && !is_reached[beside] {
                    is_reached[beside] = true;
                    open.push(beside);
                }
            }
        }
        let start = at.with_z(0.0);
        Ok(Self { layout, solids: layout.solids(), origin, width, squared, is_reached, start })
    }

    /// Returns the clearance of a place, and whether the robot reaches it.
    pub(super) fn at(&self, place: DVec3) -> (f64, bool) {
        let offset = (place.truncate() - self.origin) / CELL_M;
        let cell = offset.y as usize * self.width + offset.x as usize;
        let clearance_m = self.squared.get(cell).map_or(0.0, |d2| f64::from(*d2).sqrt() * CELL_M);
        (clearance_m, self.is_reached.get(cell).copied().unwrap_or(false))
    }

    /// Returns whether the robot reaches a place from which the thing is shown.
    pub(super) fn is_reachable(&self, thing: usize) -> bool {
        let height = self.squared.len() / self.width;
        let mut has_surface = vec![false; self.squared.len()];
        for point in surface(self.layout, thing, SPACING_M) {
            let offset = (point.truncate() - self.origin) / CELL_M;
            let (x, y) = (offset.x as usize, offset.y as usize);
            if offset.cmpge(DVec2::ZERO).all() && x < self.width && y < height {
                has_surface[y * self.width + x] = true;
            }
        }
        let limit = (REACH_M / CELL_M).powi(2);
        let squared = squared_distances(&has_surface, self.width);
        let near =
            (0..squared.len()).filter(|cell| self.is_reached[*cell] && f64::from(squared[*cell]) <= limit);
        let places: Vec<usize> = near.collect();
        // Spread over all of them, not along the first side only.
        let step = places.len().div_ceil(MAX_PLACES).max(1);
        places.into_iter().step_by(step).any(|cell| {
            let at = self.origin
                + DVec2::new((cell % self.width) as f64 + 0.5, (cell / self.width) as f64 + 0.5) * CELL_M;
            self.shown(thing, at.extend(SENSOR_HEIGHT_M)) >= MIN_SHOWN
        })
    }

    /// Visible share of a thing's outline: what a sensor sees over what it would see without the other things.
    pub(super) fn shown(&self, thing: usize, sensor: DVec3) -> f64 {
        let towards = self.solids.things[thing].centre - sensor;
        let level = towards.with_z(0.0).length().max(0.05);
        // A camera that looks straight up has no right.
        let heading = towards.with_z(towards.z.clamp(-10.0 * level, 10.0 * level));
        let view = RasterView {
            camera_from_world: looking(sensor, heading),
            intrinsics: pinhole(PICTURE_PX, FIELD_OF_VIEW_RAD),
        };
        let photo = self.solids.photo(&view);
        let n = photo.thing_of_pixel.iter().filter(|of| usize::from(**of) == thing).count() as u32;
        if n < MIN_SHOWN_PX { 0.0 } else { f64::from(n) / f64::from(photo.unhidden_px[thing].max(1)) }
    }
}

fn surface(layout: &Layout, thing: usize, spacing_m: f64) -> impl Iterator<Item = DVec3> + '_ {
    let placed = &layout.placed[thing];
    let surfels = placed.object.parts.iter().flat_map(move |part| part.surfels(spacing_m));
    surfels.map(|surfel| placed.world_from_object.transform_point3(surfel.position))
}
