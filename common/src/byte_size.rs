//! Numbers of bytes in flags and reports.

use std::fmt;
use std::num::IntErrorKind;
use std::str::FromStr;

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct ByteSize(pub u64);

/// Reads a whole number with an optional unit: `512MiB` and `512M` are binary, `512MB` is decimal.
impl FromStr for ByteSize {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
        let factor: u64 = match &text[digits.len()..] {
            "" | "B" => 1,
            "KiB" | "K" | "k" => 1 << 10,
            "MiB" | "M" => 1 << 20,
            "GiB" | "G" => 1 << 30,
            "kB" | "KB" => 1_000,
            "MB" => 1_000_000,
            "GB" => 1_000_000_000,
            unit => return Err(format!("unit {unit:?}: expected none, KiB, MiB or GiB, or kB, MB or GB")),
        };
        let too_large = || format!("{text:?} is too large");
        let number: u64 = digits.parse().map_err(|e: std::num::ParseIntError| match e.kind() {
            IntErrorKind::PosOverflow => too_large(),
            _ => format!("{text:?} is no number of bytes; expected for example 512MiB"),
        })?;
        number.checked_mul(factor).map(Self).ok_or_else(too_large)
    }
}

/// Writes the number with one decimal in the largest decimal unit that it reaches: `52.4 MB`.
impl fmt::Display for ByteSize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut value = self.0 as f64;
        let mut unit = "B";
        for larger in ["kB", "MB", "GB", "TB", "PB", "EB"] {
            // Numbers that round to 1000.0 are 1.0 of the next unit.
            let least = if unit == "B" { 1000.0 } else { 999.95 };
            if value < least {
                break;
            }
            (value, unit) = (value / 1000.0, larger);
        }
        f.pad(&if unit == "B" { format!("{value} B") } else { format!("{value:.1} {unit}") })
    }
}

#[cfg(test)]
mod tests;
