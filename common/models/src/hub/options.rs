//! Options of reaching the hub and keeping its models.

use std::path::{Path, PathBuf};
use std::time::Duration;

/// Options of reaching the hub and keeping its models.
#[derive(Clone, Debug)]
pub struct HubOptions {
    /// Folder of the models, see [`models_folder`].
    pub root: PathBuf,
    /// Address of the hub; default: the table's.
    pub hub: Option<String>,
    /// Proxy, in the format of `HTTPS_PROXY`.
    pub proxy: Option<String>,
    /// Timeout of connections and reads.
    pub timeout: Duration,
    /// Wait before the second attempt; doubled before each further one.
    pub first_backoff: Duration,
}

impl HubOptions {
    pub fn new(root: PathBuf) -> Self {
        let (timeout, first_backoff) = (Duration::from_secs(30), Duration::from_millis(500));
        Self { root, hub: None, proxy: None, timeout, first_backoff }
    }
}

/// Returns the folder of the user's caches: `$XDG_CACHE_HOME/slag`, else `~/.cache/slag`; `variable` looks up
/// environment variables.
pub fn cache_folder(variable: impl Fn(&str) -> Option<std::ffi::OsString>) -> Option<PathBuf> {
    // The XDG base directory specification ignores relative paths.
    let absolute = |name: &str| variable(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let base = absolute("XDG_CACHE_HOME").or_else(|| Some(absolute("HOME")?.join(".cache")))?;
    Some(base.join("slag"))
}

pub fn models_folder(cache_folder: &Path) -> PathBuf {
    cache_folder.join("models")
}
