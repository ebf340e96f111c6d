//! Finds the ONNX Runtime library and loads it once a process, on first use: without models it is not needed.

use std::env::consts::{DLL_PREFIX, DLL_SUFFIX};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use ort::environment::Environment;
use ort::logging::LogLevel;

use crate::placement::forward_log;
use crate::session_error::SessionError;

/// Returns the library's path: `explicit`, else in the first of the folders `beside` that has it, else its bare
/// name, which the system's loader resolves.
pub fn find_runtime(explicit: Option<&Path>, beside: &[PathBuf]) -> Result<PathBuf, SessionError> {
    if let Some(path) = explicit {
        return if path.is_file() {
            Ok(path.to_owned())
        } else {
            Err(SessionError::NoRuntime { path: path.to_owned() })
        };
    }
    let name = format!("{DLL_PREFIX}onnxruntime{DLL_SUFFIX}");
    let found = beside.iter().map(|folder| folder.join(&name)).find(|path| path.is_file());
    Ok(found.unwrap_or_else(|| name.into()))
}

/// The loaded library and its environment; a process may have only one.
static RUNTIME: Mutex<Option<(PathBuf, Environment)>> = Mutex::new(None);

/// Returns the library's environment; loads the library on first use.
pub(crate) fn environment(runtime: &Path) -> Result<Environment, SessionError> {
    // The loader would look up a relative path with a folder beside the program first.
    let path = if runtime.components().count() > 1 {
        runtime.canonicalize().map_err(|_| SessionError::NoRuntime { path: runtime.to_owned() })?
    } else {
        runtime.to_owned()
    };
    let mut loaded = RUNTIME.lock().unwrap_or_else(PoisonError::into_inner);
    match &*loaded {
        Some((loaded, environment)) if *loaded == path => return Ok(environment.clone()),
        Some((loaded, _)) => {
            return Err(SessionError::OtherRuntime { loaded: loaded.clone(), asked: path });
        }
        None => {}
    }
    let environment = ort::init_from(&path)
        .map_err(|cause| SessionError::Runtime { cause: Box::new(cause) })?
        .with_name("slag")
        .with_telemetry(false)
        .with_logger(Arc::new(forward_log))
        .build()
        .map_err(|cause| SessionError::Start { cause })?;
    environment.set_log_level(LogLevel::Warning);
    *loaded = Some((path, environment.clone()));
    Ok(environment)
}
