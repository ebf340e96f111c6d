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
