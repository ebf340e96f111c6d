//! The description for programs: OpenAPI 3.1, made from the routes and from the types that their handlers take and return.

mod schemas;

use std::marker::PhantomData;

use axum::Json;
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde_json::{Map, Value, json};

use self::schemas::{Schemas, tidied};
use crate::metrics::Exposition;
use crate::problem::{Problem, ProblemBody};
use crate::routes::{Parameter, Place, Route};

/// Makes the schema of a type.
pub type SchemaOf = fn(&mut SchemaGenerator) -> Schema;

/// A service, as its description and help text name it.
#[derive(Clone, Copy, Debug)]
pub struct About {
    /// Name of the program.
    pub name: &'static str,
    /// Its version.
    pub version: &'static str,
    /// Its license.
    pub license: &'static str,
    /// Its job: first line of the help text.
    pub summary: &'static str,
    /// Statuses and meanings of errors of every route.
    pub errors: &'static [(u16, &'static str)],
}

/// A successful reply.
pub struct Reply {
    /// Its status.
    pub status: StatusCode,
    /// Media types of the body, each with its schema; empty: no body.
    pub content: Vec<(&'static str, Schema)>,
    /// Headers that it always has, and their meaning.
    pub headers: &'static [(&'static str, &'static str)],
}

impl Reply {
    /// Describes a reply with status 200 and a body of one type.
    pub fn ok(media_type: &'static str, schema: Schema) -> Self {
        Self { status: StatusCode::OK, content: vec![(media_type, schema)], headers: &[] }
    }
}

/// What a handler returns.
pub trait Described {
    /// Describes the successful replies.
    fn replies(schemas: &mut SchemaGenerator) -> Vec<Reply>;
}

impl<T: JsonSchema> Described for Json<T> {
    fn replies(schemas: &mut SchemaGenerator) -> Vec<Reply> {
        vec![Reply::ok("application/json", schemas.subschema_for::<T>())]
    }
}

impl<T: Described> Described for Result<T, Problem> {
    fn replies(schemas: &mut SchemaGenerator) -> Vec<Reply> {
        T::replies(schemas)
    }
}

impl Described for &'static str {
    fn replies(schemas: &mut SchemaGenerator) -> Vec<Reply> {
        vec![Reply::ok("text/plain", schemas.subschema_for::<String>())]
    }
}

impl Described for Exposition {
    fn replies(schemas: &mut SchemaGenerator) -> Vec<Reply> {
        vec![Reply::ok(Self::MEDIA_TYPE, schemas.subschema_for::<String>())]
    }
}

/// Bytes without a schema.
pub struct Binary;

impl Binary {
    /// Returns the schema of bytes.
    pub fn schema() -> Schema {
        json_schema!({ "type": "string", "format": "binary" })
    }
}

impl Described for Binary {
    fn replies(_: &mut SchemaGenerator) -> Vec<Reply> {
        vec![Reply::ok("application/octet-stream", Self::schema())]
    }
}

/// A response that is what `D` describes: a body that was written elsewhere, or is sent in pieces.
pub struct As<D> {
    response: Response,
    described: PhantomData<D>,
}

impl<D> As<D> {
    /// Takes a response.
    pub fn new(response: impl IntoResponse) -> Self {
        Self { response: response.into_response(), described: PhantomData }
    }
}

impl<D> IntoResponse for As<D> {
    fn into_response(self) -> Response {
        self.response
    }
}

impl<D: Described> Described for As<D> {
    fn replies(schemas: &mut SchemaGenerator) -> Vec<Reply> {
        D::replies(schemas)
    }
}

/// A handler whose replies are described.
pub trait Answering<T> {
    /// What it returns.
    type Answer: Described;
}

macro_rules! answering {
    ($($argument:ident),*) => {
        impl<F, Answer, Marker, $($argument),*> Answering<(Marker, $($argument,)*)> for F
        where
            F: FnOnce($($argument),*) -> Answer,
            Answer: Future,
            Answer::Output: Described,
        {
            type Answer = Answer::Output;
        }
    };
}

answering!();
answering!(A);
answering!(A, B);
answering!(A, B, C);
answering!(A, B, C, D);

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
        operation["security"] = json!([{}, { "token": [] }]);
        let schema = schemas.of_request(body);
        operation["requestBody"] =
            json!({ "required": true, "content": { "application/json": { "schema": schema } } });
        OF_BODIES.iter().for_each(|(status, description)| refuse(*status, description));
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

/// Returns a summary as a sentence.
pub(crate) fn sentence(summary: &str) -> String {
    let mut letters = summary.chars();
    letters.next().map(|first| format!("{}{}.", first.to_uppercase(), letters.as_str())).unwrap_or_default()
}

#[cfg(test)]
mod tests;
