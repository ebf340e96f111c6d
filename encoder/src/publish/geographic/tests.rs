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

/// Oracle: the ellipsoid's radii of curvature from its two defining constants. 100 m east subtend 100 / (N cos lat),
/// 100 m north 100 / M.
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
    assert!(coverage(&manifest).is_err_and(|e| e.contains("not geo-referenced")));
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
        let polygon: Polygon = feature.geometry.as_ref().unwrap().value.clone().try_into().unwrap();
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
    let refused = |manifest: &Manifest, lat, lon, h, what: &str| {
        assert!(centre(manifest, lat, lon, h).is_err_and(|e| e.contains(what)), "{what}");
    };
    refused(&manifest, 1.0, 1.0, None, "not geo-referenced");
    manifest.geo_reference = Some(at(46.842657, -91.994008, 158.5));
    let origin = centre(&manifest, 46.842657, -91.994008, None).expect("valid");
    assert!(origin.length() < 1e-6, "{origin}");
    let above = centre(&manifest, 46.842657, -91.994008, Some(168.5)).expect("valid");
    assert!((above - DVec3::Z * 10.0).length() < 1e-6, "{above}");
    refused(&manifest, -91.9, 46.8, None, "latitude -91.9");
    refused(&manifest, f64::NAN, 0.0, None, "latitude NaN");
    refused(&manifest, 0.0, 180.1, None, "longitude 180.1");
    refused(&manifest, 0.0, 0.0, Some(f64::INFINITY), "height inf");
}
