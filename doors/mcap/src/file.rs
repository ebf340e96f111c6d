//! The file: one channel per topic with one message each, and its schema.

use std::collections::BTreeMap;
use std::io::{Seek, Write};

use anyhow::Result;
use mcap::records::MessageHeader;
use mcap::{WriteOptions, Writer};
use serde_json::{Value, json};

pub struct File<W: Write + Seek> {
    writer: Writer<W>,
    time_ns: u64,
}

impl<W: Write + Seek> File<W> {
    /// Starts a file. `time_ns`: time of all its messages, nanoseconds since 1970.
    pub fn new(out: W, time_ns: u64) -> Result<Self> {
        let options =
            WriteOptions::new().compression(None).library(concat!("slag-mcap ", env!("CARGO_PKG_VERSION")));
        Ok(Self { writer: Writer::with_options(out, options)?, time_ns })
    }

    pub fn write(&mut self, topic: &str, (name, schema): Schema, message: &Value) -> Result<()> {
        let schema = self.writer.add_schema(name, "jsonschema", schema().to_string().as_bytes())?;
        let channel_id = self.writer.add_channel(schema, topic, "json", &BTreeMap::new())?;
        let header =
            MessageHeader { channel_id, sequence: 0, log_time: self.time_ns, publish_time: self.time_ns };
        Ok(self.writer.write_to_known_channel(&header, message.to_string().as_bytes())?)
    }

    pub fn finish(mut self) -> Result<()> {
        self.writer.finish()?;
        Ok(())
    }
}

pub type Schema = (&'static str, fn() -> Value);

pub const THINGS: Schema = ("foxglove.SceneUpdate", scene_update);
pub const POINTS: Schema = ("foxglove.PointCloud", point_cloud);
pub const GROUND: Schema = ("foxglove.Grid", grid);

fn numbers(names: &[&str]) -> Value {
    let properties: serde_json::Map<_, _> =
        names.iter().map(|name| ((*name).to_owned(), json!({"type": "number"}))).collect();
    json!({"type": "object", "properties": properties})
}

fn time() -> Value {
    json!({"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}})
}

fn pose() -> Value {
    let (position, orientation) = (numbers(&["x", "y", "z"]), numbers(&["x", "y", "z", "w"]));
    json!({"type": "object", "properties": {"position": position, "orientation": orientation}})
}

fn list(of: &Value) -> Value {
    json!({"type": "array", "items": of})
}

fn scene_update() -> Value {
    let (colour, any) = (numbers(&["r", "g", "b", "a"]), list(&json!({"type": "object"})));
    let cube = json!({"type": "object", "properties": {"pose": pose(), "size": numbers(&["x", "y", "z"]), "color": colour}});
    let text = json!({"type": "object", "properties": {
        "pose": pose(), "billboard": {"type": "boolean"}, "font_size": {"type": "number"}, "scale_invariant": {"type": "boolean"},
        "color": colour, "text": {"type": "string"},
    }});
    let pair =
        json!({"type": "object", "properties": {"key": {"type": "string"}, "value": {"type": "string"}}});
    let entity = json!({"type": "object", "properties": {
        "timestamp": time(), "frame_id": {"type": "string"}, "id": {"type": "string"}, "lifetime": time(),
        "frame_locked": {"type": "boolean"}, "metadata": list(&pair), "arrows": any, "cubes": list(&cube), "spheres": any,
        "cylinders": any, "lines": any, "triangles": any, "texts": list(&text), "models": any,
    }});
    json!({"title": "foxglove.SceneUpdate", "type": "object", "properties": {"deletions": any, "entities": list(&entity)}})
}

fn fields() -> Value {
    list(&json!({"type": "object", "properties": {
        "name": {"type": "string"}, "offset": {"type": "integer"}, "type": {"type": "integer"},
    }}))
}

fn point_cloud() -> Value {
    json!({"title": "foxglove.PointCloud", "type": "object", "properties": {
        "timestamp": time(), "frame_id": {"type": "string"}, "pose": pose(), "point_stride": {"type": "integer"}, "fields": fields(),
        "data": {"type": "string", "contentEncoding": "base64"},
    }})
}

fn grid() -> Value {
    json!({"title": "foxglove.Grid", "type": "object", "properties": {
        "timestamp": time(), "frame_id": {"type": "string"}, "pose": pose(), "column_count": {"type": "integer"},
        "cell_size": numbers(&["x", "y"]), "row_stride": {"type": "integer"}, "cell_stride": {"type": "integer"}, "fields": fields(),
        "data": {"type": "string", "contentEncoding": "base64"},
    }})
}
