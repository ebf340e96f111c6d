//! The file: a channel for each topic, one message each.

use std::collections::BTreeMap;
use std::io::{BufWriter, Seek, Write};
use std::path::Path;

use anyhow::Result;
use mcap::records::MessageHeader;
use mcap::{WriteOptions, Writer};
use serde_json::Value;

use crate::schemas::Schema;

/// An MCAP file that is being written.
pub struct File<W: Write + Seek> {
    writer: Writer<W>,
    time_ns: u64,
}

impl File<BufWriter<fs_err::File>> {
    /// Creates a file. `time_ns`: time of all its messages, nanoseconds since 1970.
    pub fn create(path: &Path, time_ns: u64) -> Result<Self> {
        let options =
            WriteOptions::new().compression(None).library(concat!("slag-mcap ", env!("CARGO_PKG_VERSION")));
        let writer = Writer::with_options(BufWriter::new(fs_err::File::create(path)?), options)?;
        Ok(Self { writer, time_ns })
    }
}

impl<W: Write + Seek> File<W> {
    /// Writes a message to a topic.
    pub fn write(&mut self, topic: &str, (name, schema): Schema, message: &Value) -> Result<()> {
        let schema = self.writer.add_schema(name, "jsonschema", schema().to_string().as_bytes())?;
        let channel_id = self.writer.add_channel(schema, topic, "json", &BTreeMap::new())?;
        let header =
            MessageHeader { channel_id, sequence: 0, log_time: self.time_ns, publish_time: self.time_ns };
        Ok(self.writer.write_to_known_channel(&header, message.to_string().as_bytes())?)
    }

    /// Writes the end of the file.
    pub fn finish(mut self) -> Result<()> {
        self.writer.finish()?;
        Ok(self.writer.into_inner().flush()?)
    }
}
