//! A scene on the earth: footprints of its cells in longitude and latitude (GeoJSON, RFC 7946), and
//! geographic positions in the world frame.

use geo::{ConvexHull, Coord, GeodesicArea, LineString, MultiPoint, MultiPolygon, Point, Polygon};
use geojson::{Feature, FeatureCollection, Geometry, GeometryValue, JsonObject, feature::Id};
use glam::DVec3;
use serde_json::json;
use slag_common::frames::{Aabb, GeoReference, Geographic};
use slag_common::manifest::Manifest;

/// Why a scene cannot be placed on the earth.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum GeographicError {
    #[error(
        "the scene is not geo-referenced; ask in the world frame (x, y, z), or encode it with a geo-reference"
    )]
    NotGeoReferenced,
    #[error("latitude {found_deg} is not within -90..=90 degrees; check the order of lat and lon")]
    Latitude { found_deg: f64 },
    #[error("longitude {found_deg} is not within -180..=180 degrees")]
    Longitude { found_deg: f64 },
    #[error("height {found_m} is not a finite number of metres")]
    Height { found_m: f64 },
}

fn reference_of(manifest: &Manifest) -> Result<&GeoReference, GeographicError> {
    manifest.geo_reference.as_ref().ok_or(GeographicError::NotGeoReferenced)
}

/// Returns a geographic position in the world frame, metres. Without a height, the position has the height
/// of the world frame's origin.
pub fn world_from_geographic(
    manifest: &Manifest,
    latitude_deg: f64,
    longitude_deg: f64,
    height_m: Option<f64>,
) -> Result<DVec3, GeographicError> {
    let reference = reference_of(manifest)?;
    if !(-90.0..=90.0).contains(&latitude_deg) {
        return Err(GeographicError::Latitude { found_deg: latitude_deg });
    }
    if !(-180.0..=180.0).contains(&longitude_deg) {
        return Err(GeographicError::Longitude { found_deg: longitude_deg });
    }
    let height_m = height_m.unwrap_or(reference.origin.height_m);
    if !height_m.is_finite() {
        return Err(GeographicError::Height { found_m: height_m });
    }
    Ok(reference.world_from_geographic(Geographic { latitude_deg, longitude_deg, height_m }))
}

/// A piece of the earth's surface.
#[derive(Clone, Debug, PartialEq)]
pub struct Footprint {
    /// Degrees of longitude and latitude. Rings are closed and counter-clockwise. A shape across the
    /// antimeridian is cut in two (RFC 7946, 3.1.9); a shape around a pole becomes the band of latitudes
    /// that covers it.
    pub polygons: MultiPolygon,
    /// Geodesic area on the WGS 84 ellipsoid.
    pub area_m2: f64,
}

/// Returns the footprint of a box, at half its height.
pub fn footprint(bounds: &Aabb, reference: &GeoReference) -> Footprint {
    Footprint::of_ring(&rectangle(bounds), bounds.centre().z, reference)
}

/// Returns the convex hull of all cells' rectangles; empty without cells.
pub fn outline(manifest: &Manifest, reference: &GeoReference) -> Footprint {
    let corners = manifest.cells.iter().flat_map(|cell| rectangle(&cell.bounds)).map(Point::from);
    let hull = MultiPoint::from_iter(corners).convex_hull();
    let heights = manifest.cells.iter().map(|cell| cell.bounds.centre().z);
    let mean_height = heights.sum::<f64>() / manifest.cells.len().max(1) as f64;
    // A ring repeats its first corner at the end.
    let corners = hull.exterior().0.split_last().map_or(&[][..], |(_, corners)| corners);
    Footprint::of_ring(corners, mean_height, reference)
}

/// Returns the corners of a box seen from above, counter-clockwise, world frame.
fn rectangle(bounds: &Aabb) -> [Coord; 4] {
    let (min, max) = (bounds.min, bounds.max);
    [(min.x, min.y), (max.x, min.y), (max.x, max.y), (min.x, max.y)].map(Coord::from)
}

impl Footprint {
    /// Projects a counter-clockwise ring (not closed) at height `z` of the world frame.
    fn of_ring(ring_in_world: &[Coord], z: f64, reference: &GeoReference) -> Self {
        let mut ring: Vec<Coord> = Vec::with_capacity(ring_in_world.len());
        for corner in ring_in_world {
            let place = reference.geographic_from_world(DVec3::new(corner.x, corner.y, z));
            // Longitudes continue past 180, so that neighbours on the ground are neighbours in degrees.
            let near = ring.last().map_or(place.longitude_deg, |last| last.x);
            ring.push(Coord { x: nearest_turn(place.longitude_deg, near), y: place.latitude_deg });
        }
        // The area of the uncut ring: the parallel that bounds a band is not a geodesic.
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

/// Returns the longitude plus the whole turns that bring it nearest to another.
fn nearest_turn(longitude_deg: f64, near_deg: f64) -> f64 {
    longitude_deg + 360.0 * ((near_deg - longitude_deg) / 360.0).round()
}

/// Returns the part of a convex ring with `side * longitude <= 180` (Sutherland and Hodgman 1974).
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

/// Returns the band of latitudes from a ring's corner nearest to the equator to the enclosed pole.
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

/// Returns the footprints of a scene's cells as GeoJSON: one feature a cell, with `cell_id`,
/// `n_gaussians` and `area_m2` (geodesic, on the WGS 84 ellipsoid).
///
/// The foreign member `scene` has the name, the generation, and the convex `outline` of all cells.
pub fn coverage(manifest: &Manifest) -> Result<FeatureCollection, GeographicError> {
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
mod tests {
    use super::*;
    use crate::store::tests::manifest_of_boxes;

    fn at(latitude_deg: f64, longitude_deg: f64, height_m: f64) -> GeoReference {
        GeoReference { origin: Geographic { latitude_deg, longitude_deg, height_m } }
    }

    fn bounds(min: [f64; 3], max: [f64; 3]) -> Aabb {
        Aabb { min: min.into(), max: max.into() }
    }

    /// Twice the signed area of a closed ring (shoelace); positive is counter-clockwise.
    fn signed_area(ring: &LineString) -> f64 {
        ring.0.windows(2).map(|w| w[0].x * w[1].y - w[1].x * w[0].y).sum()
    }

    fn assert_rings(polygons: &MultiPolygon, what: &str) {
        for polygon in polygons {
            let ring = polygon.exterior();
            assert!(ring.0.len() >= 4 && ring.0.first() == ring.0.last(), "{what}: closed");
            assert!(signed_area(ring) > 0.0, "{what}: counter-clockwise");
            assert!(ring.0.iter().all(|c| c.x.abs() <= 180.0 && c.y.abs() <= 90.0), "{what}: {ring:?}");
        }
    }

    /// Oracle: the ellipsoid's radii of curvature from its two defining constants. 100 m east subtend
    /// 100 / (N cos lat), 100 m north 100 / M.
    #[test]
    fn footprint_agrees_with_the_radii_of_curvature() {
        let e2 = (2.0 - 1.0 / 298.257223563) / 298.257223563;
        for (lat, lon) in [(0.0f64, 0.0), (46.842657, -91.994008), (-33.0, 151.0), (70.0, 20.0)] {
            let w2 = 1.0 - e2 * lat.to_radians().sin().powi(2);
            let n_m = 6_378_137.0 / w2.sqrt();
            let m_m = 6_378_137.0 * (1.0 - e2) / w2.powf(1.5);
            let shape = footprint(&bounds([0.0; 3], [100.0, 100.0, 0.0]), &at(lat, lon, 0.0));
            let ring = &shape.polygons.0[0].exterior().0;
            let east_deg = (100.0 / (n_m * lat.to_radians().cos())).to_degrees();
            let north_deg = (100.0 / m_m).to_degrees();
            assert!((ring[0].x - lon).abs() < 1e-9 && (ring[0].y - lat).abs() < 1e-9);
            assert!((ring[1].x - lon - east_deg).abs() < 1e-8, "{lat}: {} {east_deg}", ring[1].x - lon);
            assert!((ring[3].y - lat - north_deg).abs() < 1e-8, "{lat}: {} {north_deg}", ring[3].y - lat);
        }
    }

    #[test]
    fn geodesic_area_is_the_planar_one() {
        for lat in [-80.0, -45.0, 0.0, 10.0, 46.8, 89.0] {
            for (size, height_m) in [(25.0, 158.5), (1000.0, -100.0), (5000.0, 0.0)] {
                let b = bounds([-30.0, 40.0, -2.0], [-30.0 + size, 40.0 + size / 2.0, 10.0]);
                let footprint = footprint(&b, &at(lat, 30.0, height_m));
                assert_rings(&footprint.polygons, "cell");
                let ratio = footprint.area_m2 / (size * size / 2.0);
                assert!((ratio - 1.0).abs() < 1e-3, "{lat} {size}: {ratio}");
            }
        }
    }

    #[test]
    fn antimeridian_and_pole() {
        for lon in [179.9999, -179.9999, 180.0, -180.0] {
            let cell = bounds([-40.0, -20.0, 0.0], [60.0, 30.0, 5.0]);
            let Footprint { polygons, area_m2 } = footprint(&cell, &at(-17.0, lon, 0.0));
            assert_eq!(polygons.0.len(), 2, "{lon}");
            assert_rings(&polygons, "antimeridian");
            for area_m2 in [area_m2, polygons.geodesic_area_unsigned()] {
                assert!((area_m2 / 5000.0 - 1.0).abs() < 1e-3, "{lon}: {area_m2}");
            }
        }
        for lat in [90.0, -90.0] {
            let cell = bounds([-10.0, -10.0, 0.0], [10.0, 10.0, 5.0]);
            let Footprint { polygons, area_m2 } = footprint(&cell, &at(lat, 12.0, 0.0));
            assert_rings(&polygons, "pole");
            assert!((area_m2 / 400.0 - 1.0).abs() < 1e-3, "{lat}: {area_m2}");
            // The band reaches the corners, sqrt(200) m from the pole; a = 6,399,594 m there (a^2 / b).
            let edge_deg = polygons.0[0].exterior().0.iter().map(|c| c.y.abs()).fold(90.0, f64::min);
            assert!((90.0 - edge_deg - (200f64.sqrt() / 6_399_594.0).to_degrees()).abs() < 1e-9);
        }
    }

    #[test]
    fn coverage_is_valid_geojson() {
        let boxes = [
            bounds([0.0, 0.0, 0.0], [20.0, 10.0, 5.0]),
            bounds([20.0, 0.0, 0.0], [40.0, 10.0, 5.0]),
            bounds([3.0, 3.0, 3.0], [3.0, 3.0, 3.0]),
        ];
        let mut manifest = manifest_of_boxes(&boxes);
        assert_eq!(coverage(&manifest), Err(GeographicError::NotGeoReferenced));
        manifest.geo_reference = Some(at(46.842657, -91.994008, 158.5));
        let text = coverage(&manifest).expect("geo-referenced").to_string();
        let back: FeatureCollection = text.parse().expect("GeoJSON");
        assert_eq!(back.features.len(), 3);
        for (cell, feature) in manifest.cells.iter().zip(&back.features) {
            assert_eq!(feature.property("cell_id"), Some(&json!(cell.cell_id)));
            assert_eq!(feature.property("n_gaussians"), Some(&json!(cell.n_gaussians)));
            let size = cell.bounds.size();
            let area_m2 = feature.property("area_m2").and_then(|v| v.as_f64()).expect("a number");
            assert!((area_m2 - size.x * size.y).abs() <= 1e-3 * size.x * size.y + 1e-6, "{area_m2}");
            let polygon: Polygon =
                feature.geometry.as_ref().expect("there").value.clone().try_into().expect("one polygon");
            assert_eq!(polygon.exterior().0.len(), 5, "closed, even around nothing");
        }
        let value: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        let area_m2 = value["scene"]["area_m2"].as_f64().expect("a number");
        assert!((area_m2 / 400.0 - 1.0).abs() < 1e-3, "hull of both cells: {area_m2}");
        assert!(coverage(&Manifest { cells: vec![], ..manifest }).is_ok());
    }

    #[test]
    fn selections_are_checked() {
        let mut manifest = manifest_of_boxes(&[]);
        let centre = |manifest: &Manifest, lat, lon, h| world_from_geographic(manifest, lat, lon, h);
        assert_eq!(centre(&manifest, 1.0, 1.0, None), Err(GeographicError::NotGeoReferenced));
        manifest.geo_reference = Some(at(46.842657, -91.994008, 158.5));
        let origin = centre(&manifest, 46.842657, -91.994008, None).expect("valid");
        assert!(origin.length() < 1e-6, "{origin}");
        let above = centre(&manifest, 46.842657, -91.994008, Some(168.5)).expect("valid");
        assert!((above - DVec3::Z * 10.0).length() < 1e-6, "{above}");
        assert!(matches!(centre(&manifest, -91.9, 46.8, None), Err(GeographicError::Latitude { .. })));
        assert!(matches!(centre(&manifest, f64::NAN, 0.0, None), Err(GeographicError::Latitude { .. })));
        assert!(matches!(centre(&manifest, 0.0, 180.1, None), Err(GeographicError::Longitude { .. })));
        let infinite = centre(&manifest, 0.0, 0.0, Some(f64::INFINITY));
        assert!(matches!(infinite, Err(GeographicError::Height { .. })));
    }
}
