//! The table of a service's routes, source of the router and the descriptions.

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

/// A path parameter or a header.
#[derive(Clone, Debug)]
pub struct Parameter {
    pub(crate) name: &'static str,
    /// Its `in` in OpenAPI.
    pub(crate) place: &'static str,
    /// One line.
    pub(crate) summary: &'static str,
    pub(crate) schema: SchemaOf,
    pub(crate) limits: Map<String, Value>,
}

impl Parameter {
    /// A path parameter with values of type `T`.
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
    /// A GET route takes HEAD as well.
    pub method: Method,
    /// In axum's form.
    pub path: &'static str,
    /// One line.
    pub summary: &'static str,
    /// Longer text for the description.
    pub details: Option<&'static str>,
    /// Path parameters and headers.
    pub parameters: Vec<Parameter>,
    pub(crate) query: Option<SchemaOf>,
    /// Whether it changes nothing despite POST, so that it needs no token.
    pub reads: bool,
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

    pub fn get<T: 'static, H: Handler<T, S> + Answering<T>>(
        self,
        path: &'static str,
        summary: &'static str,
        handler: H,
    ) -> Self {
        self.add::<T, H>(Method::GET, path, summary, get(handler))
    }

    /// Adds a resource that takes a `B` in JSON, of at most `max_body_bytes`. The body is read before the handler
    /// parses it; bodies of another type, longer or slow ones are refused.
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

    /// As [`Self::post`], for bytes of some media types.
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
        // `whole` limits the length; by default axum refuses bodies over 2 MB.
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

    /// Adds path parameters and headers to the route added last.
    pub fn parameters(mut self, parameters: impl IntoIterator<Item = Parameter>) -> Self {
        self.last(|route| route.parameters.extend(parameters));
        self
    }

    /// Marks the route added last as changing nothing despite POST: it is admitted as GET is.
    pub fn reads(mut self) -> Self {
        self.last(|route| route.reads = true);
        self
    }

    /// Adds details to the route added last.
    pub fn details(mut self, details: &'static str) -> Self {
        self.last(|route| route.details = Some(details));
        self
    }

    /// Adds errors of the route added last, beyond those of its parameters and body.
    pub fn errors(mut self, errors: &[(u16, &'static str)]) -> Self {
        self.last(|route| route.errors.extend_from_slice(errors));
        self
    }

    pub(crate) fn into_parts(self) -> (Router<S>, Vec<Route>) {
        (self.router, self.table)
    }
}

/// Passes on a request without a query string.
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

static LONG_BODIES: Semaphore = Semaphore::const_new(body::ROOM_BYTES);

/// Passes on a request with its body read.
async fn whole_body(
    media_types: &'static [&'static str],
    max_bytes: usize,
    request: Request,
    next: Next,
) -> Response {
    let (head, body) = request.into_parts();
    let checked = async {
        body::check_type(&head.headers, media_types)?;
        body::check_encoding(&head.headers)?;
        body::read(body, max_bytes, &LONG_BODIES).await
    };
    match checked.await {
        Ok(bytes) => next.run(Request::from_parts(head, bytes.into())).await,
        Err(problem) => problem.into_response(),
    }
}
