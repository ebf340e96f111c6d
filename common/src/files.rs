//! Files that users name, to read and to write.

use std::fs::Metadata;
use std::io::{self, Read};
use std::path::Path;

use fs_err::File;

/// Returns what the system knows of a file or folder; the error names the path.
pub fn metadata(path: &Path) -> io::Result<Metadata> {
    std::fs::metadata(path)
        .map_err(|error| io::Error::new(error.kind(), format!("{}: {error}", path.display())))
}

/// Opens a file to read. A pipe is refused, because it may never get a writer.
pub fn open(path: &Path) -> io::Result<File> {
    if std::os::unix::fs::FileTypeExt::is_fifo(&metadata(path)?.file_type()) {
        let text = format!("{} is a pipe; write what comes out of it into a file", path.display());
        return Err(io::Error::new(io::ErrorKind::InvalidInput, text));
    }
    File::open(path)
}

/// Reads a file or a shell's pipe (`--token-file <(pass show robot)`), which has no name. More than `max_bytes` are an
/// error.
pub fn read_short(path: &Path, max_bytes: u64) -> io::Result<Vec<u8>> {
    let has_name = std::fs::canonicalize(path).is_ok();
    let file = if has_name { open(path)? } else { File::open(path)? };
    let mut bytes = Vec::new();
    file.take(max_bytes.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > max_bytes {
        let text =
            format!("{} is longer than {max_bytes} bytes, the most that is read of it", path.display());
        return Err(io::Error::new(io::ErrorKind::InvalidInput, text));
    }
    Ok(bytes)
}

/// Reads a file of poses, masks or settings: none has 4 GiB, but `/dev/zero` has no end.
pub fn read(path: &Path) -> io::Result<Vec<u8>> {
    read_short(path, 1 << 32)
}

/// What a file holds in place of what was expected, and what to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{what}; {advice}")]
pub struct WrongContent {
    pub what: &'static str,
    pub advice: &'static str,
}

/// Returns the text of a file without its byte order mark, which editors and shells of Windows write.
pub fn text_of(bytes: &[u8]) -> Result<&str, WrongContent> {
    // Without a mark, every second byte of ASCII text in UTF-16 is 0.
    let is_utf16 = match bytes {
        [0xff, 0xfe, ..] | [0xfe, 0xff, ..] => true,
        [a, 0, b, 0, ..] | [0, a, 0, b, ..] => *a > 0 && *b > 0,
        _ => false,
    };
    if is_utf16 {
        let advice = "save it as UTF-8, or convert it with iconv -f UTF-16 -t UTF-8";
        return Err(WrongContent { what: "the text is UTF-16, expected UTF-8", advice });
    }
    let packed = match bytes {
        [0x1f, 0x8b, ..] => Some("the file is packed with gzip, expected text"),
        [b'P', b'K', 3, 4, ..] => Some("the file is a zip archive, expected text"),
        [0x28, 0xb5, 0x2f, 0xfd, ..] => Some("the file is packed with zstd, expected text"),
        [0xfd, b'7', b'z', b'X', b'Z', ..] => Some("the file is packed with xz, expected text"),
        _ => None,
    };
    if let Some(what) = packed {
        return Err(WrongContent { what, advice: "unpack it, and give what was in it" });
    }
    if let Some(found) = stand_in(bytes) {
        return Err(found);
    }
    let not_utf8 = WrongContent { what: "the text is not UTF-8", advice: "save it with that encoding" };
    let text = std::str::from_utf8(bytes).map_err(|_| not_utf8)?;
    Ok(text.strip_prefix('\u{feff}').unwrap_or(text))
}

/// Checks that a file can be written, before the work for its content.
pub fn check_writable(path: &Path) -> io::Result<()> {
    match metadata(path) {
        // A pipe would wait for its reader.
        Ok(about) if !about.is_file() && !about.is_dir() => Ok(()),
        Ok(_) => fs_err::OpenOptions::new().append(true).open(path).map(drop),
        Err(_) => {
            fs_err::OpenOptions::new().write(true).create_new(true).open(path)?;
            fs_err::remove_file(path)
        }
    }
}

/// Returns what a file is if it is a well-known stand-in, by its first bytes.
pub fn stand_in(start: &[u8]) -> Option<WrongContent> {
    match start.trim_ascii_start() {
        [b'v', b'e', b'r', b's', b'i', b'o', b'n', b' ', b'h', b't', b't', b'p', ..] => {
            let advice = "bring the file itself with `git lfs pull`";
            Some(WrongContent { what: "this is a pointer of Git LFS", advice })
        }
        [b'<', b'!' | b'?' | b'h' | b'H', ..] => {
            let advice = "the download was refused or needs a login: download the file itself";
            Some(WrongContent { what: "this is a web page", advice })
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slag_test_support::assert_error;

    #[test]
    fn pipes_are_refused_at_once() {
        let dir = tempfile::tempdir().expect("a folder");
        let pipe = dir.path().join("pipe");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().expect("runs").success());
        assert!(open(&pipe).expect_err("is refused").to_string().contains("is a pipe"));
        let missing = pipe.with_extension("ply");
        let said = format!("{}: No such file", missing.display());
        assert!(open(&missing).expect_err("is missing").to_string().starts_with(&said));
        assert!(read_short(&pipe, 9).expect_err("is refused").to_string().contains("is a pipe"));
        assert!(open(Path::new("/dev/null")).is_ok());
        assert_error(read_short(Path::new("/dev/zero"), 9), &["longer than 9 bytes"]);
    }

    #[test]
    fn a_shells_pipe_is_read() {
        use std::io::Write;
        use std::os::fd::AsRawFd;

        let (reader, mut writer) = io::pipe().expect("a pipe");
        writer.write_all(b"secret").expect("it takes some bytes");
        drop(writer);
        let path = format!("/dev/fd/{}", reader.as_raw_fd());
        assert_eq!(read_short(Path::new(&path), 100).expect("it is read"), b"secret");
    }

    #[test]
    fn what_stands_in_a_files_place_is_named() {
        let named = |start: &[u8]| stand_in(start).map(|found| found.what);
        let pointer = named(b"version https://git-lfs.github.com/spec/v1\n");
        assert_eq!(pointer, Some("this is a pointer of Git LFS"));
        assert_eq!(named(b"\n<html><body>Please log in"), Some("this is a web page"));
        assert_eq!(named(b"<!DOCTYPE html>"), Some("this is a web page"));
        for other in [&b"ply\nformat"[..], b"version 2", b"<svg", b"<", b""] {
            assert_eq!(named(other), None);
        }
    }

    #[test]
    fn texts_of_windows_are_read_and_other_files_are_named() {
        let of = |bytes: &[u8]| text_of(bytes).map(str::to_owned).map_err(|found| found.to_string());
        assert_eq!(of("\u{feff}[ä]".as_bytes()), Ok("[ä]".into()));
        for text in ["", "{", &"\0".repeat(9)] {
            assert_eq!(of(text.as_bytes()), Ok(text.into()));
        }
        let named = |bytes: &[u8], word: &str| {
            let said = of(bytes).expect_err("is refused");
            assert!(said.contains(word), "{said}");
        };
        let units = |text: &str| text.encode_utf16().collect::<Vec<u16>>();
        for text in ["\u{feff}[1]", "[1]"] {
            named(&units(text).into_iter().flat_map(u16::to_le_bytes).collect::<Vec<u8>>(), "iconv");
            named(&units(text).into_iter().flat_map(u16::to_be_bytes).collect::<Vec<u8>>(), "iconv");
        }
        named(b"caf\xe9", "not UTF-8");
        named(b"\x1f\x8b\x08\0", "gzip");
        named(b"PK\x03\x04", "zip archive");
        named(b"<html>", "web page");
    }

    #[test]
    fn results_are_writable_where_they_can_be() {
        let dir = tempfile::tempdir().expect("a folder");
        let (new, kept) = (dir.path().join("new"), dir.path().join("kept"));
        fs_err::write(&kept, "kept").expect("it is writable");
        assert!(check_writable(&new).is_ok() && !new.exists());
        assert!(check_writable(&kept).is_ok() && fs_err::read(&kept).expect("it is there") == b"kept");
        for (wrong, what) in [(dir.path().to_owned(), "directory"), (new.join("below"), "No such file")] {
            assert!(check_writable(&wrong).expect_err("is refused").to_string().contains(what));
        }
        assert!(check_writable(Path::new("/dev/stdout")).is_ok());
    }
}
