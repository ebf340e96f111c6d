//! Gaussians as columns: an Arrow IPC stream (<https://arrow.apache.org/docs/format/Columnar.html>).
//!
//! | column | type | content |
//! |---|---|---|
//! | `question` | u32 | index of the text; only if there are several |
//! | `x`, `y`, `z` | f64 | the mean, world frame |
//! | `score` | f32 | as in JSON |
//! | `cell` | u32 | the cell |
//! | `index` | u32 | index in the cell's shard |
//!
//! The schema's metadata: `scene`, `generation`, `frame` (`world`), `unit`, `score_kind`, `threshold` and
//! `score_error_bound` (of the first text), `questions` (the JSON of each text without its answers), and
//! `geo_reference` if the scene has one.

use std::collections::HashMap;
use std::io;
use std::sync::Arc;

use arrow_array::{ArrayRef, Float32Array, Float64Array, RecordBatch, UInt32Array};
use arrow_ipc::writer::StreamWriter;
use arrow_schema::{ArrowError, DataType, Field, Schema};

use super::answers::{Found, Reply};
use crate::score::Hit;

/// Rows per batch: half a megabyte.
const BATCH_ROWS: usize = 16 << 10;

pub struct Pieces {
    reply: Arc<Reply>,
    schema: Arc<Schema>,
    writer: Option<StreamWriter<Vec<u8>>>,
    question: usize,
    item: usize,
    is_closed: bool,
}

impl Pieces {
    pub fn new(reply: Arc<Reply>) -> Self {
        let schema = Arc::new(schema(&reply));
        Self { reply, schema, writer: None, question: 0, item: 0, is_closed: false }
    }

    fn piece(&mut self) -> Result<Vec<u8>, ArrowError> {
        let Some(writer) = &mut self.writer else {
            let mut writer = StreamWriter::try_new(Vec::new(), &self.schema)?;
            let piece = std::mem::take(writer.get_mut());
            self.writer = Some(writer);
            return Ok(piece);
        };
        let gaussians = |question: usize| match self.reply.answers.get(question).map(|a| &a.answers) {
            Some(Found::Gaussians(hits)) => Some(&hits[..]),
            Some(Found::Clusters(_)) => Some(&[][..]),
            None => None,
        };
        while gaussians(self.question).is_some_and(|hits| self.item == hits.len()) {
            (self.question, self.item) = (self.question + 1, 0);
        }
        match gaussians(self.question) {
            Some(hits) => {
                let end = hits.len().min(self.item + BATCH_ROWS);
                writer.write(&batch(&self.reply, &self.schema, self.question, &hits[self.item..end])?)?;
                self.item = end;
            }
            None => {
                writer.finish()?;
                self.is_closed = true;
            }
        }
        Ok(std::mem::take(writer.get_mut()))
    }
}

impl Iterator for Pieces {
    type Item = io::Result<Vec<u8>>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.is_closed {
            return None;
        }
        let piece = self.piece();
        self.is_closed |= piece.is_err();
        Some(piece.map_err(io::Error::other))
    }
}

fn schema(reply: &Reply) -> Schema {
    let column = |name: &str, kind: DataType| Field::new(name, kind, false);
    let mut columns = Vec::new();
    if reply.answers.len() != 1 {
        columns.push(column("question", DataType::UInt32));
    }
    columns.extend(["x", "y", "z"].map(|name| column(name, DataType::Float64)));
    columns.push(column("score", DataType::Float32));
    columns.extend(["cell", "index"].map(|name| column(name, DataType::UInt32)));

    let manifest = &reply.snapshot.manifest;
    // Text and numbers always serialise.
    let json = |value: serde_json::Result<String>| value.unwrap_or_default();
    let mut metadata = HashMap::from([
        ("scene".to_owned(), manifest.scene.clone()),
        ("generation".to_owned(), manifest.generation.to_string()),
        ("frame".to_owned(), "world".to_owned()),
        ("questions".to_owned(), json(serde_json::to_string(&reply.answers))),
    ]);
    if let Some(first) = reply.answers.first() {
        let kind = serde_json::to_value(first.searched.score_kind).ok();
        let kind = kind.as_ref().and_then(|kind| kind.as_str()).unwrap_or_default();
        metadata.insert("unit".into(), first.unit.into());
        metadata.insert("score_kind".into(), kind.into());
        metadata.insert("threshold".into(), first.searched.threshold.to_string());
        metadata.insert("score_error_bound".into(), first.searched.score_error_bound.to_string());
    }
    if let Some(geo_reference) = &manifest.geo_reference {
        metadata.insert("geo_reference".into(), json(serde_json::to_string(geo_reference)));
    }
    Schema::new(columns).with_metadata(metadata)
}

fn batch(
    reply: &Reply,
    schema: &Arc<Schema>,
    question: usize,
    hits: &[Hit],
) -> Result<RecordBatch, ArrowError> {
    let views: Vec<_> = reply.snapshot.shards.iter().map(|shard| shard.view()).collect();
    let shard = |hit: &Hit| &views[hit.shard as usize];
    let positions: Vec<_> = hits.iter().map(|hit| shard(hit).position_in_world(hit.index as usize)).collect();
    let along = |axis: usize| {
        Arc::new(Float64Array::from_iter_values(positions.iter().map(|position| position[axis])))
    };
    let mut columns: Vec<ArrayRef> = Vec::new();
    if reply.answers.len() != 1 {
        columns.push(Arc::new(UInt32Array::from_value(question as u32, hits.len())));
    }
    columns.extend((0..3).map(|axis| along(axis) as ArrayRef));
    columns.push(Arc::new(Float32Array::from_iter_values(hits.iter().map(|hit| hit.score))));
    columns.push(Arc::new(UInt32Array::from_iter_values(hits.iter().map(|hit| shard(hit).header.cell_id))));
    columns.push(Arc::new(UInt32Array::from_iter_values(hits.iter().map(|hit| hit.index))));
    RecordBatch::try_new(Arc::clone(schema), columns)
}
