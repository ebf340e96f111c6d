//! A scene on the earth: footprints of its cells in longitude and latitude (GeoJSON, RFC 7946), and
//! geographic positions in the world frame.

use geo::{ConvexHull, Coord, GeodesicArea, LineString, MultiPoint, MultiPolygon, Point, Polygon};
use geojson::{Feature, FeatureCollection, Geometry, GeometryValue, JsonObject, feature::Id};
use glam::DVec3;
use serde_json::json;
use slag_common::frames::{Aabb, GeoReference, Geographic};
use slag_common::manifest::Manifest;

/// Fault of a request for places on the earth, for people.
type Refusal = String;

fn reference_of(manifest: &Manifest) -> Result<&GeoReference, Refusal> {
    manifest.geo_reference.as_ref().ok_or_else(|| {
        "the scene is not geo-referenced; ask in the world frame (x, y, z), or encode it with a geo-reference"
            .into()
    })
}

/// A geographic position in the world frame, metres. Without a height, that of the world frame's origin.
pub(crate) fn world_from_geographic(
    manifest: &Manifest,
    latitude_deg: f64,
    longitude_deg: f64,
    height_m: Option<f64>,
) -> Result<DVec3, Refusal> {
    let reference = reference_of(manifest)?;
    if !(-90.0..=90.0).contains(&latitude_deg) {
        return Err(format!(
            "latitude {latitude_deg} is not within -90..=90 degrees; check the order of lat and lon"
        ));
    }
    if !(-180.0..=180.0).contains(&longitude_deg) {
        return Err(format!("longitude {longitude_deg} is not within -180..=180 degrees"));
    }
    let height_m = height_m.unwrap_or(reference.origin.height_m);
    if !height_m.is_finite() {
        return Err(format!("height {height_m} is not a finite number of metres"));
    }
    Ok(reference.world_from_geographic(Geographic { latitude_deg, longitude_deg, height_m }))
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Footprint {
    /// Degrees of longitude and latitude. Rings are closed and counter-clockwise. A shape across the antimeridian is
    /// cut in two (RFC 7946, 3.1.9); one around a pole becomes the band of latitudes that covers it.
    pub polygons: MultiPolygon,
    /// Geodesic area on the WGS 84 ellipsoid.
    pub(crate) area_m2: f64,
}

/// Footprint of a box, at half its height.
pub(crate) fn footprint(bounds: &Aabb, reference: &GeoReference) -> Footprint {
    Footprint::of_ring(&rectangle(bounds), bounds.centre().z, reference)
}

/// Convex hull of all cells' rectangles; empty without cells.
pub fn outline(manifest: &Manifest, reference: &GeoReference) -> Footprint {
    let corners = manifest.cells.iter().flat_map(|cell| rectangle(&cell.bounds)).map(Point::from);
    let hull = MultiPoint::from_iter(corners).convex_hull();
    let heights = manifest.cells.iter().map(|cell| cell.bounds.centre().z);
    let mean_height = heights.sum::<f64>() / manifest.cells.len().max(1) as f64;
    // A ring repeats its first corner at the end.
    let corners = hull.exterior().0.split_last().map_or(&[][..], |(_, corners)| corners);
    Footprint::of_ring(corners, mean_height, reference)
}

/// Corners of a box seen from above, counter-clockwise, world frame.
fn rectangle(bounds: &Aabb) -> [Coord; 4] {
    let (min, max) = (bounds.min, bounds.max);
    [(min.x, min.y), (max.x, min.y), (max.x, max.y), (min.x, max.y)].map(Coord::from)
}

impl Footprint {
    /// Takes a counter-clockwise open ring at height `z` of the world frame.
    fn of_ring(ring_in_world: &[Coord], z: f64, reference: &GeoReference) -> Self {
        let mut ring: Vec<Coord> = Vec::with_capacity(ring_in_world.len());
        for corner in ring_in_world {
            let place = reference.geographic_from_world(DVec3::new(corner.x, corner.y, z));
            // Longitudes continue past 180, so that neighbours on the ground are neighbours in degrees.
            let near = ring.last().map_or(place.longitude_deg, |last| last.x);
            ring.push(Coord { x: nearest_turn(place.longitude_deg, near), y: place.latitude_deg });
        }
        // Of the uncut ring: the parallel that bounds a band is no geodesic.
        let area_m2 = closed(ring.clone()).geodesic_area_unsigned();
        Self { polygons: MultiPolygon(polygons(ring)), area_m2 }
    }
}

/// Cuts a ring with longitudes beyond 180 into polygons within -180..=180.
fn polygons(ring: Vec<Coord>) -> Vec<Polygon> {
    let (Some(first), Some(last)) = (ring.first(), ring.last()) else { return vec![] };
    if (nearest_turn(first.x, last.x) - first.x).abs() > 180.0 {
        return vec![polar_band(&ring)];
    }
    if ring.iter().all(|corner| corner.x.abs() <= 180.0) {
        return vec![closed(ring)];
    }
    let parts = [-360.0, 0.0, 360.0].map(|turn| {
        let shifted = ring.iter().map(|corner| Coord { x: corner.x + turn, y: corner.y }).collect();
        clip(clip(shifted, 1.0), -1.0)
    });
    parts.into_iter().filter(|part| part.len() > 2).map(closed).collect()
}

/// Adds the whole turns that bring a longitude nearest to another.
fn nearest_turn(longitude_deg: f64, near_deg: f64) -> f64 {
    longitude_deg + 360.0 * ((near_deg - longitude_deg) / 360.0).round()
}

/// Part of a convex ring with `side * longitude <= 180` (Sutherland and Hodgman 1974).
fn clip(ring: Vec<Coord>, side: f64) -> Vec<Coord> {
    let mut kept = Vec::with_capacity(ring.len() + 2);
    for (i, &to) in ring.iter().enumerate() {
        let from = ring[(i + ring.len() - 1) % ring.len()];
        let (from_over, to_over) = (side * from.x - 180.0, side * to.x - 180.0);
        if from_over * to_over < 0.0 {
            let share = from_over / (from_over - to_over);
            kept.push(Coord { x: side * 180.0, y: from.y + share * (to.y - from.y) });
        }
        if to_over <= 0.0 {
            kept.push(to);
        }
    }
    kept
}

/// Latitudes from a ring's corner nearest to the equator up to the enclosed pole.
fn polar_band(ring: &[Coord]) -> Polygon {
    let nearest = ring.iter().map(|corner| corner.y.abs()).fold(90.0, f64::min);
    let north = ring[0].y > 0.0;
    let (south_deg, north_deg) = if north { (nearest, 90.0) } else { (-90.0, -nearest) };
    let corners = [(-180.0, south_deg), (180.0, south_deg), (180.0, north_deg), (-180.0, north_deg)];
    closed(corners.map(Coord::from).into())
}

fn closed(ring: Vec<Coord>) -> Polygon {
    // `Polygon::new` repeats the first corner at the end, except in a ring of equal corners.
    let mut ring = LineString(ring);
    if ring.0.len() > 1 && ring.0.first() == ring.0.last() {
        ring.0.push(ring.0[0]);
    }
    Polygon::new(ring, vec![])
}

/// Footprints of a scene's cells as GeoJSON: one feature per cell, with `cell_id`, `n_gaussians` and `area_m2`
/// (geodesic, WGS 84). The foreign member `scene` has the name, the generation, and the convex `outline` of all cells.
pub fn coverage(manifest: &Manifest) -> Result<FeatureCollection, Refusal> {
    let reference = reference_of(manifest)?;
    let features = manifest.cells.iter().map(|cell| {
        let footprint = footprint(&cell.bounds, reference);
        let properties = json!({
            "cell_id": cell.cell_id,
            "n_gaussians": cell.n_gaussians,
            "area_m2": footprint.area_m2,
        });
        Feature {
            bbox: None,
            geometry: Some(geometry(&footprint.polygons)),
            id: Some(Id::Number(cell.cell_id.into())),
            properties: properties.as_object().cloned(),
            foreign_members: None,
        }
    });
    let features = features.collect();
    let outline = outline(manifest, reference);
    let scene = json!({
        "name": manifest.scene,
        "generation": manifest.generation,
        "outline": geometry(&outline.polygons),
        "area_m2": outline.area_m2,
    });
    let foreign_members = Some(JsonObject::from_iter([("scene".to_owned(), scene)]));
    Ok(FeatureCollection { bbox: None, features, foreign_members })
}

fn geometry(polygons: &MultiPolygon) -> Geometry {
    Geometry::new(match &polygons.0[..] {
        [one] => GeometryValue::from(one),
        _ => GeometryValue::from(polygons),
    })
}

#[cfg(test)]
mod tests;
