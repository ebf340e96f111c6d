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

use crate::body;

/// Column in which the help text's summaries begin.
const SUMMARY_COLUMN: usize = 36;

/// A query parameter of a route.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Parameter {
    /// Name.
    pub name: &'static str,
    /// A valid value, or its form.
    pub example: &'static str,
    /// Meaning, one line.
    pub summary: String,
}

impl Parameter {
    /// Describes a parameter.
    pub fn new(name: &'static str, example: &'static str, summary: impl Into<String>) -> Self {
        Self { name, example, summary: summary.into() }
    }
}

/// A route.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Route {
    /// Method; a GET route takes HEAD as well.
    pub method: Method,
    /// Path, in axum's form.
    pub path: &'static str,
    /// The answer, one line.
    pub summary: &'static str,
    /// Query parameters.
    pub parameters: Vec<Parameter>,
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
    fn add(
        mut self,
        method: Method,
        path: &'static str,
        summary: &'static str,
        handler: MethodRouter<S, Infallible>,
    ) -> Self {
        self.router = self.router.route(path, handler);
        self.table.push(Route { method, path, summary, parameters: Vec::new() });
        self
    }

    /// Adds a resource that is read.
    pub fn get<T: 'static>(
        self,
        path: &'static str,
        summary: &'static str,
        handler: impl Handler<T, S>,
    ) -> Self {
        self.add(Method::GET, path, summary, get(handler))
    }

    /// Adds a resource that takes a JSON body of at most `max_body_bytes`. The body is read, and bodies of another type,
    /// longer ones and slow ones are refused, before the handler is called.
    pub fn post<T: 'static>(
        self,
        path: &'static str,
        summary: &'static str,
        max_body_bytes: usize,
        handler: impl Handler<T, S>,
    ) -> Self {
        let whole = from_fn(move |request: Request, next: Next| whole_body(max_body_bytes, request, next));
        let handler = post(handler).route_layer(whole);
        self.add(Method::POST, path, summary, handler)
    }

    /// Describes the query parameters of the route added last.
    pub fn parameters(mut self, parameters: impl IntoIterator<Item = Parameter>) -> Self {
        if let Some(route) = self.table.last_mut() {
            route.parameters.extend(parameters);
        }
        self
    }

    /// Adds `GET /`, a text for people: `title`, then every route and parameter. Returns the router and the
    /// table.
    pub fn with_help(mut self, title: &str) -> (Router<S>, Vec<Route>) {
        let (path, summary) = ("/", "this list");
        self.table.push(Route { method: Method::GET, path, summary, parameters: Vec::new() });
        let text = help(title, &self.table);
        let router = self.router.route(path, get(async move || text));
        (router, self.table)
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

fn help(title: &str, table: &[Route]) -> String {
    let mut text = format!("{title}\n\n");
    let mut line = |what: String, summary: &str| {
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{}", format!("{what:SUMMARY_COLUMN$} {summary}").trim_end());
    };
    for route in table {
        line(format!("{} {}", route.method, route.path), route.summary);
        for Parameter { name, example, summary } in &route.parameters {
            line(format!("    {name}={example}"), summary);
        }
    }
    text
}

#[cfg(test)]
mod tests;
