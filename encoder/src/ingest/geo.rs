//! Geo-reference of the world frame, from a JSON file.

use std::collections::HashMap;
use std::io;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde::de::Error;
use serde_json::Value;
use slag_common::frames::{GeoReference, Geographic};

#[derive(Debug, thiserror::Error)]
pub enum GeoError {
    #[error("{0}; check that the file exists and may be read")]
    Io(#[from] io::Error),
    #[error(r#"{}: {source}; expected {{"origin": {{"lat": DEGREES, "lon": DEGREES, "alt": METRES}}}}"#, path.display())]
    Json {
        path: PathBuf,
        #[source]
        source: serde_json::Error,
    },
    #[error("{}: origin.{field} = {value} is outside {min}..={max}; write degrees and metres of WGS 84", path.display())]
    Range { path: PathBuf, field: &'static str, value: f64, min: f64, max: f64 },
}

/// A map, since a struct would take `[8.5, 47.4, 400]`, whose order may be GeoJSON's.
#[derive(Deserialize)]
struct GeoFile {
    origin: HashMap<String, Value>,
}

/// Reads `{"origin": {"lat": degrees, "lon": degrees, "alt": metres}}`; other fields are ignored.
pub fn read_geo_reference(path: &Path) -> Result<GeoReference, GeoError> {
    let bytes = fs_err::read(path)?;
    let malformed = |source| GeoError::Json { path: path.to_owned(), source };
    // A map first, for the same reason as above.
    let file: HashMap<String, Value> = serde_json::from_slice(&bytes).map_err(malformed)?;
    let file = GeoFile::deserialize(Value::from_iter(file)).map_err(malformed)?;
    let field = |field: &'static str, min: f64, max: f64| {
        let value = file.origin.get(field).and_then(Value::as_f64);
        let value = value.ok_or_else(|| malformed(Error::missing_field(field)))?;
        match (min..=max).contains(&value) {
            true => Ok(value),
            false => Err(GeoError::Range { path: path.to_owned(), field, value, min, max }),
        }
    };
    // The range of heights is from the deepest trench to the edge of space.
    let (latitude_deg, longitude_deg) = (field("lat", -90.0, 90.0)?, field("lon", -180.0, 180.0)?);
    let origin = Geographic { latitude_deg, longitude_deg, height_m: field("alt", -12e3, 100e3)? };
    Ok(GeoReference { origin })
}
