//! The files of a store: manifest, objects with byte ranges, and metadata for clients of The Update Framework.

use std::io;
use std::marker::PhantomData;
use std::sync::Arc;

use axum::Json;
use axum::body::Body;
use axum::extract::rejection::PathRejection;
use axum::extract::{Path as UrlPath, State};
use axum::http::{HeaderMap, HeaderName, Method, StatusCode, header};
use axum::response::IntoResponse;
use schemars::SchemaGenerator;
use slag_common::Hash32;
use slag_common::manifest::Manifest;
use slag_common::tuf::Envelope;
use slag_service::problem::Problem;
use slag_service::range::{EntityTag, Selection};
use slag_service::replies::{As, Binary, Described, Reply};
use tokio::io::{AsyncReadExt, AsyncSeekExt};
use tokio_util::io::{InspectReader, ReaderStream};

use super::problem;
use super::state::{AppState, Snapshot};
use crate::store::metadata::{TIMESTAMP_FILE, read_published};

const PIECE_BYTES: usize = 64 << 10;
const JSON: [(HeaderName, &str); 1] = [(header::CONTENT_TYPE, "application/json")];
const BINARY: [(HeaderName, &str); 1] = [(header::CONTENT_TYPE, "application/octet-stream")];

/// Content with its hash as entity tag: `D`, or nothing if the client has it.
pub(super) struct Tagged<D>(PhantomData<D>);

const ETAG: &[(&str, &str)] = &[("etag", "Hash of the content.")];

impl<D: Described> Described for Tagged<D> {
    fn replies(schemas: &mut SchemaGenerator) -> Vec<Reply> {
        let mut replies = D::replies(schemas);
        replies.push(Reply { status: StatusCode::NOT_MODIFIED, content: Vec::new(), headers: ETAG });
        replies.iter_mut().for_each(|reply| reply.headers = ETAG);
        replies
    }
}

/// Bytes, or a range of them.
pub(super) struct Parts;

impl Described for Parts {
    fn replies(schemas: &mut SchemaGenerator) -> Vec<Reply> {
        let statuses = [StatusCode::OK, StatusCode::PARTIAL_CONTENT].into_iter();
        let with = |status| Binary::replies(schemas).into_iter().map(move |reply| Reply { status, ..reply });
        statuses.flat_map(with).collect()
    }
}

type TaggedManifest = As<Tagged<Json<Manifest>>>;

pub(super) async fn manifest(
    State(service): AppState,
    headers: HeaderMap,
) -> Result<TaggedManifest, Problem> {
    let published = |snapshot: &Snapshot| Ok((snapshot.reader.current().hash, snapshot.manifest.clone()));
    let (hash, bytes) = service.with_current(published).await?;
    let tag = EntityTag::new(hash);
    let about = [(header::ETAG, tag.as_str()), (header::CACHE_CONTROL, "no-cache")];
    if tag.is_known_to(&headers) {
        return Ok(As::new((StatusCode::NOT_MODIFIED, about)));
    }
    Ok(As::new((about, JSON, bytes)))
}

pub(super) async fn object(
    State(service): AppState,
    method: Method,
    hash: Result<UrlPath<Hash32>, PathRejection>,
    headers: HeaderMap,
) -> Result<As<Tagged<Parts>>, Problem> {
    let UrlPath(hash) = hash.map_err(|e| problem::bad_parameter(e.body_text()))?;
    let tag = EntityTag::new(hash);
    let about = [
        (header::ETAG, tag.as_str()),
        (header::CACHE_CONTROL, "public, max-age=31536000, immutable"),
        (header::ACCEPT_RANGES, "bytes"),
    ];
    let is_known = tag.is_known_to(&headers);
    let opened = service.with_current(move |snapshot| open_object(snapshot, hash, !is_known)).await?;
    let (Some(file), len_bytes) = opened else {
        return Ok(As::new((StatusCode::NOT_MODIFIED, about)));
    };
    let (status, start, n_bytes) = match Selection::of_request(&method, &headers, &tag, len_bytes) {
        Selection::Unsatisfiable => return Err(problem::range_not_satisfiable(len_bytes)),
        Selection::Whole => (StatusCode::OK, 0, len_bytes),
        Selection::Part(part) => (StatusCode::PARTIAL_CONTENT, *part.start(), part.end() - part.start() + 1),
    };
    let mut sizes: Vec<(HeaderName, String)> = vec![(header::CONTENT_LENGTH, n_bytes.to_string())];
    if status == StatusCode::PARTIAL_CONTENT {
        let end = start + n_bytes - 1;
        sizes.push((header::CONTENT_RANGE, format!("bytes {start}-{end}/{len_bytes}")));
    }
    let body = if method == Method::HEAD {
        Body::empty()
    } else {
        let permit = Arc::clone(&service.downloads).try_acquire_owned().map_err(|_| problem::busy())?;
        let mut file = tokio::fs::File::from_std(file);
        let sought = file.seek(io::SeekFrom::Start(start)).await;
        sought.map_err(|e| Problem::internal(format!("{hash}: {e}")))?;
        // Holds its permit until it is sent or the client is gone.
        let download = InspectReader::new(file.take(n_bytes), move |_| {
            let _held = &permit;
        });
        Body::from_stream(ReaderStream::with_capacity(download, PIECE_BYTES))
    };
    let mut response = (status, about, BINARY, body).into_response();
    for (name, value) in sizes {
        let value = value.parse().map_err(|_| Problem::internal(format!("header {name}: {value}")))?;
        response.headers_mut().insert(name, value);
    }
    Ok(As::new(response))
}

/// A listed object's length, and its file if the content is needed.
fn open_object(
    snapshot: &Snapshot,
    hash: Hash32,
    with_file: bool,
) -> Result<(Option<std::fs::File>, u64), Problem> {
    let listed = snapshot.objects.get(&hash);
    let len_bytes = *listed.ok_or_else(|| problem::not_published(&format!("object {hash}")))?;
    if !with_file {
        return Ok((None, len_bytes));
    }
    let file = fs_err::File::open(snapshot.reader.object_path(hash)).map_err(Problem::internal)?;
    let found_bytes = file.metadata().map_err(Problem::internal)?.len();
    if found_bytes != len_bytes {
        let path = file.path().display();
        let cause = format!("{path}: found {found_bytes} bytes, the manifest lists {len_bytes}");
        return Err(Problem::internal(cause));
    }
    Ok((Some(file.into_file()), len_bytes))
}

type Name = Result<UrlPath<String>, PathRejection>;

pub(super) async fn metadata(State(service): AppState, name: Name) -> Result<As<Json<Envelope>>, Problem> {
    let UrlPath(name) = name.map_err(|e| problem::bad_parameter(e.body_text()))?;
    // Only the timestamp ever changes.
    let lasting = if name == TIMESTAMP_FILE { "no-cache" } else { "public, max-age=31536000, immutable" };
    let read = service.with_current(move |snapshot| {
        let read = read_published(snapshot.reader.dir(), &name).map_err(Problem::internal)?;
        read.ok_or_else(|| problem::not_published(&format!("metadata {name}")))
    });
    let about = [(header::CONTENT_TYPE, "application/json"), (header::CACHE_CONTROL, lasting)];
    Ok(As::new((about, read.await?)))
}

pub(super) async fn target(State(service): AppState, name: Name) -> Result<As<Binary>, Problem> {
    let UrlPath(name) = name.map_err(|e| problem::bad_parameter(e.body_text()))?;
    let found = service.with_current(move |snapshot| {
        let target = snapshot.targets.get(&name).cloned();
        target.ok_or_else(|| problem::not_published(&format!("target {name}")))
    });
    Ok(As::new(([(header::CONTENT_TYPE, "application/octet-stream")], found.await?)))
}
