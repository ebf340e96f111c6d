//! A request's body, with a deadline and a greatest length.

use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use axum::body::{Body, Bytes};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use hyper::body::{Body as _, Frame, SizeHint};
use tokio::time::{Instant, Sleep, sleep_until};

use crate::problem::Problem;

type BoxError = Box<dyn std::error::Error + Send + Sync>;

/// A body was not complete in time.
#[derive(Clone, Copy, Debug, thiserror::Error)]
#[error("the body was not complete {} s after the head", after.as_secs_f64())]
struct TooSlow {
    after: Duration,
}

/// A body that fails once its deadline passes; the deadline counts from the end of the head.
pub(crate) struct TimedBody<B> {
    body: B,
    timeout: Duration,
    deadline: Instant,
    /// Made when the body first has to be waited for: most requests have none.
    sleep: Option<Pin<Box<Sleep>>>,
}

impl<B> TimedBody<B> {
    pub fn new(body: B, timeout: Duration) -> Self {
        Self { body, timeout, deadline: Instant::now() + timeout, sleep: None }
    }
}

impl<B: hyper::body::Body<Data = Bytes, Error: Into<BoxError>> + Unpin> hyper::body::Body for TimedBody<B> {
    type Data = Bytes;
    type Error = BoxError;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, BoxError>>> {
        if let Poll::Ready(frame) = Pin::new(&mut self.body).poll_frame(context) {
            return Poll::Ready(frame.map(|frame| frame.map_err(Into::into)));
        }
        let (deadline, after) = (self.deadline, self.timeout);
        let sleep = self.sleep.get_or_insert_with(|| Box::pin(sleep_until(deadline)));
        sleep.as_mut().poll(context).map(|()| Some(Err(TooSlow { after }.into())))
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

/// Reads a whole body of at most `max_bytes`.
///
/// # Errors
/// 413 if it is longer, 408 if it was not complete in time, 400 if it broke off. Each ends the connection: what is
/// left of the body is not read.
pub(crate) async fn read(mut body: Body, max_bytes: usize) -> Result<Bytes, Problem> {
    let ends = |problem: Problem| problem.with_header(header::CONNECTION, HeaderValue::from_static("close"));
    let too_long = || {
        let detail =
            format!("the request's body is longer than the {max_bytes} bytes that this resource takes");
        ends(Problem::new(StatusCode::PAYLOAD_TOO_LARGE, "body-too-large", "Body too large", detail))
    };
    if body.size_hint().lower() > max_bytes as u64 {
        return Err(too_long());
    }
    let mut whole = Vec::new();
    while let Some(frame) = std::future::poll_fn(|context| Pin::new(&mut body).poll_frame(context)).await {
        let frame = frame.map_err(|error| match too_slow(&error) {
            Some(slow) => ends(Problem::new(
                StatusCode::REQUEST_TIMEOUT,
                "body-timeout",
                "Request timeout",
                slow.to_string(),
            )),
            None => ends(Problem::new(
                StatusCode::BAD_REQUEST,
                "body-incomplete",
                "Body incomplete",
                format!("the request's body broke off: {error}"),
            )),
        })?;
        let Ok(bytes) = frame.into_data() else { continue };
        if whole.len() + bytes.len() > max_bytes {
            return Err(too_long());
        }
        whole.extend_from_slice(&bytes);
    }
    Ok(whole.into())
}

fn too_slow(error: &axum::Error) -> Option<TooSlow> {
    let mut at: Option<&(dyn std::error::Error + 'static)> = Some(error);
    while let Some(error) = at {
        if let Some(slow) = error.downcast_ref::<TooSlow>() {
            return Some(*slow);
        }
        at = error.source();
    }
    None
}

/// Refuses a body whose Content-Type is none of `media_types`: also forms and plain text, which a page of any origin
/// can post without asking.
pub(crate) fn check_type(headers: &HeaderMap, media_types: &[&str]) -> Result<(), Problem> {
    let found = headers.get(header::CONTENT_TYPE).and_then(|value| value.to_str().ok());
    let kind = found.and_then(|value| value.split(';').next()).unwrap_or_default().trim();
    if media_types.iter().any(|expected| kind.eq_ignore_ascii_case(expected)) {
        return Ok(());
    }
    let shown: String = kind.chars().take(60).collect();
    let detail = format!("the body's Content-Type is {shown:?}, expected {}", media_types.join(" or "));
    Err(Problem::new(
        StatusCode::UNSUPPORTED_MEDIA_TYPE,
        "unsupported-media-type",
        "Unsupported media type",
        detail,
    ))
}
