//! What programs tell people beside their results.

use std::fmt::Display;
use std::io::{self, Write};

/// Writes a line to stderr. That its reader is gone (a logger that ended, `| head`) ends no program.
pub fn note(text: impl Display) {
    let _ = writeln!(io::stderr(), "{text}");
}
