//! Opening files that users name.

use std::io;
use std::path::Path;

use fs_err::File;

/// Opens a file to read. A pipe is refused: it keeps its reader waiting until somebody writes, perhaps for ever.
pub fn open(path: &Path) -> io::Result<File> {
    #[cfg(unix)]
    if std::os::unix::fs::FileTypeExt::is_fifo(&fs_err::metadata(path)?.file_type()) {
        let text = format!("{} is a pipe; write what comes out of it into a file", path.display());
        return Err(io::Error::new(io::ErrorKind::InvalidInput, text));
    }
    File::open(path)
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn pipes_are_refused_at_once() {
        let dir = tempfile::tempdir().expect("a folder");
        let pipe = dir.path().join("pipe");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().expect("runs").success());
        assert!(open(&pipe).expect_err("is refused").to_string().contains("is a pipe"));
        assert!(open(Path::new("/dev/null")).is_ok());
    }
}
