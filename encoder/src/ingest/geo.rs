//! Geo-reference of the world frame, from a JSON file.

use std::collections::HashMap;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde_json::Value;
use slag_common::files;
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
    #[error("{}: {source}", path.display())]
    Text {
        path: PathBuf,
        #[source]
        source: files::NotUtf8,
    },
    #[error("{}: origin.{field} = {value} is outside {min}..={max}; write degrees and metres of WGS 84", path.display())]
    Range { path: PathBuf, field: &'static str, value: f64, min: f64, max: f64 },
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

const MAX_BYTES: u64 = 1 << 20;

/// Reads `{"origin": {"lat": degrees, "lon": degrees, "alt": metres}}`; other fields are ignored.
pub fn read_geo_reference(path: &Path) -> Result<GeoReference, GeoError> {
    let mut bytes = Vec::new();
    files::open(path)?.take(MAX_BYTES).read_to_end(&mut bytes)?;
    let text = files::text_of(&bytes);
    let text = text.map_err(|source| GeoError::Text { path: path.to_owned(), source })?;
    let malformed = |source| GeoError::Json { path: path.to_owned(), source };
    // Maps first, since a struct would take `[8.5, 47.4, 400]`, whose order may be GeoJSON's; then structs, since a map
    // would take a name twice.
    let maps: HashMap<String, Value> = serde_json::from_str(text).map_err(malformed)?;
    if let Some(origin) = maps.get("origin") {
        HashMap::<String, Value>::deserialize(origin).map_err(malformed)?;
    }
    let GeoFile { origin } = serde_json::from_str(text).map_err(malformed)?;
    let range = |field: &'static str, value: f64, min: f64, max: f64| match (min..=max).contains(&value) {
        true => Ok(value),
        false => Err(GeoError::Range { path: path.to_owned(), field, value, min, max }),
    };
    // Heights range from the deepest trench to the edge of space.
    let latitude_deg = range("lat", origin.lat, -90.0, 90.0)?;
    let longitude_deg = range("lon", origin.lon, -180.0, 180.0)?;
    let origin =
        Geographic { latitude_deg, longitude_deg, height_m: range("alt", origin.alt, -12e3, 100e3)? };
    Ok(GeoReference { origin })
}
