//! The OpenAPI 3.1 description, made from the routes and their handlers' types.

mod schemas;

use std::fmt::Write;
use std::sync::{Arc, OnceLock};

use axum::http::header;
use axum::{Json, Router};
use schemars::JsonSchema;
use serde_json::{Map, Value, json};

use self::schemas::{Schemas, tidied};
use crate::problem::ProblemBody;
use crate::replies::As;
use crate::routes::{Parameter, Route, Routes};

const SUMMARY_COLUMN: usize = 36;

/// A service's name and texts in its description and help.
#[derive(Clone, Copy, Debug)]
pub struct About {
    pub name: &'static str,
    pub version: &'static str,
    pub license: &'static str,
    /// First line of the help text.
    pub summary: &'static str,
    /// Statuses and meanings of errors of every route.
    pub errors: &'static [(u16, &'static str)],
}

impl<S: Clone + Send + Sync + 'static> Routes<S> {
    /// Adds `GET /`, a help text with every route and parameter; and `GET /openapi.json`, with all types, made on the
    /// first request. `M`: members of the service's problems beyond RFC 9457. Returns the router and the table.
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

/// Returns a service's description. `M`: members of its problems beyond RFC 9457.
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
    let query = query_of(route, schemas);
    let takes_query = !query.is_empty();
    let mut parameters: Vec<Value> =
        route.parameters.iter().map(|parameter| described(parameter, schemas)).collect();
    parameters.extend(query);
    if !parameters.is_empty() {
        operation["parameters"] = parameters.into();
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
    if let Some(body) = &route.body {
        if !route.reads {
            operation["security"] = json!([{}, { "token": [] }]);
        }
        let schema = schemas.of_request(body.schema);
        operation["requestBody"] = json!({ "required": true });
        for media_type in body.media_types {
            operation["requestBody"]["content"][media_type] = json!({ "schema": schema });
        }
        let of_bodies = OF_BODIES.iter().filter(|(status, _)| *status != 401 || !route.reads);
        of_bodies.for_each(|(status, description)| refuse(*status, description));
    } else {
        refuse(400, "A parameter is invalid, or none of this resource.");
    }
    if takes_query {
        // Sent before anything can write a problem.
        let description = "The request's head is longer than the service takes.";
        responses.insert("431".into(), json!({ "description": description }));
    }
    operation["responses"] = responses.into();
    operation
}

fn described(parameter: &Parameter, schemas: &mut Schemas) -> Value {
    let Parameter { name, place, summary, limits, .. } = parameter;
    let mut schema = schemas.of_request(parameter.schema);
    if let Some(members) = schema.as_object_mut() {
        members.extend(limits.clone());
    }
    let is_required = *place == "path";
    let description = sentence(summary);
    json!({ "name": name, "in": place, "required": is_required, "description": description, "schema": schema })
}

/// Describes the parameters of a route's query string, from a struct or a tuple of structs.
fn query_of(route: &Route, schemas: &mut Schemas) -> Vec<Value> {
    let Some(query) = route.query else { return Vec::new() };
    let query = schemas.of_request(query);
    let mut parameters = Vec::new();
    for of in query["prefixItems"].as_array().unwrap_or(&vec![query.clone()]) {
        let is_required =
            |name: &str| of["required"].as_array().is_some_and(|all| all.contains(&name.into()));
        for (name, schema) in of["properties"].as_object().into_iter().flatten() {
            let mut schema = schema.clone();
            let description = schema.as_object_mut().and_then(|members| members.remove("description"));
            parameters.push(json!({
                "name": name, "in": "query", "required": is_required(name), "description": description,
                "schema": schema,
            }));
        }
    }
    parameters
}

/// Errors of every route with a body.
const OF_BODIES: [(u16, &str); 6] = [
    (400, "The body is not what the schema says."),
    (401, "The service was started with --token-file, and the request lacks its token."),
    (
        403,
        "The request is of a page of another origin, or the service can be reached from other machines and has no token.",
    ),
    (408, "The body was not complete in time."),
    (413, "The body is too long."),
    (415, "The body's Content-Type is none that the resource takes, or it has a Content-Encoding."),
];

pub(crate) fn sentence(summary: &str) -> String {
    let mut letters = summary.chars();
    letters.next().map(|first| format!("{}{}.", first.to_uppercase(), letters.as_str())).unwrap_or_default()
}

fn help(title: &str, table: &[Route]) -> String {
    let mut text = format!("{title}\n\n");
    let mut line = |what: String, summary: &str| {
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{}", format!("{what:SUMMARY_COLUMN$} {summary}").trim_end());
    };
    for route in table {
        line(format!("{} {}", route.method, route.path), route.summary);
        for parameter in query_of(route, &mut Schemas::default()) {
            let (name, schema) = (parameter["name"].as_str().unwrap_or_default(), &parameter["schema"]);
            let example = schema["examples"][0].as_array().map_or(&schema["examples"][0], |list| &list[0]);
            let default = schema.get("default").filter(|default| !default.is_array());
            let default = default.map(|default| format!(" Default: {}.", shown(default)));
            let description = parameter["description"].as_str().unwrap_or_default();
            line(
                format!("    {name}={}", shown(example)),
                &format!("{description}{}", default.unwrap_or_default()),
            );
        }
    }
    text
}

fn shown(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

#[cfg(test)]
mod tests;
