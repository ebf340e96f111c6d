//! `GET` and `POST /v1/query`.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Instant;

use axum::Json;
use axum::body::Bytes;
use axum::extract::State;
use axum::extract::rejection::QueryRejection;
use axum::http::header;
use slag_service::problem::Problem;
use slag_service::replies::As;

use super::body::{Body, Understood};
use super::params::{self, Pairs};
use super::reply::{Described, Replied};
use crate::http::app::App;
use crate::http::problem::{parameter_problem, query_problem};
use crate::query::Asked;

/// A reply, written where it was computed.
type Answer = As<Json<Replied<'static>>>;

pub async fn get(
    State(app): State<Arc<App>>,
    pairs: Result<Pairs, QueryRejection>,
) -> Result<Answer, Problem> {
    let body = params::pairs(pairs).and_then(|pairs| params::parse(&pairs).map_err(parameter_problem));
    answer(&app, body).await
}

pub async fn post(State(app): State<Arc<App>>, bytes: Bytes) -> Result<Answer, Problem> {
    answer(&app, Body::parse(&bytes).map_err(parameter_problem)).await
}

async fn answer(app: &Arc<App>, body: Result<Body, Problem>) -> Result<Answer, Problem> {
    let started = Instant::now();
    let answer = answer_within(app, body).await;
    app.metrics.query_times.observe(started.elapsed());
    let body = answer?;
    Ok(As::new(([(header::CONTENT_TYPE, "application/json")], body)))
}

async fn answer_within(app: &Arc<App>, body: Result<Body, Problem>) -> Result<Vec<u8>, Problem> {
    let body = body?;
    // Before time runs: a budget of nothing is refused, not overrun.
    let time_budget = body.time_budget().map_err(parameter_problem)?;
    let answering = app.within_limits(time_budget, move |app, budget| {
        let has_objects = !app.engine.snapshot().map_err(query_problem)?.objects.is_empty();
        let Understood { ask, questions } = body.understand(has_objects).map_err(parameter_problem)?;
        let found = app.engine.ask(&ask, budget).map_err(query_problem)?;
        let n_empty = found.outcomes.iter().filter(|outcome| outcome.is_empty()).count();
        app.metrics.empty_answers.fetch_add(n_empty as u64, Ordering::Relaxed);
        let results = questions.into_iter().zip(&ask.asked).zip(&found.outcomes);
        let results = results.map(|((question, asked), outcome)| {
            let understood = match asked {
                Asked::Phrase(phrase) => Some(phrase),
                _ => None,
            };
            Described::new(&found.reply, (question, understood), outcome, (ask.offset, ask.page()))
        });
        serde_json::to_vec(&Replied::new(&found.reply, results.collect())).map_err(Problem::internal)
    });
    answering.await
}
