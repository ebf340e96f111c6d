//! Writes data to stdout.

use std::io::{self, Write};

use serde::Serialize;

use super::failure::Failure;
use super::text::visible;

pub fn print_json(value: &impl Serialize) -> Result<(), Failure> {
    let text = serde_json::to_string(value).map_err(|e| Failure::failed("json", e))?;
    Ok(writeln!(io::stdout(), "{text}")?)
}

pub fn print_pairs(pairs: &[(&str, String)]) -> Result<(), Failure> {
    let width = pairs.iter().map(|(name, _)| name.len()).max().unwrap_or(0);
    let mut out = io::stdout().lock();
    for (name, value) in pairs {
        writeln!(out, "{name:width$}  {}", visible(value))?;
    }
    Ok(())
}
