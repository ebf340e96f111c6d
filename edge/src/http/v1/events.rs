//! `GET /v1/events`: server-sent events (WHATWG HTML, 9.2), so that a client need not poll.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::body::{Body, Bytes};
use axum::extract::State;
use axum::http::{HeaderValue, header};
use futures_util::stream::unfold;
use schemars::SchemaGenerator;
use serde_json::{Value, json};
use slag_service::problem::Problem;
use slag_service::replies::{As, Described, Reply};
use tokio::sync::mpsc::channel;

use crate::fetch::follow::FollowStatus;
use crate::http::app::App;
use crate::http::problem::too_many_listeners;
use slag_api::FRAME;

const MEDIA_TYPE: &str = "text/event-stream";
/// Interval of looks at the state on board.
const TICK: Duration = Duration::from_millis(500);
/// Silence after which a comment is sent, to notice clients that are gone.
const KEEP_ALIVE: Duration = Duration::from_secs(15);
const EVENTS_AHEAD: usize = 4;

pub async fn events(State(app): State<Arc<App>>) -> Result<As<Events>, Problem> {
    let permit = Arc::clone(&app.listeners).try_acquire_owned();
    let permit = permit.map_err(|_| too_many_listeners(app.settings.max_listeners))?;
    let (sender, receiver) = channel::<Bytes>(EVENTS_AHEAD);
    let mut stopping = app.stopping.subscribe();
    let telling = async move {
        let _permit = permit;
        let mut told = Told::default();
        let mut quiet = Duration::ZERO;
        loop {
            // It may open files.
            let looked = app
                .blocking(|app| {
                    app.reload_if_stale();
                    Ok(())
                })
                .await;
            if looked.is_err() {
                return;
            }
            let mut text = told.news(&app);
            if text.is_empty() && quiet >= KEEP_ALIVE {
                text.push_str(": still here\n\n");
            }
            quiet = if text.is_empty() { quiet + TICK } else { Duration::ZERO };
            // The connection's own limit cuts off a client that takes nothing.
            if !text.is_empty() && sender.send(text.into()).await.is_err() {
                return;
            }
            tokio::select! {
                () = tokio::time::sleep(TICK) => {}
                () = sender.closed() => return,
                _ = stopping.wait_for(|is_stopping| *is_stopping) => return,
            }
        }
    };
    tokio::spawn(telling);
    let headers = [
        (header::CONTENT_TYPE, HeaderValue::from_static(MEDIA_TYPE)),
        (header::CACHE_CONTROL, HeaderValue::from_static("no-store")),
    ];
    let events = unfold(receiver, |mut events| async move {
        let event = events.recv().await?;
        Some((Ok::<_, Infallible>(event), events))
    });
    Ok(As::new((headers, Body::from_stream(events))))
}

#[derive(Default)]
struct Told {
    /// The generation's manifest; the inner one is absent without a scene.
    scene: Option<Option<slag_common::Hash32>>,
    following: Option<FollowStatus>,
}

impl Told {
    /// Returns the changes as events; at first everything.
    fn news(&mut self, app: &App) -> String {
        let mut text = String::new();
        let snapshot = app.engine.snapshot().ok();
        let scene = snapshot.as_ref().map(|snapshot| snapshot.current.manifest_hash);
        if self.scene != Some(scene) {
            self.scene = Some(scene);
            let data = snapshot.as_ref().map(|snapshot| {
                json!({
                    "scene": snapshot.manifest.scene, "generation": snapshot.manifest.generation, "frame": FRAME,
                    "n_cells": snapshot.shards.len(), "n_objects": snapshot.objects.len(),
                    "n_bad_cells": snapshot.bad_cells.len(),
                })
            });
            push(&mut text, "generation", &data.unwrap_or(Value::Null));
        }
        let following = app.following.as_ref().map(|following| following.status());
        if following.is_some() && following != self.following {
            push(&mut text, "following", &json!(following));
            self.following = following;
        }
        text
    }
}

/// Writes an event; JSON has no line breaks of its own.
fn push(text: &mut String, name: &str, data: &Value) {
    text.push_str(&format!("event: {name}\ndata: {data}\n\n"));
}

pub struct Events;

impl Described for Events {
    fn replies(schemas: &mut SchemaGenerator) -> Vec<Reply> {
        vec![Reply::ok(MEDIA_TYPE, schemas.subschema_for::<String>())]
    }
}
