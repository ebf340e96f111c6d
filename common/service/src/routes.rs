//! The table of a service's routes, from which the router and the help text are made.

use std::convert::Infallible;
use std::fmt::Write;

use axum::Router;
use axum::extract::Request;
use axum::handler::Handler;
use axum::http::Method;
use axum::middleware::{Next, from_fn};
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodRouter, get, post};
use schemars::{JsonSchema, SchemaGenerator};
use serde_json::{Map, Value};

use crate::body;
use crate::replies::{Answering, Described, Reply, SchemaOf};

/// Column in which the help text's summaries begin.
const SUMMARY_COLUMN: usize = 36;

/// Where a parameter stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// In the query string.
    Query,
    Path,
    /// Among the headers.
    Header,
}

impl Place {
    /// Returns its name in OpenAPI.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Query => "query",
            Self::Path => "path",
            Self::Header => "header",
        }
    }
}

/// A parameter of a route.
#[derive(Clone, Debug)]
pub struct Parameter {
    pub name: &'static str,
    /// A valid value, or its form.
    pub example: &'static str,
    /// Meaning, one line.
    pub summary: String,
    /// More about it, for the description.
    pub details: Option<&'static str>,
    /// Where it stands.
    pub place: Place,
    /// Whether it must be there.
    pub is_required: bool,
    /// Most values; absent: one.
    pub most: Option<usize>,
    pub(crate) schema: SchemaOf,
    pub(crate) limits: Map<String, Value>,
}

impl Parameter {
    /// Describes a query parameter with values of type `T`.
    pub fn new<T: JsonSchema>(name: &'static str, example: &'static str, summary: impl Into<String>) -> Self {
        Self {
            name,
            example,
            summary: summary.into(),
            details: None,
            place: Place::Query,
            is_required: false,
            most: None,
            schema: SchemaGenerator::subschema_for::<T>,
            limits: Map::new(),
        }
    }

    /// Describes a part of the path.
    pub fn of_path<T: JsonSchema>(name: &'static str, summary: impl Into<String>) -> Self {
        Self { place: Place::Path, is_required: true, ..Self::new::<T>(name, "", summary) }
    }

    /// Describes a header.
    pub fn of_header(name: &'static str, summary: impl Into<String>) -> Self {
        Self { place: Place::Header, ..Self::new::<String>(name, "", summary) }
    }

    /// Says more about it.
    pub fn details(self, details: &'static str) -> Self {
        Self { details: Some(details), ..self }
    }

    /// It must be there.
    pub fn required(self) -> Self {
        Self { is_required: true, ..self }
    }

    /// It may be there several times.
    pub fn repeated(self, most: usize) -> Self {
        Self { most: Some(most), ..self }
    }

    /// Restricts its values by a keyword of JSON Schema.
    pub fn limit(mut self, keyword: &str, value: impl Into<Value>) -> Self {
        self.limits.insert(keyword.to_owned(), value.into());
        self
    }

    /// Restricts it to a range, both ends included.
    pub fn within(self, least: impl Into<Value>, most: impl Into<Value>) -> Self {
        self.limit("minimum", least).limit("maximum", most)
    }

    /// Restricts it to texts of a form, a regular expression.
    pub fn of_form(self, pattern: impl Into<String>) -> Self {
        self.limit("pattern", pattern.into())
    }

    /// States the value that stands for an absent one.
    pub fn or(mut self, default: impl Into<Value>) -> Self {
        let default = default.into();
        let shown = default.as_str().map_or_else(|| default.to_string(), str::to_owned);
        self.summary.push_str(&format!(" (default: {shown})"));
        self.limit("default", default)
    }
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
    pub parameters: Vec<Parameter>,
    /// Whether it changes nothing although its method is POST, so that it needs no token.
    pub reads: bool,
    /// Statuses and meanings of its own errors.
    pub errors: Vec<(u16, &'static str)>,
    pub(crate) body: Option<SchemaOf>,
    pub(crate) replies: fn(&mut SchemaGenerator) -> Vec<Reply>,
}

impl Route {
    /// Returns the parameters of the query string.
    pub fn query(&self) -> impl Iterator<Item = &Parameter> {
        self.parameters.iter().filter(|parameter| parameter.place == Place::Query)
    }
}

/// Routes under construction.
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
    fn add<D: Described>(
        mut self,
        method: Method,
        path: &'static str,
        summary: &'static str,
        handler: MethodRouter<S, Infallible>,
    ) -> Self {
        self.router = self.router.route(path, handler);
        let (details, parameters, errors, body, reads) = (None, Vec::new(), Vec::new(), None, false);
        let replies = D::replies;
        self.table.push(Route { method, path, summary, details, parameters, reads, errors, body, replies });
        self
    }

    /// Adds a resource that is read.
    pub fn get<T: 'static, H: Handler<T, S> + Answering<T>>(
        self,
        path: &'static str,
        summary: &'static str,
        handler: H,
    ) -> Self {
        self.add::<H::Answer>(Method::GET, path, summary, get(handler))
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
        let whole = from_fn(move |request: Request, next: Next| whole_body(max_body_bytes, request, next));
        let handler = post(handler).route_layer(whole);
        let mut routes = self.add::<H::Answer>(Method::POST, path, summary, handler);
        routes.last(|route| route.body = Some(SchemaGenerator::subschema_for::<B>));
        routes
    }

    fn last(&mut self, change: impl FnOnce(&mut Route)) {
        if let Some(route) = self.table.last_mut() {
            change(route);
        }
    }

    /// Describes the parameters of the route added last.
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

    /// Returns the router and the table.
    pub(crate) fn into_parts(self) -> (Router<S>, Vec<Route>) {
        (self.router, self.table)
    }
}

/// Hands a request on with its body read.
async fn whole_body(max_bytes: usize, request: Request, next: Next) -> Response {
    let (head, body) = request.into_parts();
    let checked = match body::check_json(&head.headers) {
        Ok(()) => body::read(body, max_bytes).await,
        Err(problem) => Err(problem),
    };
    match checked {
        Ok(bytes) => next.run(Request::from_parts(head, bytes.into())).await,
        Err(problem) => problem.into_response(),
    }
}

/// Returns the text for people: every route and parameter.
pub(crate) fn help(title: &str, table: &[Route]) -> String {
    let mut text = format!("{title}\n\n");
    let mut line = |what: String, summary: &str| {
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{}", format!("{what:SUMMARY_COLUMN$} {summary}").trim_end());
    };
    for route in table {
        line(format!("{} {}", route.method, route.path), route.summary);
        for Parameter { name, example, summary, .. } in route.query() {
            line(format!("    {name}={example}"), summary);
        }
    }
    text
}

#[cfg(test)]
mod tests;
