//! Types of handlers' arguments and results for the description.

use std::marker::PhantomData;

use axum::Json;
use axum::body::Bytes;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, Method, StatusCode};
use axum::response::{IntoResponse, Response};
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};

use crate::metrics::Exposition;
use crate::problem::Problem;

pub type SchemaOf = fn(&mut SchemaGenerator) -> Schema;

pub struct Reply {
    pub status: StatusCode,
    /// Media types of the body, each with its schema; empty: no body.
    pub content: Vec<(&'static str, Schema)>,
    /// Headers always present, and their meaning.
    pub headers: &'static [(&'static str, &'static str)],
}

impl Reply {
    pub fn ok(media_type: &'static str, schema: Schema) -> Self {
        Self { status: StatusCode::OK, content: vec![(media_type, schema)], headers: &[] }
    }
}

pub trait Described {
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
    pub fn schema() -> Schema {
        json_schema!({ "type": "string", "format": "binary" })
    }
}

impl Described for Binary {
    fn replies(_: &mut SchemaGenerator) -> Vec<Reply> {
        vec![Reply::ok("application/octet-stream", Self::schema())]
    }
}

/// A response described by `D`: a body written elsewhere, or sent in pieces.
pub struct As<D> {
    response: Response,
    described: PhantomData<D>,
}

impl<D> As<D> {
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

/// A handler's argument in the description.
pub trait Taken {
    /// Describes the struct of query parameters.
    fn query() -> Option<SchemaOf> {
        None
    }
}

impl<T: Taken, E> Taken for Result<T, E> {
    fn query() -> Option<SchemaOf> {
        T::query()
    }
}

impl<S> Taken for State<S> {}
impl<T> Taken for Path<T> {}
impl Taken for HeaderMap {}
impl Taken for Method {}
impl Taken for Bytes {}

/// A handler with described arguments and results.
pub trait Answering<T> {
    type Answer: Described;

    /// Describes the struct of query parameters.
    fn query() -> Option<SchemaOf>;
}

macro_rules! answering {
    ($($argument:ident),*) => {
        impl<F, Answer, Marker, $($argument: Taken),*> Answering<(Marker, $($argument,)*)> for F
        where
            F: FnOnce($($argument),*) -> Answer,
            Answer: Future,
            Answer::Output: Described,
        {
            type Answer = Answer::Output;

            fn query() -> Option<SchemaOf> {
                None::<SchemaOf>$(.or_else($argument::query))*
            }
        }
    };
}

answering!();
answering!(A);
answering!(A, B);
answering!(A, B, C);
answering!(A, B, C, D);
