//! Byte ranges and entity tags of HTTP (RFC 9110, sections 8.8, 13 and 14).

use std::fmt;
use std::ops::RangeInclusive;

use axum::http::{HeaderMap, Method, header};

/// A strong entity tag: equal tags mean equal bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EntityTag(String);

impl EntityTag {
    /// Makes the tag from a name of the bytes, such as their hash.
    pub fn new(name: impl fmt::Display) -> Self {
        Self(format!("\"{name}\""))
    }

    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// Returns whether the client already has this representation (`If-None-Match`, weak comparison, 13.1.2).
    pub fn is_known_to(&self, headers: &HeaderMap) -> bool {
        let values = headers.get_all(header::IF_NONE_MATCH);
        values.iter().filter_map(|value| value.to_str().ok()).any(|value| self.is_named_in(value))
    }

    fn is_named_in(&self, if_none_match: &str) -> bool {
        let tags = || if_none_match.split(',').map(|one| one.trim_matches([' ', '\t']));
        if_none_match.trim() == "*" || tags().any(|one| one.strip_prefix("W/").unwrap_or(one) == self.0)
    }
}

/// The part of a representation that a request selects.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Selection {
    /// All of it: no range, or an ignored one (another unit, malformed, several ranges).
    Whole,
    /// Never empty.
    Part(RangeInclusive<u64>),
    /// No byte of the representation: 416.
    Unsatisfiable,
}

impl Selection {
    /// Reads `Range` and `If-Range` of a request for a representation of `len_bytes`.
    ///
    /// A range counts only with GET (14.2), only once, and with `If-Range` only if its tag is this one (13.1.5).
    pub fn of_request(method: &Method, headers: &HeaderMap, tag: &EntityTag, len_bytes: u64) -> Self {
        let mut ranges = headers.get_all(header::RANGE).iter();
        let (Some(range), None) = (ranges.next(), ranges.next()) else { return Self::Whole };
        let same = headers.get(header::IF_RANGE).is_none_or(|tagged| tagged.as_bytes() == tag.0.as_bytes());
        match range.to_str() {
            Ok(range) if same && method == Method::GET => Self::of_range(range, len_bytes),
            _ => Self::Whole,
        }
    }

    fn of_range(value: &str, len_bytes: u64) -> Self {
        let Some((unit, set)) = value.split_once('=') else { return Self::Whole };
        if !unit.eq_ignore_ascii_case("bytes") {
            return Self::Whole;
        }
        // List elements may be empty and have blanks around commas, but not at the ends (5.6.1.2).
        let optional_blanks = [' ', '\t'];
        if set.starts_with(optional_blanks) || set.ends_with(optional_blanks) {
            return Self::Whole;
        }
        let mut specs =
            set.split(',').map(|spec| spec.trim_matches(optional_blanks)).filter(|s| !s.is_empty());
        let (Some(spec), None) = (specs.next(), specs.next()) else { return Self::Whole };
        let Some((first, last)) = spec.split_once('-') else { return Self::Whole };
        let (Some(first), Some(last)) = (position(first), position(last)) else { return Self::Whole };
        match (first, last) {
            (None, None) => Self::Whole,
            (Some(first), Some(last)) if last < first => Self::Whole,
            (Some(first), _) if first >= len_bytes => Self::Unsatisfiable,
            (Some(first), last) => Self::Part(first..=last.unwrap_or(u64::MAX).min(len_bytes - 1)),
            (None, Some(0)) => Self::Unsatisfiable,
            // A suffix of an empty representation is satisfiable, but no `Content-Range` can express it.
            (None, Some(_)) if len_bytes == 0 => Self::Whole,
            (None, Some(suffix)) => Self::Part(len_bytes.saturating_sub(suffix)..=len_bytes - 1),
        }
    }
}

/// Parses a position: `Some(None)` without digits, `None` for anything else. Saturates beyond `u64`.
fn position(digits: &str) -> Option<Option<u64>> {
    match digits {
        "" => Some(None),
        _ if !digits.bytes().all(|b| b.is_ascii_digit()) => None,
        _ => Some(Some(digits.parse().unwrap_or(u64::MAX))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Oracle: the examples and rules of RFC 9110, 14.1.1 and 14.1.2, by hand.
    #[test]
    fn ranges_of_rfc_9110() {
        use Selection::{Part, Unsatisfiable, Whole};
        let table = [
            // 14.1.2: examples for a representation of 10000 bytes.
            ("bytes=0-499", 10_000, Part(0..=499)),
            ("bytes=500-999", 10_000, Part(500..=999)),
            ("bytes=-500", 10_000, Part(9500..=9999)),
            ("bytes=9500-", 10_000, Part(9500..=9999)),
            ("bytes=0-0", 10_000, Part(0..=0)),
            ("bytes=-1", 10_000, Part(9999..=9999)),
            ("bytes=0-0,-1", 10_000, Whole),
            ("bytes= 0-999, 4500-5499, -1000", 10_000, Whole),
            ("bytes=500-600,601-999", 10_000, Whole),
            // "if the last-pos value is absent, or greater than or equal to the current length, the
            // byte range is interpreted as the remainder".
            ("bytes=0-", 10, Part(0..=9)),
            ("bytes=0-10", 10, Part(0..=9)),
            ("bytes=9-99999999999999999999999", 10, Part(9..=9)),
            // "If the selected representation is shorter than the suffix-length, the entire".
            ("bytes=-11", 10, Part(0..=9)),
            ("bytes=-99999999999999999999999", 10, Part(0..=9)),
            // Satisfiable: "a first-pos less than the current length" or "a non-zero suffix-length".
            ("bytes=10-", 10, Unsatisfiable),
            ("bytes=10-20", 10, Unsatisfiable),
            ("bytes=99999999999999999999999-", 10, Unsatisfiable),
            ("bytes=-0", 10, Unsatisfiable),
            ("bytes=0-", 0, Unsatisfiable),
            ("bytes=-5", 0, Whole),
            // "An int-range is invalid if the last-pos value is present and less than first-pos."
            ("bytes=5-4", 10, Whole),
            ("bytes=20-10", 10, Whole),
            // 14.1: "Range units are case-insensitive"; 5.6.1.2: empty list elements.
            ("BYTES=1-2", 10, Part(1..=2)),
            ("bytes=,1-2", 10, Part(1..=2)),
            ("bytes=1-2 ,\t,", 10, Part(1..=2)),
            ("bytes=0-0", 1, Part(0..=0)),
            ("bytes=0-0", u64::MAX, Part(0..=0)),
        ];
        // Malformed, or another unit: ignored.
        let ignored = ";bytes;bytes=;bytes=-;bytes=1;bytes=a-b;bytes=+1-2;bytes=1-+2;bytes=1--2;\
            bytes=1 -2;bytes=0x1-2;bytes=\u{662}-\u{663};bytes =1-2;bytes: 1-2;seconds=1-2";
        let ignored = ignored.split(';').map(|value| (value, 10, Whole));
        for (value, len_bytes, expected) in table.into_iter().chain(ignored) {
            assert_eq!(Selection::of_range(value, len_bytes), expected, "{value:?} of {len_bytes}");
        }
    }

    #[test]
    fn tags_in_lists() {
        for (value, expected) in [
            ("\"a\"", true),
            ("W/\"a\"", true),
            ("\"b\", \"a\"", true),
            ("\"b\" ,W/\"a\"", true),
            ("*", true),
            ("\"b\"", false),
            ("a", false),
            ("\"aa\"", false),
            ("", false),
        ] {
            assert_eq!(EntityTag::new("a").is_named_in(value), expected, "{value}");
        }
    }
}
