use axum::extract::Path;
use serde::{Deserialize, Serialize};

use super::*;
use crate::params::Params;
use crate::problem::{NoMembers, Problem};
use crate::replies::Binary;
use crate::routes::{Parameter, Routes};

/// How it is placed.
#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
enum Place {
    /// Rests on something.
    OnTop,
    /// Stands alone.
    Alone,
}

/// A thing.
#[derive(Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct Thing {
    /// Its name,
    /// on two lines.
    #[schemars(length(min = 1))]
    name: String,
    /// What it rests on.
    #[serde(skip_serializing_if = "Option::is_none")]
    on: Option<Box<Thing>>,
    /// Its number, 0 if absent.
    #[serde(default)]
    number: u8,
    /// Its place.
    #[serde(skip_serializing_if = "Option::is_none")]
    place: Option<Place>,
}

/// Things.
#[derive(Serialize, JsonSchema)]
struct Things {
    /// The things.
    things: Vec<Thing>,
    /// The next page; null if there is none.
    next: Option<u32>,
}

/// Which.
#[derive(Deserialize, JsonSchema)]
#[schemars(inline)]
#[expect(dead_code, reason = "only described")]
struct Which {
    /// Words.
    #[schemars(length(min = 1, max = 2))]
    text: Vec<String>,
    /// How it is placed.
    place: Option<Place>,
}

/// Where.
#[derive(Deserialize, JsonSchema)]
#[schemars(inline)]
#[expect(dead_code, reason = "only described")]
struct Where {
    /// Metres.
    /// A circle.
    #[serde(default = "three")]
    #[schemars(range(min = 0, max = 9), example = 2.5)]
    radius: f64,
}

fn three() -> f64 {
    3.0
}

async fn things(_: Path<String>, _: Params<(Which, Where)>) -> Result<Json<Things>, Problem> {
    Ok(Json(Things { things: Vec::new(), next: None }))
}

fn described() -> Value {
    let routes = Routes::<()>::default()
        .get("/things/{id}", "things", things)
        .parameters([
            Parameter::of_path::<u8>("id", "a number"),
            Parameter::of_header("If-None-Match", "the etag"),
        ])
        .errors(&[(404, "No such thing.")])
        .post::<Thing, _, _>("/things", "keeps a thing", 64, async || As::<Binary>::new("kept"));
    let about = About {
        name: "test",
        version: "1.2.3",
        license: "MIT",
        summary: "Tests.",
        errors: &[(503, "Too busy.")],
    };
    let (_, table) = routes.described::<NoMembers>(about);
    serde_json::from_str(&document::<NoMembers>(&about, &table)).expect("JSON")
}

#[test]
fn operations_come_from_routes() {
    let api = described();
    assert_eq!(api["openapi"], "3.1.0");
    let info =
        json!({ "title": "test", "version": "1.2.3", "license": { "name": "MIT" }, "summary": "Tests." });
    assert_eq!(api["info"], info);
    let paths: Vec<&String> = api["paths"].as_object().expect("paths").keys().collect();
    assert_eq!(paths, ["/", "/openapi.json", "/things", "/things/{id}"]);

    let problem =
        json!({ "application/problem+json": { "schema": { "$ref": "#/components/schemas/Problem" } } });
    let refused = |description: &str| json!({ "description": description, "content": problem });
    let things = json!({ "schema": { "$ref": "#/components/schemas/Things" } });
    let parameter = |name: &str, place: &str, required: bool, description: &str, schema: Value| json!({ "name": name, "in": place, "required": required, "description": description, "schema": schema });
    let words = json!({ "type": "array", "items": { "type": "string" }, "minItems": 1, "maxItems": 2 });
    let number = json!({ "type": "integer", "format": "uint8", "minimum": 0, "maximum": 255 });
    let place = json!({ "$ref": "#/components/schemas/Place" });
    let radius = json!({
        "type": "number", "format": "double", "minimum": 0, "maximum": 9, "default": 3.0, "examples": [2.5],
    });
    let expected = json!({
        "summary": "Things.",
        "parameters": [
            parameter("id", "path", true, "A number.", number),
            parameter("If-None-Match", "header", false, "The etag.", json!({ "type": "string" })),
            parameter("place", "query", false, "How it is placed.", place),
            parameter("text", "query", true, "Words.", words),
            parameter("radius", "query", false, "Metres. A circle.", radius),
        ],
        "responses": {
            "200": { "description": "Things.", "content": { "application/json": things } },
            "400": refused("A parameter is invalid, or none of this resource."),
            "404": refused("No such thing."),
            "431": { "description": "The request's head is longer than the service takes." },
            "503": refused("Too busy."),
        },
    });
    assert_eq!(api["paths"]["/things/{id}"]["get"], expected);

    let keeping = &api["paths"]["/things"]["post"];
    let statuses: Vec<&String> = keeping["responses"].as_object().expect("responses").keys().collect();
    assert_eq!(statuses, ["200", "400", "401", "403", "408", "413", "415", "503"]);
    assert_eq!(keeping["security"], json!([{}, { "token": [] }]));
    assert!(api["components"]["securitySchemes"]["token"].is_object());
    let bytes = json!({ "application/octet-stream": { "schema": { "type": "string", "format": "binary" } } });
    assert_eq!(keeping["responses"]["200"]["content"], bytes);
    let asked = json!({ "$ref": "#/components/schemas/ThingRequest" });
    assert_eq!(keeping["requestBody"]["content"]["application/json"]["schema"], asked);
}

#[test]
fn schemas_come_from_types() {
    let schemas = &described()["components"]["schemas"];
    let names: Vec<&String> = schemas.as_object().expect("schemas").keys().collect();
    assert_eq!(names, ["Place", "Problem", "Thing", "ThingRequest", "Things"]);
    let place = json!({
        "type": "string", "enum": ["on-top", "alone"],
        "description": "How it is placed. on-top: Rests on something. alone: Stands alone.",
    });
    assert_eq!(schemas["Place"], place);
    let thing = |name: &str, required: &[&str]| {
        json!({
            "type": "object", "description": "A thing.", "required": required, "additionalProperties": false,
            "properties": {
                "name": { "type": "string", "minLength": 1, "description": "Its name, on two lines." },
                "number": {
                    "type": "integer", "format": "uint8", "minimum": 0, "maximum": 255, "default": 0,
                    "description": "Its number, 0 if absent.",
                },
                // Absent instead of null.
                "on": { "$ref": format!("#/components/schemas/{name}"), "description": "What it rests on." },
                "place": { "$ref": "#/components/schemas/Place", "description": "Its place." },
            },
        })
    };
    // Members optional in a request are always present in a reply.
    assert_eq!(schemas["ThingRequest"], thing("ThingRequest", &["name"]));
    assert_eq!(schemas["Thing"], thing("Thing", &["name", "number"]));
    let next = &schemas["Things"]["properties"]["next"];
    assert_eq!(next["type"], json!(["integer", "null"]));
    assert_eq!(schemas["Things"]["required"], json!(["things", "next"]));
    assert_eq!(schemas["Things"]["additionalProperties"], false);
    let required = json!(["type", "title", "status", "detail", "instance"]);
    assert_eq!(schemas["Problem"]["required"], required);
    assert_eq!(schemas["Problem"]["additionalProperties"], false);
}
