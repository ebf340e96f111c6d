//! Times of metadata: `YYYY-MM-DDTHH:MM:SSZ`.

use std::time::{Duration, UNIX_EPOCH};

/// The last second of the year 9999.
const LAST_UNIX_SECS: u64 = 253_402_300_799;

/// Reads a time of metadata as seconds since 1970; `None` for other spellings and before 1970.
pub fn parse_utc(text: &str) -> Option<u64> {
    let time = humantime::parse_rfc3339(text).ok()?;
    let unix_secs = time.duration_since(UNIX_EPOCH).ok()?.as_secs();
    // Rejects fractions of seconds and leap seconds too.
    (format_utc(unix_secs) == text).then_some(unix_secs)
}

/// Writes seconds since 1970 as a time of metadata; times after the year 9999 become its last second.
pub fn format_utc(unix_secs: u64) -> String {
    let time = UNIX_EPOCH + Duration::from_secs(unix_secs.min(LAST_UNIX_SECS));
    humantime::format_rfc3339_seconds(time).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: `date -u -d TIME +%s`.
    #[test]
    fn times_agree_with_the_system_calendar() {
        for (text, secs) in [
            ("1970-01-01T00:00:00Z", 0),
            ("2000-02-29T23:59:59Z", 951_868_799),
            ("2026-11-24T01:58:50Z", 1_795_485_530),
            ("2100-03-01T00:00:00Z", 4_107_542_400),
            ("9999-12-31T23:59:59Z", 253_402_300_799),
        ] {
            assert_eq!(parse_utc(text), Some(secs), "{text}");
            assert_eq!(format_utc(secs), text);
        }
        assert_eq!(format_utc(u64::MAX), "9999-12-31T23:59:59Z");
    }

    #[test]
    fn other_spellings_are_refused() {
        for text in [
            "",
            "2026-01-01T00:00:00",
            "2026-01-01T00:00:00+00:00",
            "2026-02-29T00:00:00Z",
            "2026-13-01T00:00:00Z",
            "2026-01-01T24:00:00Z",
            "1969-12-31T23:59:59Z",
            "2026-01-01t00:00:00z",
            "+026-01-01T00:00:00Z",
            "2026-01-01T00:00:00.5Z",
            "2026-12-31T23:59:60Z",
        ] {
            assert_eq!(parse_utc(text), None, "{text}");
        }
    }
}
