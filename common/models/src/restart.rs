//! A program's own environment.

use std::os::unix::process::CommandExt;
use std::process::Command;

/// Keeps ONNX Runtime from writing a device identity and a usage log to the user's cache folder when it is loaded.
pub const NO_TELEMETRY: (&str, &str) = ("ORT_DISABLE_TELEMETRY", "1");

/// Restarts the program with variables that libraries read when they are loaded, unless all are set already.
///
/// A process with threads cannot change its own environment safely. On success the new program replaces this one
/// under the same process id; if it cannot be started, this one goes on.
pub fn restart_with(variables: &[(&str, &str)]) {
    if variables.iter().all(|(name, _)| std::env::var_os(name).is_some()) {
        return;
    }
    let (Ok(program), mut args) = (std::env::current_exe(), std::env::args_os()) else { return };
    // Under emulation these paths differ. The kernel cannot run our program then, and libc hands such files to a shell.
    if std::fs::read_link("/proc/thread-self/exe").is_ok_and(|runs| runs != program) {
        return tracing::debug!("not started anew: an emulator runs this program");
    }
    let mut command = Command::new(program);
    args.next().map(|name| command.arg0(name));
    let error = command.args(args).envs(variables.iter().copied()).exec();
    tracing::debug!("cannot start anew: {error}");
}
