//! A page of objects as JSON, as a table for spreadsheets (CSV, RFC 4180), or for maps (GeoJSON, RFC 7946).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use slag_api::objects::{ObjectOnBoard, ObjectPage};
use slag_common::manifest::Manifest;

use super::request::RequestError;

/// Format of a list of objects.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ListFormat {
    /// One object.
    #[default]
    Json,
    /// A line for each object, under a header.
    Csv,
    /// A point for each object; of scenes with a place on the earth.
    Geojson,
}

/// Table header. Names best first, with confidences; positions and lengths in the scene's unit.
const COLUMNS: &str = "id,name,confidence,name_2,confidence_2,name_3,confidence_3,x,y,z,latitude_deg,longitude_deg,height_m,size_x,size_y,size_z,n_gaussians,photo";
const N_NAMES: usize = 3;

impl ListFormat {
    pub fn media_type(self) -> &'static str {
        match self {
            Self::Json => "application/json",
            Self::Csv => "text/csv",
            Self::Geojson => "application/geo+json",
        }
    }

    /// Returns an error if the format cannot describe the scene's objects.
    pub fn check(self, manifest: &Manifest) -> Result<(), RequestError> {
        if self == Self::Geojson && manifest.geo_reference.is_none() {
            let expected = "json or csv, because the scene has no place on the earth";
            return Err(RequestError::new("format", "geojson", expected));
        }
        Ok(())
    }

    pub fn write(self, page: &ObjectPage) -> serde_json::Result<Vec<u8>> {
        match self {
            Self::Json => serde_json::to_vec(page),
            Self::Csv => Ok(csv(page).into_bytes()),
            Self::Geojson => serde_json::to_vec(&geojson(page)),
        }
    }
}

fn csv(page: &ObjectPage) -> String {
    let mut text = format!("{COLUMNS}\r\n");
    for object in &page.objects {
        let mut cells = vec![object.id.clone()];
        for at in 0..N_NAMES {
            let name = object.names.get(at);
            cells.push(name.map_or_else(String::new, |name| quoted(&name.name)));
            cells.push(name.map_or_else(String::new, |name| name.confidence.to_string()));
        }
        let numbers = |numbers: [f64; 3]| numbers.map(|number| number.to_string());
        cells.extend(numbers(object.position_in_world.to_array()));
        cells.extend(object.geographic.map_or_else(Default::default, |place| {
            numbers([place.latitude_deg, place.longitude_deg, place.height_m])
        }));
        cells.extend(numbers((object.box_max_in_world - object.box_min_in_world).to_array()));
        cells.extend([object.n_gaussians.to_string(), quoted(&object.evidence.photo)]);
        text += &cells.join(",");
        text += "\r\n";
    }
    text
}

fn quoted(text: &str) -> String {
    match text.contains([',', '"', '\r', '\n']) {
        true => format!("\"{}\"", text.replace('"', "\"\"")),
        false => text.to_owned(),
    }
}

fn geojson(page: &ObjectPage) -> Value {
    let feature = |object: &ObjectOnBoard| {
        let place = object.geographic?;
        let ObjectOnBoard { id, names, position_in_world, n_gaussians, evidence, .. } = object;
        Some(json!({
            "type": "Feature",
            "id": id,
            "geometry": {
                "type": "Point", "coordinates": [place.longitude_deg, place.latitude_deg, place.height_m],
            },
            "properties": {
                "name": names.first().map(|name| &name.name), "names": names,
                "position_in_world": position_in_world,
                "size": object.box_max_in_world - object.box_min_in_world,
                "n_gaussians": n_gaussians, "evidence": evidence,
            },
        }))
    };
    let features: Vec<Value> = page.objects.iter().filter_map(feature).collect();
    let ObjectPage { scene, generation, next_after, coverage, .. } = page;
    json!({
        "type": "FeatureCollection", "scene": scene, "generation": generation, "next_after": next_after,
        "area_fetched": coverage.area_fetched, "bad_cells": coverage.bad_cells, "features": features,
    })
}
