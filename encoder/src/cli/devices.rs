//! `devices`: the GPUs that can rasterise.

use anyhow::Result;
use serde_json::json;

use super::common::print;
use super::exit::Exit;
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
