//! The description for programs: OpenAPI 3.1, made from the routes and from the types that their handlers take and
//! return.

mod schemas;

use std::sync::{Arc, OnceLock};

use axum::http::header;
use axum::{Json, Router};
use schemars::JsonSchema;
use serde_json::{Map, Value, json};

use self::schemas::{Schemas, tidied};
use crate::problem::ProblemBody;
use crate::replies::As;
use crate::routes::{Parameter, Place, Route, Routes, help};

/// A service, as its description and help text name it.
#[derive(Clone, Copy, Debug)]
pub struct About {
    /// Name of the program.
    pub name: &'static str,
    pub version: &'static str,
    pub license: &'static str,
    /// Its job: first line of the help text.
    pub summary: &'static str,
    /// Statuses and meanings of errors of every route.
    pub errors: &'static [(u16, &'static str)],
}

impl<S: Clone + Send + Sync + 'static> Routes<S> {
    /// Adds `GET /`, a text for people: every route and parameter; and `GET /openapi.json`, the same for programs
    /// with all types, made on the first request. `M`: members of the service's problems beyond those of RFC 9457.
    /// Returns the router and the table.
    pub fn described<M: JsonSchema>(self, about: About) -> (Router<S>, Vec<Route>) {
        let table = Arc::<OnceLock<Vec<Route>>>::default();
        let (of_help, of_document) = (Arc::clone(&table), Arc::clone(&table));
        let made = Arc::<OnceLock<String>>::default();
        let described = self
            .get("/openapi.json", "this list for programs, with the types of all messages", async move || {
                let text = made.get_or_init(|| document::<M>(&about, rows(&of_document))).clone();
                As::<Json<Map<String, Value>>>::new(([(header::CONTENT_TYPE, "application/json")], text))
            })
            .get("/", "this list", async move || {
                As::<&'static str>::new(help(about.summary, rows(&of_help)))
            });
        let (router, rows) = described.into_parts();
        (router, table.get_or_init(|| rows).clone())
    }
}

fn rows(table: &OnceLock<Vec<Route>>) -> &[Route] {
    table.get().map(Vec::as_slice).unwrap_or_default()
}

/// Returns the description of a service. `M`: members of its problems beyond those of RFC 9457.
pub fn document<M: JsonSchema>(about: &About, table: &[Route]) -> String {
    let mut schemas = Schemas::default();
    let problem = schemas.of_reply::<ProblemBody<M>>();
    let mut paths = Map::new();
    for route in table {
        let methods = paths.entry(route.path).or_insert_with(|| json!({}));
        methods[route.method.as_str().to_lowercase()] =
            operation(route, about.errors, &problem, &mut schemas);
    }
    let mut components = json!({});
    if table.iter().any(|route| route.body.is_some()) {
        let token = "The token of --token-file, where the service was started with one.";
        components["securitySchemes"] =
            json!({ "token": { "type": "http", "scheme": "bearer", "description": token } });
    }
    let About { name, version, license, summary, .. } = about;
    let info =
        json!({ "title": name, "version": version, "summary": summary, "license": { "name": license } });
    let mut document = json!({ "openapi": "3.1.0", "info": info, "paths": paths, "components": components });
    schemas.finish(&mut document);
    document.to_string()
}

fn operation(route: &Route, of_all: &[(u16, &'static str)], problem: &Value, schemas: &mut Schemas) -> Value {
    let mut operation = json!({ "summary": sentence(route.summary) });
    if let Some(details) = route.details {
        operation["description"] = details.into();
    }
    if !route.parameters.is_empty() {
        operation["parameters"] =
            route.parameters.iter().map(|parameter| described(parameter, schemas)).collect();
    }
    let mut responses = Map::new();
    for reply in schemas.replies(route.replies) {
        let mut response = json!({ "description": sentence(route.summary) });
        for (media_type, schema) in reply.content {
            response["content"][media_type] = json!({ "schema": tidied(schema, true) });
        }
        for (name, meaning) in reply.headers {
            response["headers"][name] =
                json!({ "description": meaning, "required": true, "schema": { "type": "string" } });
        }
        responses.insert(reply.status.as_u16().to_string(), response);
    }
    let content = json!({ "application/problem+json": { "schema": problem } });
    let mut refuse = |status: u16, description: &str| {
        responses
            .entry(status.to_string())
            .or_insert_with(|| json!({ "description": description, "content": content }));
    };
    route.errors.iter().chain(of_all).for_each(|(status, description)| refuse(*status, description));
    if let Some(body) = route.body {
        if !route.reads {
            operation["security"] = json!([{}, { "token": [] }]);
        }
        let schema = schemas.of_request(body);
        operation["requestBody"] =
            json!({ "required": true, "content": { "application/json": { "schema": schema } } });
        let of_bodies = OF_BODIES.iter().filter(|(status, _)| *status != 401 || !route.reads);
        of_bodies.for_each(|(status, description)| refuse(*status, description));
    } else if route.parameters.iter().any(|parameter| parameter.place != Place::Header) {
        refuse(400, "A parameter is invalid.");
    }
    if route.query().next().is_some() {
        // It is refused before anything can write a problem.
        let description = "The request's head is longer than the service takes.";
        responses.insert("431".into(), json!({ "description": description }));
    }
    operation["responses"] = responses.into();
    operation
}

fn described(parameter: &Parameter, schemas: &mut Schemas) -> Value {
    let mut schema = schemas.of_request(parameter.schema);
    if let Some(members) = schema.as_object_mut() {
        members.extend(parameter.limits.clone());
    }
    if let Some(most) = parameter.most {
        schema = json!({ "type": "array", "items": schema, "maxItems": most });
        if parameter.is_required {
            schema["minItems"] = 1.into();
        }
    }
    let mut description = sentence(&parameter.summary);
    if let Some(details) = parameter.details {
        description = format!("{description} {details}").trim_start().to_owned();
    }
    json!({
        "name": parameter.name, "in": parameter.place.name(), "required": parameter.is_required,
        "description": description, "schema": schema,
    })
}

/// The errors of every route with a body.
const OF_BODIES: [(u16, &str); 6] = [
    (400, "The body is not what the schema says."),
    (401, "The service was started with --token-file, and the request lacks its token."),
    (
        403,
        "The request is of a page of another origin, or the service can be reached from other machines and has no token.",
    ),
    (408, "The body was not complete in time."),
    (413, "The body is too long."),
    (415, "The body is not said to be application/json."),
];

pub(crate) fn sentence(summary: &str) -> String {
    let mut letters = summary.chars();
    letters.next().map(|first| format!("{}{}.", first.to_uppercase(), letters.as_str())).unwrap_or_default()
}

#[cfg(test)]
mod tests;
