//! Geo-reference of the world frame, from a JSON file.

use std::io;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use slag_common::frames::{GeoReference, Geographic};

/// Reason why a geo-reference cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum GeoError {
    /// The file cannot be read; the message contains its path.
    #[error("{0}; check that the file exists and may be read")]
    Io(#[from] io::Error),
    /// The file is not JSON of the expected form.
    #[error(r#"{}: {source}; expected {{"origin": {{"lat": DEGREES, "lon": DEGREES, "alt": METRES}}}}"#, path.display())]
    Json {
        /// The file.
        path: PathBuf,
        /// Line, column and reason.
        #[source]
        source: serde_json::Error,
    },
    /// A coordinate is out of range.
    #[error("{}: origin.{field} = {value} is outside {min}..={max}; write degrees and metres of WGS 84", path.display())]
    Range {
        /// The file.
        path: PathBuf,
        /// `lat`, `lon` or `alt`.
        field: &'static str,
        /// The value found.
        value: f64,
        /// Smallest valid value.
        min: f64,
        /// Largest valid value.
        max: f64,
    },
}

#[derive(Deserialize)]
struct GeoFile {
    origin: Origin,
}

#[derive(Deserialize)]
struct Origin {
    lat: f64,
    lon: f64,
    alt: f64,
}

/// Reads `{"origin": {"lat": degrees, "lon": degrees, "alt": metres}}`; other fields are ignored.
///
/// # Errors
/// [`GeoError`] if the file cannot be read, is malformed, or contains a coordinate out of range.
pub fn read_geo_reference(path: &Path) -> Result<GeoReference, GeoError> {
    let bytes = fs_err::read(path)?;
    let GeoFile { origin } =
        serde_json::from_slice(&bytes).map_err(|source| GeoError::Json { path: path.to_owned(), source })?;
    // The range of heights is from the deepest trench to the edge of space.
    let ranges = [
        ("lat", origin.lat, -90.0, 90.0),
        ("lon", origin.lon, -180.0, 180.0),
        ("alt", origin.alt, -12e3, 100e3),
    ];
    for (field, value, min, max) in ranges {
        if !(min..=max).contains(&value) {
            return Err(GeoError::Range { path: path.to_owned(), field, value, min, max });
        }
    }
    Ok(GeoReference {
        origin: Geographic { latitude_deg: origin.lat, longitude_deg: origin.lon, height_m: origin.alt },
    })
}
