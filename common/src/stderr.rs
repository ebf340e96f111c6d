//! Messages of programs besides their results.

use std::fmt::Display;
use std::io::{self, Write};

/// Writes a line to stderr; a closed reader (`| head`, a logger that ended) does not end the program.
pub fn note(text: impl Display) {
    let _ = writeln!(io::stderr(), "{text}");
}
