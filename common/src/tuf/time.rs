//! Times of metadata: `YYYY-MM-DDTHH:MM:SSZ`.

const SECS_PER_DAY: u64 = 86_400;

/// Reads a time of metadata as seconds since 1970; `None` for any other spelling, and before 1970.
pub fn parse_utc(text: &str) -> Option<u64> {
    let bytes = text.as_bytes();
    let pattern = b"dddd-dd-ddTdd:dd:ddZ";
    let fits = |(found, expected): (&u8, &u8)| match expected {
        b'd' => found.is_ascii_digit(),
        _ => found == expected,
    };
    if bytes.len() != pattern.len() || !bytes.iter().zip(pattern).all(fits) {
        return None;
    }
    let number = |from: usize, to: usize| text.get(from..to)?.parse::<u64>().ok();
    let (year, month, day) = (number(0, 4)?, number(5, 7)?, number(8, 10)?);
    let (hour, minute, second) = (number(11, 13)?, number(14, 16)?, number(17, 19)?);
    if year < 1970 || !(1..=12).contains(&month) || day == 0 || day > days_in_month(year, month) {
        return None;
    }
    if hour > 23 || minute > 59 || second > 59 {
        return None;
    }
    let days = days_before_year(year) + (1..month).map(|m| days_in_month(year, m)).sum::<u64>() + day - 1;
    Some(days * SECS_PER_DAY + hour * 3600 + minute * 60 + second)
}

/// Writes seconds since 1970 as a time of metadata; times after the year 9999 become its last second.
pub fn format_utc(unix_secs: u64) -> String {
    let last = days_before_year(10_000) * SECS_PER_DAY - 1;
    let unix_secs = unix_secs.min(last);
    let (mut days, secs) = (unix_secs / SECS_PER_DAY, unix_secs % SECS_PER_DAY);
    // At most one year too early, as a year is never longer than 366 days.
    let mut year = 1970 + days / 366;
    while days_before_year(year + 1) <= days {
        year += 1;
    }
    days -= days_before_year(year);
    let mut month = 1;
    while days >= days_in_month(year, month) {
        days -= days_in_month(year, month);
        month += 1;
    }
    let (hour, minute, second) = (secs / 3600, secs / 60 % 60, secs % 60);
    format!("{year:04}-{month:02}-{:02}T{hour:02}:{minute:02}:{second:02}Z", days + 1)
}

fn is_leap(year: u64) -> bool {
    year.is_multiple_of(4) && (!year.is_multiple_of(100) || year.is_multiple_of(400))
}

fn days_in_month(year: u64, month: u64) -> u64 {
    match month {
        2 if is_leap(year) => 29,
        2 => 28,
        4 | 6 | 9 | 11 => 30,
        _ => 31,
    }
}

fn days_before_year(year: u64) -> u64 {
    let leap_days = |year: u64| year / 4 - year / 100 + year / 400;
    (year - 1970) * 365 + leap_days(year - 1) - leap_days(1969)
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
    fn every_day_goes_round() {
        for day in 0..60_000 {
            assert_eq!(parse_utc(&format_utc(day * SECS_PER_DAY + 1)), Some(day * SECS_PER_DAY + 1));
        }
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
        ] {
            assert_eq!(parse_utc(text), None, "{text}");
        }
    }
}
