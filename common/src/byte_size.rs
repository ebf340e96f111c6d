//! Numbers of bytes, as flags take them and reports show them.

use std::fmt;
use std::num::IntErrorKind;
use std::str::FromStr;

/// A number of bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct ByteSize(pub u64);

/// Why a text is no number of bytes.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ByteSizeError {
    /// The unit is unknown.
    #[error("unit {0:?}: expected none, KiB, MiB or GiB, or kB, MB or GB")]
    Unit(String),
    /// It does not begin with a whole number.
    #[error("{0:?} is no number of bytes; expected for example 512MiB")]
    Number(String),
    /// It does not fit 64 bits.
    #[error("{0:?} is too large")]
    TooLarge(String),
}

/// Reads a whole number with an optional unit: `512MiB` and `512M` are binary, `512MB` is decimal.
impl FromStr for ByteSize {
    type Err = ByteSizeError;

    fn from_str(text: &str) -> Result<Self, ByteSizeError> {
        let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
        let factor: u64 = match &text[digits.len()..] {
            "" | "B" => 1,
            "KiB" | "K" | "k" => 1 << 10,
            "MiB" | "M" => 1 << 20,
            "GiB" | "G" => 1 << 30,
            "kB" | "KB" => 1_000,
            "MB" => 1_000_000,
            "GB" => 1_000_000_000,
            unit => return Err(ByteSizeError::Unit(unit.to_owned())),
        };
        let number: u64 = digits.parse().map_err(|e: std::num::ParseIntError| match e.kind() {
            IntErrorKind::PosOverflow => ByteSizeError::TooLarge(text.to_owned()),
            _ => ByteSizeError::Number(text.to_owned()),
        })?;
        let bytes = number.checked_mul(factor).ok_or_else(|| ByteSizeError::TooLarge(text.to_owned()))?;
        Ok(Self(bytes))
    }
}

/// Writes the number with one decimal in the largest decimal unit that it reaches: `52.4 MB`.
impl fmt::Display for ByteSize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut value = self.0 as f64;
        let mut unit = "B";
        for larger in ["kB", "MB", "GB", "TB", "PB", "EB"] {
            // What would be rounded to 1000.0 is 1.0 of the next unit.
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
mod tests {
    use super::*;

    /// By hand.
    #[test]
    fn texts_have_binary_units() {
        let read = |text: &str| text.parse::<ByteSize>().map(|size| size.0).map_err(|e| e.to_string());
        let good = [
            ("0", 0),
            ("67108864", 67_108_864),
            ("7B", 7),
            ("3KiB", 3072),
            ("512MiB", 536_870_912),
            ("2GiB", 2_147_483_648),
            ("2G", 2_147_483_648),
            ("2GB", 2_000_000_000),
            ("512M", 536_870_912),
            ("5kB", 5000),
            ("18446744073709551615", u64::MAX),
        ];
        for (text, bytes) in good {
            assert_eq!(read(text), Ok(bytes), "{text}");
        }
        for text in ["", "GiB", "-1", "1.5GiB", "2 GiB", "²GiB", "2GiB "] {
            let message = format!("{text:?} is no number of bytes; expected for example 512MiB");
            assert_eq!(read(text), Err(message));
        }
        for text in ["99999999999GiB", "17179869184GiB", "18446744073709551616"] {
            assert_eq!(read(text), Err(format!("{text:?} is too large")));
        }
        for unit in ["T", "gb", "gib", "TiB"] {
            let message = format!("unit {unit:?}: expected none, KiB, MiB or GiB, or kB, MB or GB");
            assert_eq!(read(&format!("2{unit}")), Err(message));
        }
    }

    /// By hand.
    #[test]
    fn reports_have_decimal_units() {
        let cases = [
            (0, "0 B"),
            (999, "999 B"),
            (1000, "1.0 kB"),
            (1023, "1.0 kB"),
            (1550, "1.6 kB"),
            (999_949, "999.9 kB"),
            (999_950, "1.0 MB"),
            (52_428_800, "52.4 MB"),
            (2_147_483_648, "2.1 GB"),
            (u64::MAX, "18.4 EB"),
        ];
        for (bytes, text) in cases {
            assert_eq!(ByteSize(bytes).to_string(), text);
        }
        assert_eq!(format!("{:>9}|{:<9}|", ByteSize(999), ByteSize(1000)), "    999 B|1.0 kB   |");
    }
}
