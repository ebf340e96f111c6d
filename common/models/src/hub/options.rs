//! How the hub is reached, and where its models are kept.

use std::path::{Path, PathBuf};
use std::time::Duration;

/// How the hub is reached, and where its models are kept.
#[derive(Clone, Debug)]
pub struct HubOptions {
    /// Folder of the models, [`models_folder`].
    pub root: PathBuf,
    /// Address of the hub; the table's if absent.
    pub hub: Option<String>,
    /// Proxy, as `HTTPS_PROXY` gives it.
    pub proxy: Option<String>,
    /// How long the hub may be silent.
    pub timeout: Duration,
    /// What is waited before the second attempt; doubled before each other.
    pub first_backoff: Duration,
}

impl HubOptions {
    /// Returns the usual ones.
    pub fn new(root: PathBuf) -> Self {
        let (timeout, first_backoff) = (Duration::from_secs(30), Duration::from_millis(500));
        Self { root, hub: None, proxy: None, timeout, first_backoff }
    }
}

/// Returns the folder of the user's caches: `$XDG_CACHE_HOME/slag`, else `~/.cache/slag`; `variable` looks the
/// environment up.
pub fn cache_folder(variable: impl Fn(&str) -> Option<std::ffi::OsString>) -> Option<PathBuf> {
    // The base directory specification has relative paths ignored.
    let absolute = |name: &str| variable(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let base = absolute("XDG_CACHE_HOME").or_else(|| Some(absolute("HOME")?.join(".cache")))?;
    Some(base.join("slag"))
}

/// Returns the folder of pulled models within that of the user's caches.
pub fn models_folder(cache_folder: &Path) -> PathBuf {
    cache_folder.join("models")
}
