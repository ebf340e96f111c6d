//! A request's body, with a deadline and a length limit.

use std::future::poll_fn;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use axum::body::{Body, Bytes};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use hyper::body::{Body as _, Frame, Incoming, SizeHint};
use tokio::runtime::Handle;
use tokio::sync::{Semaphore, SemaphorePermit};
use tokio::time::{Instant, Sleep, sleep_until};

use crate::problem::Problem;

/// Most bytes of a refused body that are drained: enough for one just beyond the longest JSON body, 1 MiB.
const DRAINED_BYTES: usize = 2 << 20;
/// Bytes of a body that are read without taking room.
const SHORT_BYTES: usize = 64 << 10;
/// Memory for all longer bodies in progress: four of the longest photos.
pub(crate) const ROOM_BYTES: usize = 128 << 20;
/// `Retry-After` if there is no room.
const RETRY_SECS: u32 = 1;
/// Longest time of draining.
const DRAIN_TIME: Duration = Duration::from_secs(1);

type BoxError = Box<dyn std::error::Error + Send + Sync>;

#[derive(Debug, thiserror::Error)]
#[error("the body was not complete {} s after the head", after.as_secs_f64())]
struct TooSlow {
    after: Duration,
}

/// A body that fails at its deadline, counted from the end of the head. When dropped, its rest is drained within
/// [`DRAINED_BYTES`] and [`DRAIN_TIME`]: closing on unread bytes would reset the connection and lose the answer.
pub(crate) struct TimedBody {
    /// Absent once it ended or failed.
    body: Option<Incoming>,
    timeout: Duration,
    deadline: Instant,
    /// Made when the body is first waited for: most requests have none.
    sleep: Option<Pin<Box<Sleep>>>,
    /// Whether the client waits for `100 Continue`; then nothing is in transit.
    waits_for_leave: bool,
}

impl TimedBody {
    pub fn new(body: Incoming, headers: &HeaderMap, timeout: Duration) -> Self {
        let waits_for_leave = headers.contains_key(header::EXPECT);
        Self { body: Some(body), timeout, deadline: Instant::now() + timeout, sleep: None, waits_for_leave }
    }
}

impl hyper::body::Body for TimedBody {
    type Data = Bytes;
    type Error = BoxError;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, BoxError>>> {
        let Some(body) = &mut self.body else { return Poll::Ready(None) };
        if let Poll::Ready(frame) = Pin::new(body).poll_frame(context) {
            if !matches!(frame, Some(Ok(_))) {
                self.body = None;
            }
            return Poll::Ready(frame.map(|frame| frame.map_err(Into::into)));
        }
        let (deadline, after) = (self.deadline, self.timeout);
        let sleep = self.sleep.get_or_insert_with(|| Box::pin(sleep_until(deadline)));
        if sleep.as_mut().poll(context).is_pending() {
            return Poll::Pending;
        }
        self.body = None;
        Poll::Ready(Some(Err(TooSlow { after }.into())))
    }

    fn is_end_stream(&self) -> bool {
        self.body.as_ref().is_none_or(Incoming::is_end_stream)
    }

    fn size_hint(&self) -> SizeHint {
        self.body.as_ref().map_or(SizeHint::with_exact(0), Incoming::size_hint)
    }
}

impl Drop for TimedBody {
    fn drop(&mut self) {
        let is_under_way = !self.waits_for_leave && !hyper::body::Body::is_end_stream(self);
        let Some(mut body) = self.body.take().filter(|_| is_under_way) else { return };
        let Ok(runtime) = Handle::try_current() else { return };
        let draining = async move {
            let mut n_bytes = 0;
            while n_bytes < DRAINED_BYTES {
                let frame = poll_fn(|context| Pin::new(&mut body).poll_frame(context)).await;
                let Some(Ok(frame)) = frame else { return };
                n_bytes += frame.data_ref().map_or(0, Bytes::len);
            }
        };
        // Beyond either bound the connection is closed on the rest.
        runtime.spawn(tokio::time::timeout(DRAIN_TIME, draining));
    }
}

struct Held {
    bytes: Vec<u8>,
    room: Option<SemaphorePermit<'static>>,
}

impl AsRef<[u8]> for Held {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

impl Held {
    /// Makes space for `len` bytes of at most `max`; returns whether there is room.
    fn grow(&mut self, len: usize, max: usize, all: &'static Semaphore) -> bool {
        if len <= self.bytes.capacity() {
            return true;
        }
        let capacity = len.max(2 * self.bytes.capacity()).min(max);
        let taken = self.room.as_ref().map_or(0, SemaphorePermit::num_permits);
        if capacity > SHORT_BYTES {
            let wanted = u32::try_from(capacity - taken).unwrap_or(u32::MAX);
            let Ok(more) = all.try_acquire_many(wanted) else { return false };
            match &mut self.room {
                Some(room) => room.merge(more),
                none => *none = Some(more),
            }
        }
        self.bytes.reserve_exact(capacity - self.bytes.len());
        true
    }
}

/// Reads a whole body of at most `max_bytes`. `all`: room for long bodies, held until this one is dropped.
///
/// # Errors
/// 413 if it is longer, 408 if it was not complete in time, 400 if it broke off, 503 if there is no room. Each ends
/// the connection.
pub(crate) async fn read(
    mut body: Body,
    max_bytes: usize,
    all: &'static Semaphore,
) -> Result<Bytes, Problem> {
    let ends = |problem: Problem| problem.with_header(header::CONNECTION, HeaderValue::from_static("close"));
    let too_long = || {
        let detail =
            format!("the request's body is longer than the {max_bytes} bytes that this resource takes");
        ends(Problem::new(StatusCode::PAYLOAD_TOO_LARGE, "body-too-large", "Body too large", detail))
    };
    if body.size_hint().lower() > max_bytes as u64 {
        return Err(too_long());
    }
    let mut whole = Held { bytes: Vec::new(), room: None };
    while let Some(frame) = poll_fn(|context| Pin::new(&mut body).poll_frame(context)).await {
        let frame = frame.map_err(|error| {
            ends(match too_slow(&error) {
                Some(slow) => {
                    let status = StatusCode::REQUEST_TIMEOUT;
                    Problem::new(status, "body-timeout", "Request timeout", slow.to_string())
                }
                None => {
                    let detail = format!("the request's body broke off: {error}");
                    Problem::new(StatusCode::BAD_REQUEST, "body-incomplete", "Body incomplete", detail)
                }
            })
        })?;
        let Ok(bytes) = frame.into_data() else { continue };
        let len = whole.bytes.len() + bytes.len();
        if len > max_bytes {
            return Err(too_long());
        }
        if !whole.grow(len, max_bytes, all) {
            let detail = "the bodies of other requests in progress fill the room for them; ask again";
            return Err(ends(Problem::overloaded(detail, RETRY_SECS)));
        }
        whole.bytes.extend_from_slice(&bytes);
    }
    Ok(Bytes::from_owner(whole))
}

fn too_slow(error: &axum::Error) -> Option<&TooSlow> {
    let first: &(dyn std::error::Error + 'static) = error;
    std::iter::successors(Some(first), |error| error.source()).find_map(|error| error.downcast_ref())
}

/// Refuses a Content-Type outside `media_types`; any page may post forms and plain text without a preflight.
pub(crate) fn check_type(headers: &HeaderMap, media_types: &[&str]) -> Result<(), Problem> {
    let found = headers.get(header::CONTENT_TYPE).and_then(|value| value.to_str().ok());
    let mut parts = found.unwrap_or_default().split(';').map(str::trim);
    let kind = parts.next().unwrap_or_default();
    if media_types.iter().any(|expected| kind.eq_ignore_ascii_case(expected)) {
        let charset = |part: &&str| part.get(..8).is_some_and(|name| name.eq_ignore_ascii_case("charset="));
        let is_utf8 = |part: &str| {
            ["utf-8", "utf8", "us-ascii"]
                .iter()
                .any(|name| part[8..].trim_matches('"').eq_ignore_ascii_case(name))
        };
        return match parts.find(charset).filter(|part| !is_utf8(part)) {
            None => Ok(()),
            Some(_) if kind.starts_with("image/") => Ok(()),
            Some(part) => {
                let shown: String = part.chars().take(60).collect();
                Err(unsupported(format!("the body's Content-Type has {shown:?}, expected charset=utf-8")))
            }
        };
    }
    let shown: String = kind.chars().take(60).collect();
    Err(unsupported(format!("the body's Content-Type is {shown:?}, expected {}", media_types.join(" or "))))
}

/// Refuses a compressed body: nothing here decompresses, so that a few bytes cannot become many.
pub(crate) fn check_encoding(headers: &HeaderMap) -> Result<(), Problem> {
    let values = headers.get_all(header::CONTENT_ENCODING).iter();
    let found: Vec<_> = values.map(|value| String::from_utf8_lossy(value.as_bytes())).collect();
    let found = found.join(", ");
    let is_none = |coding: &str| coding.is_empty() || coding.eq_ignore_ascii_case("identity");
    if found.split(',').all(|coding| is_none(coding.trim())) {
        return Ok(());
    }
    let shown: String = found.chars().take(60).collect();
    let detail = format!("the body's Content-Encoding is {shown:?}, expected none; send the body as it is");
    Err(unsupported(detail).with_header(header::ACCEPT_ENCODING, HeaderValue::from_static("identity")))
}

fn unsupported(detail: String) -> Problem {
    let status = StatusCode::UNSUPPORTED_MEDIA_TYPE;
    Problem::new(status, "unsupported-media-type", "Unsupported media type", detail)
}

#[cfg(test)]
mod tests {
    use axum::response::IntoResponse;

    use super::*;

    /// When long bodies fill their room, further ones are refused and short ones are still read.
    #[tokio::test]
    async fn bodies_have_room_for_some_at_a_time() {
        static ROOM: Semaphore = Semaphore::const_new(1 << 20);
        let of = async |len: usize| read(Body::from(vec![7; len]), 400 << 10, &ROOM).await;
        let mut held = Vec::new();
        let refused = loop {
            match of(400 << 10).await {
                Ok(body) => held.push(body),
                Err(refused) => break refused,
            }
            assert!(held.len() <= 2, "more than there is room for");
        };
        assert!(held.len() == 2 && held.iter().all(|body| body.len() == 400 << 10));
        assert_eq!(refused.into_response().status(), StatusCode::SERVICE_UNAVAILABLE);
        assert!(of(SHORT_BYTES).await.is_ok());
        held.pop();
        assert!(of(400 << 10).await.is_ok());
        drop(held);
        assert_eq!(ROOM.available_permits(), 1 << 20, "all is given back");
    }
}
