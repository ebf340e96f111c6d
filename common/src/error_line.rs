//! Errors in one line.

/// Joins an error and its causes; causes that the line already contains are left out.
pub fn error_line(error: &dyn std::error::Error) -> String {
    let mut line = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        let text = error.to_string();
        if !line.contains(&text) {
            line = format!("{line}: {text}");
        }
        cause = error.source();
    }
    // Any command may fill a disk, and libraries hide the error's kind.
    let is_full = ["No space left", "uota exceeded"].iter().any(|told| line.contains(told));
    if is_full && !line.contains("free space") {
        line.push_str("; free space on that disk, and run the same command again");
    }
    line
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;

    #[derive(Debug, thiserror::Error)]
    #[error("{0}; check that the file exists")]
    struct Open(#[from] io::Error);

    #[derive(Debug, thiserror::Error)]
    #[error("scene")]
    struct Scene(#[source] Open);

    /// A cause is appended only if the message does not include its text.
    #[test]
    fn an_error_names_its_file_and_cause_once() {
        let error = Scene(Open(io::Error::other("cannot open `a.json`: absent")));
        assert_eq!(error_line(&error), "scene: cannot open `a.json`: absent; check that the file exists");
    }

    #[test]
    fn a_full_disk_has_its_advice_once() {
        let line = error_line(&io::Error::from_raw_os_error(28));
        assert_eq!(
            line,
            "No space left on device (os error 28); free space on that disk, and run the same command again"
        );
        let advised = Open(io::Error::other(line.clone()));
        assert_eq!(error_line(&advised), format!("{line}; check that the file exists"));
    }
}
