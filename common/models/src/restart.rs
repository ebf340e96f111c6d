//! A program's own environment.

/// Keeps ONNX Runtime from writing an identity of the device and a log of its use to the user's cache folder, which it
/// does when it is loaded.
pub const NO_TELEMETRY: (&str, &str) = ("ORT_DISABLE_TELEMETRY", "1");

/// Starts the program anew with variables that libraries read when they are loaded, unless all are set already.
///
/// A process cannot change its own environment safely once it has threads. On success the new program replaces this
/// one under the same process id; if it cannot be started, this one goes on.
pub fn restart_with(variables: &[(&str, &str)]) {
    #[cfg(unix)]
    {
        use std::os::unix::process::CommandExt;
        use std::process::Command;

        if variables.iter().all(|(name, _)| std::env::var_os(name).is_some()) {
            return;
        }
        let (Ok(program), mut args) = (std::env::current_exe(), std::env::args_os()) else { return };
        let mut command = Command::new(program);
        args.next().map(|name| command.arg0(name));
        let error = command.args(args).envs(variables.iter().copied()).exec();
        tracing::debug!("cannot start anew: {error}");
    }
}
