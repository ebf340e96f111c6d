//! `devices`: the GPUs that can rasterise.

use anyhow::Result;
use serde_json::json;

use super::common::{Exit, print};
use crate::raster::gpu::{AdapterReport, adapters};

pub(super) fn run(json: bool) -> Result<Exit> {
    let reports: Vec<_> = adapters().into_iter().map(|adapter| adapter.report).collect();
    let mut lines = String::new();
    for (number, report) in reports.iter().enumerate() {
        let AdapterReport { name, driver, backend, kind, precision, max_binding_bytes } = report;
        lines += &format!(
            "{number}  {name} ({kind}, {backend}, {driver}); projection in {precision:?}, {} MiB a buffer\n",
            max_binding_bytes >> 20
        );
    }
    if reports.is_empty() {
        lines += "no GPU: the CPU rasterises\n";
    }
    print(json, &json!({ "adapters": reports }), lines)?;
    Ok(Exit::Done)
}

/// Starts the program anew without Mesa's layer that selects devices, if the layer would print an error of its
/// own.
///
/// The layer asks the Wayland compositor for its device, and libwayland prints "error: XDG_RUNTIME_DIR is invalid"
/// where there is no session, as on servers. The layer only orders devices, and only its variable in the
/// environment disables it; a process cannot change its own environment safely once it has threads. On success the
/// new program replaces this one under the same process id; if it cannot be started, this one goes on.
pub fn silence_device_selection() {
    #[cfg(target_os = "linux")]
    {
        use std::os::unix::process::CommandExt;
        use std::process::Command;

        let is_set = |name| std::env::var_os(name).is_some();
        if is_set("XDG_RUNTIME_DIR") || is_set(NO_DEVICE_SELECTION) {
            return;
        }
        let (Ok(program), mut args) = (std::env::current_exe(), std::env::args_os()) else { return };
        let mut command = Command::new(program);
        args.next().map(|name| command.arg0(name));
        let error = command.args(args).env(NO_DEVICE_SELECTION, "1").exec();
        tracing::debug!("cannot start anew: {error}");
    }
}

/// The variable that disables the layer (`VkLayer_MESA_device_select.json`).
#[cfg(target_os = "linux")]
const NO_DEVICE_SELECTION: &str = "NODEVICE_SELECT";
