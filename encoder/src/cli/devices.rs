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

/// Returns the variable that disables Mesa's device selection (`VkLayer_MESA_device_select.json`), if it would print an
/// error of its own: it asks the Wayland compositor, and libwayland prints "error: XDG_RUNTIME_DIR is invalid" where
/// there is no session, as on servers. The layer only orders devices.
pub fn no_device_selection() -> Option<(&'static str, &'static str)> {
    let is_noisy = cfg!(target_os = "linux") && std::env::var_os("XDG_RUNTIME_DIR").is_none();
    is_noisy.then_some(("NODEVICE_SELECT", "1"))
}
