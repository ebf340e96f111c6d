//! Coordinate frames and the names of transforms between them.
//!
//! | frame | axes and origin | stored as |
//! |---|---|---|
//! | `world` | that of the input model; metres and z up if it is metric | f64 |
//! | `camera` | x right, y down, z forward (OpenCV, COLMAP) | f64, f32 after rebasing |
//! | `image` | pixels, origin at the top-left corner of the top-left pixel; the centre of pixel (i, j) is (i + 0.5, j + 0.5) | f32 |
//! | `shard` | world minus the shard's f64 origin | f32 |
//! | `enu` | metres east, north, up of a WGS 84 origin (REP-103/105) | f64 |
//! | `ecef` | metres, earth-centred, earth-fixed (WGS 84) | f64 |
//!
//! A transform is named `target_from_source`, so that adjacent names cancel:
//! `mean_in_camera = camera_from_world * mean_in_world`.

use glam::DVec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Semi-major axis of the WGS 84 ellipsoid (NIMA TR8350.2, table 3.1).
pub const WGS84_SEMI_MAJOR_M: f64 = 6_378_137.0;
/// Flattening of the WGS 84 ellipsoid (NIMA TR8350.2, table 3.1).
pub const WGS84_FLATTENING: f64 = 1.0 / 298.257_223_563;

/// A geographic position: WGS 84 latitude and longitude in degrees, height in metres.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Geographic {
    /// Latitude, degrees, north positive, within -90..=90.
    pub latitude_deg: f64,
    /// Longitude, degrees, east positive, within -180..=180.
    pub longitude_deg: f64,
    /// Height in metres, in the datum of the source; exact ECEF positions need ellipsoidal heights.
    pub height_m: f64,
}

impl Geographic {
    /// Returns the position in earth-centred, earth-fixed coordinates (closed form).
    pub fn to_ecef_m(self) -> DVec3 {
        let (sin_lat, cos_lat) = self.latitude_deg.to_radians().sin_cos();
        let (sin_lon, cos_lon) = self.longitude_deg.to_radians().sin_cos();
        let e2 = WGS84_FLATTENING * (2.0 - WGS84_FLATTENING);
        let prime_vertical_m = WGS84_SEMI_MAJOR_M / (1.0 - e2 * sin_lat * sin_lat).sqrt();
        DVec3::new(
            (prime_vertical_m + self.height_m) * cos_lat * cos_lon,
            (prime_vertical_m + self.height_m) * cos_lat * sin_lon,
            (prime_vertical_m * (1.0 - e2) + self.height_m) * sin_lat,
        )
    }

    /// Returns the geographic position of an ECEF point, by Bowring's formula iterated until the latitude is
    /// constant (two or three rounds; accurate to well below a millimetre).
    pub fn from_ecef_m(ecef_m: DVec3) -> Self {
        let e2 = WGS84_FLATTENING * (2.0 - WGS84_FLATTENING);
        let p = ecef_m.x.hypot(ecef_m.y);
        let mut lat = ecef_m.z.atan2(p * (1.0 - e2));
        for _ in 0..8 {
            let sin_lat = lat.sin();
            let n = WGS84_SEMI_MAJOR_M / (1.0 - e2 * sin_lat * sin_lat).sqrt();
            let next = (ecef_m.z + e2 * n * sin_lat).atan2(p);
            let moved = (next - lat).abs();
            lat = next;
            if moved < 1e-15 {
                break;
            }
        }
        let (sin_lat, cos_lat) = lat.sin_cos();
        let n = WGS84_SEMI_MAJOR_M / (1.0 - e2 * sin_lat * sin_lat).sqrt();
        // The height along the normal is well conditioned at the poles, where p / cos(lat) is 0/0.
        let height_m = p * cos_lat + ecef_m.z * sin_lat - n * (1.0 - e2 * sin_lat * sin_lat);
        Self {
            latitude_deg: lat.to_degrees(),
            longitude_deg: ecef_m.y.atan2(ecef_m.x).to_degrees(),
            height_m,
        }
    }
}

/// The position of the `world` frame on the earth: `world` is east-north-up at this origin.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct GeoReference {
    /// The origin of the world frame.
    pub origin: Geographic,
}

impl GeoReference {
    /// Returns the unit axes east, north, up at the origin, in ECEF.
    fn axes_in_ecef(&self) -> [DVec3; 3] {
        let (sin_lat, cos_lat) = self.origin.latitude_deg.to_radians().sin_cos();
        let (sin_lon, cos_lon) = self.origin.longitude_deg.to_radians().sin_cos();
        [
            DVec3::new(-sin_lon, cos_lon, 0.0),
            DVec3::new(-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat),
            DVec3::new(cos_lat * cos_lon, cos_lat * sin_lon, sin_lat),
        ]
    }

    /// Returns the position in the world frame (ENU), metres.
    pub fn world_from_geographic(&self, position: Geographic) -> DVec3 {
        let offset = position.to_ecef_m() - self.origin.to_ecef_m();
        let [east, north, up] = self.axes_in_ecef();
        DVec3::new(east.dot(offset), north.dot(offset), up.dot(offset))
    }

    pub fn geographic_from_world(&self, position_in_world: DVec3) -> Geographic {
        let [east, north, up] = self.axes_in_ecef();
        Geographic::from_ecef_m(
            self.origin.to_ecef_m()
                + east * position_in_world.x
                + north * position_in_world.y
                + up * position_in_world.z,
        )
    }
}

/// An axis-aligned box in the world frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Aabb {
    /// Smallest corner.
    #[schemars(with = "[f64; 3]")]
    pub min: DVec3,
    /// Largest corner.
    #[schemars(with = "[f64; 3]")]
    pub max: DVec3,
}

impl Aabb {
    /// The empty box: extending it by a point gives that point.
    pub const EMPTY: Self = Self { min: DVec3::INFINITY, max: DVec3::NEG_INFINITY };

    pub fn extend_ball(&mut self, centre: DVec3, radius: f64) {
        self.min = self.min.min(centre - DVec3::splat(radius));
        self.max = self.max.max(centre + DVec3::splat(radius));
    }

    pub fn union(self, other: Self) -> Self {
        Self { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    /// Returns whether a point lies inside, borders included.
    pub fn contains(&self, point: DVec3) -> bool {
        point.cmpge(self.min).all() && point.cmple(self.max).all()
    }

    /// Returns whether the boxes have a common point, borders included.
    pub fn touches(&self, other: &Self) -> bool {
        self.min.cmple(other.max).all() && other.min.cmple(self.max).all()
    }

    /// Returns the distance from a point to the box; 0 inside.
    pub fn distance_to(&self, point: DVec3) -> f64 {
        (self.min - point).max(point - self.max).max(DVec3::ZERO).length()
    }

    pub fn centre(&self) -> DVec3 {
        (self.min + self.max) * 0.5
    }

    pub fn size(&self) -> DVec3 {
        self.max - self.min
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: published coordinates (the ellipsoid's axes), and a 1-degree meridian arc at the
    /// equator, 110,574 m (NIMA TR8350.2).
    #[test]
    fn ecef_of_known_places() {
        let at = |lat, lon, h| Geographic { latitude_deg: lat, longitude_deg: lon, height_m: h }.to_ecef_m();
        assert!((at(0.0, 0.0, 0.0) - DVec3::new(6_378_137.0, 0.0, 0.0)).length() < 1e-6);
        assert!((at(90.0, 0.0, 0.0) - DVec3::new(0.0, 0.0, 6_356_752.314_245)).length() < 1e-3);
        let geo =
            GeoReference { origin: Geographic { latitude_deg: 0.0, longitude_deg: 0.0, height_m: 0.0 } };
        let north =
            geo.world_from_geographic(Geographic { latitude_deg: 1.0, longitude_deg: 0.0, height_m: 0.0 });
        assert!((north.y.hypot(north.z) - 110_574.0).abs() < 10.0, "{north}");
    }

    #[test]
    fn geographic_round_trip_is_below_a_micrometre() {
        for (lat, lon) in [(46.842657, -91.994008), (0.0, 180.0), (-89.9999, 12.0), (90.0, 0.0)] {
            let geo = GeoReference {
                origin: Geographic { latitude_deg: lat, longitude_deg: lon, height_m: 158.5 },
            };
            for p in [DVec3::ZERO, DVec3::new(100.0, -250.0, 30.0), DVec3::new(-5e3, 8e3, -100.0)] {
                let back = geo.world_from_geographic(geo.geographic_from_world(p));
                assert!((back - p).length() < 1e-6, "{lat} {lon} {p} {back}");
            }
        }
    }
}
