//! The table of a service's routes, from which the router and the descriptions are made.

use std::convert::Infallible;

use axum::Router;
use axum::extract::{DefaultBodyLimit, Request};
use axum::handler::Handler;
use axum::http::Method;
use axum::middleware::{Next, from_fn};
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodRouter, get, post};
use schemars::{JsonSchema, SchemaGenerator};
use serde_json::{Map, Value};
use tokio::sync::Semaphore;

use crate::body;
use crate::params::RequestError;
use crate::problem::Problem;
use crate::replies::{Answering, Binary, Described, Reply, SchemaOf};

/// A part of the path, or a header that counts.
#[derive(Clone, Debug)]
pub struct Parameter {
    pub(crate) name: &'static str,
    /// Its place, by its name in OpenAPI.
    pub(crate) place: &'static str,
    /// Meaning, one line.
    pub(crate) summary: &'static str,
    pub(crate) schema: SchemaOf,
    pub(crate) limits: Map<String, Value>,
}

impl Parameter {
    /// Describes a part of the path with values of type `T`.
    pub fn of_path<T: JsonSchema>(name: &'static str, summary: &'static str) -> Self {
        Self { name, place: "path", summary, schema: SchemaGenerator::subschema_for::<T>, limits: Map::new() }
    }

    pub fn of_header(name: &'static str, summary: &'static str) -> Self {
        Self { place: "header", ..Self::of_path::<String>(name, summary) }
    }

    /// Restricts its values by a keyword of JSON Schema.
    pub fn limit(mut self, keyword: &str, value: impl Into<Value>) -> Self {
        self.limits.insert(keyword.to_owned(), value.into());
        self
    }
}

#[derive(Clone, Debug)]
pub(crate) struct BodyOf {
    pub(crate) media_types: &'static [&'static str],
    pub(crate) schema: SchemaOf,
}

#[derive(Clone, Debug)]
pub struct Route {
    /// Method; a GET route takes HEAD as well.
    pub method: Method,
    /// Path, in axum's form.
    pub path: &'static str,
    /// The answer, one line.
    pub summary: &'static str,
    /// More about it, for the description.
    pub details: Option<&'static str>,
    /// Parts of the path, and headers.
    pub parameters: Vec<Parameter>,
    pub(crate) query: Option<SchemaOf>,
    /// Whether it changes nothing although its method is POST, so that it needs no token.
    pub reads: bool,
    /// Statuses and meanings of its own errors.
    pub errors: Vec<(u16, &'static str)>,
    pub(crate) body: Option<BodyOf>,
    pub(crate) replies: fn(&mut SchemaGenerator) -> Vec<Reply>,
}

pub struct Routes<S> {
    router: Router<S>,
    table: Vec<Route>,
}

impl<S: Clone + Send + Sync + 'static> Default for Routes<S> {
    fn default() -> Self {
        Self { router: Router::new(), table: Vec::new() }
    }
}

impl<S: Clone + Send + Sync + 'static> Routes<S> {
    fn add<T, H: Answering<T>>(
        mut self,
        method: Method,
        path: &'static str,
        summary: &'static str,
        handler: MethodRouter<S, Infallible>,
    ) -> Self {
        // No handler reads the query string here, so it would be ignored silently.
        let handler = if H::query().is_some() { handler } else { handler.route_layer(from_fn(no_query)) };
        self.router = self.router.route(path, handler);
        self.table.push(Route {
            method,
            path,
            summary,
            details: None,
            parameters: Vec::new(),
            query: H::query(),
            reads: false,
            errors: Vec::new(),
            body: None,
            replies: H::Answer::replies,
        });
        self
    }

    /// Adds a resource that is read.
    pub fn get<T: 'static, H: Handler<T, S> + Answering<T>>(
        self,
        path: &'static str,
        summary: &'static str,
        handler: H,
    ) -> Self {
        self.add::<T, H>(Method::GET, path, summary, get(handler))
    }

    /// Adds a resource that takes a `B` in JSON, of at most `max_body_bytes`. The body is read, and bodies of
    /// another type, longer ones and slow ones are refused, before the handler is called; the handler parses it.
    pub fn post<B: JsonSchema, T: 'static, H: Handler<T, S> + Answering<T>>(
        self,
        path: &'static str,
        summary: &'static str,
        max_body_bytes: usize,
        handler: H,
    ) -> Self {
        let body = BodyOf { media_types: &["application/json"], schema: SchemaGenerator::subschema_for::<B> };
        self.post_of::<T, H>(path, summary, body, max_body_bytes, handler)
    }

    /// The same for bytes of some media types.
    pub fn post_bytes<T: 'static, H: Handler<T, S> + Answering<T>>(
        self,
        path: &'static str,
        summary: &'static str,
        media_types: &'static [&'static str],
        max_body_bytes: usize,
        handler: H,
    ) -> Self {
        let body = BodyOf { media_types, schema: |_| Binary::schema() };
        self.post_of::<T, H>(path, summary, body, max_body_bytes, handler)
    }

    fn post_of<T: 'static, H: Handler<T, S> + Answering<T>>(
        self,
        path: &'static str,
        summary: &'static str,
        body: BodyOf,
        max_body_bytes: usize,
        handler: H,
    ) -> Self {
        let media_types = body.media_types;
        let whole = from_fn(move |request: Request, next: Next| {
            whole_body(media_types, max_body_bytes, request, next)
        });
        // The length is limited by `whole`; by itself axum refuses a body of more than 2 MB.
        let handler = post(handler).route_layer(DefaultBodyLimit::disable()).route_layer(whole);
        let mut routes = self.add::<T, H>(Method::POST, path, summary, handler);
        routes.last(|route| route.body = Some(body));
        routes
    }

    fn last(&mut self, change: impl FnOnce(&mut Route)) {
        if let Some(route) = self.table.last_mut() {
            change(route);
        }
    }

    /// Describes parts of the path, and headers, of the route added last.
    pub fn parameters(mut self, parameters: impl IntoIterator<Item = Parameter>) -> Self {
        self.last(|route| route.parameters.extend(parameters));
        self
    }

    /// Says that the route added last changes nothing although its method is POST: it is admitted as GET is.
    pub fn reads(mut self) -> Self {
        self.last(|route| route.reads = true);
        self
    }

    /// Says more about the route added last.
    pub fn details(mut self, details: &'static str) -> Self {
        self.last(|route| route.details = Some(details));
        self
    }

    /// Describes errors of the route added last, beyond those that its parameters and its body can cause.
    pub fn errors(mut self, errors: &[(u16, &'static str)]) -> Self {
        self.last(|route| route.errors.extend_from_slice(errors));
        self
    }

    pub(crate) fn into_parts(self) -> (Router<S>, Vec<Route>) {
        (self.router, self.table)
    }
}

/// Hands a request on that has no query string.
async fn no_query(request: Request, next: Next) -> Response {
    match request.uri().query() {
        None | Some("") => next.run(request).await,
        Some(query) => {
            let error =
                RequestError::new("query string", query, "none, since this resource has no parameters");
            Problem::from(error).into_response()
        }
    }
}

/// Room for long bodies in this process.
static LONG_BODIES: Semaphore = Semaphore::const_new(body::ROOM_BYTES);

/// Hands a request on with its body read.
async fn whole_body(
    media_types: &'static [&'static str],
    max_bytes: usize,
    request: Request,
    next: Next,
) -> Response {
    let (head, body) = request.into_parts();
    let is_taken =
        body::check_type(&head.headers, media_types).and_then(|()| body::check_encoding(&head.headers));
    let checked = match is_taken {
        Ok(()) => body::read(body, max_bytes, &LONG_BODIES).await,
        Err(problem) => Err(problem),
    };
    match checked {
        Ok(bytes) => next.run(Request::from_parts(head, bytes.into())).await,
        Err(problem) => problem.into_response(),
    }
}
