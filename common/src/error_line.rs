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
}
