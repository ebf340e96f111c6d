//! Views of a splat without photos: planned and drawn once, and kept in the store.

use std::path::Path;

use serde_json::{Value, json};
use slag_common::splat::{self, ReadOptions};
use slag_common::{Gaussians, Hash32};

use super::context::{Engines, RunContext};
use super::error::EncodeError;
use super::settings::EncodeSettings;
use crate::store::remove_files;
use crate::viewpoints::{self, ViewpointError, ViewpointSettings};

/// Version of plan and drawings; a change redraws them.
const PLAN_VERSION: u32 = 4;

/// Draws a splat's planned views beside the poses file, unless they are there.
pub(super) fn make(
    settings: &EncodeSettings,
    planned: &ViewpointSettings,
    engines: &Engines<'_>,
    context: &RunContext<'_>,
) -> Result<(), EncodeError> {
    let inputs = &settings.inputs;
    let mut scene =
        context.time("read", || splat::read(&inputs.scene, &ReadOptions { with_sh_rest: true }))?;
    inputs.activated.undo(&mut scene);
    let device = engines.rasterizer.identity();
    let id = context.install(|| identity(&scene, planned, &device))?;
    let folder = inputs.views.parent().unwrap_or(Path::new("."));
    if is_there(&inputs.views, id) {
        return Ok(());
    }
    viewpoints::check_folder(folder)?;
    let make = || {
        let memory_bytes = settings.run.memory_bytes;
        viewpoints::plan(&scene, engines.rasterizer, planned, memory_bytes, context.cancel)
    };
    let plan = context.time("plan views", || context.install(make));
    let plan = plan.map_err(|error| match error {
        ViewpointError::Interrupted => EncodeError::Interrupted { n_done: 0, n_views: planned.n_views },
        other => other.into(),
    })?;
    tracing::info!("no photos: {plan}");
    // Drawings of another plan.
    remove_files(&folder.join("images"), |name| name.starts_with("drawn-"))?;
    let name = inputs.scene.file_name().unwrap_or_default().to_string_lossy();
    let (views, about) = (viewpoints::views_of(&plan), json!({ "plan": id.to_string() }));
    let (rasterizer, progress) = (engines.rasterizer, context.progress);
    let draw = || viewpoints::draw_sharpened(folder, &views, &mut scene, rasterizer, &name, about, progress);
    context.time("draw", || context.install(draw))?;
    Ok(())
}

fn identity(scene: &Gaussians, planned: &ViewpointSettings, device: &str) -> Result<Hash32, EncodeError> {
    let columns: [&[u8]; 6] = [
        bytemuck::cast_slice(&scene.means_in_world),
        bytemuck::cast_slice(&scene.rotations_wxyz),
        bytemuck::cast_slice(&scene.scales),
        bytemuck::cast_slice(&scene.opacities),
        bytemuck::cast_slice(&scene.sh_dc),
        bytemuck::cast_slice(&scene.sh_rest),
    ];
    let columns = columns.map(|column| Hash32::of(column).to_string());
    let of = (PLAN_VERSION, env!("CARGO_PKG_VERSION"), device, planned, scene.sh_degree, columns);
    Ok(Hash32::of(&serde_json::to_vec(&of).map_err(std::io::Error::from)?))
}

/// Whether a poses file, which is written last, belongs to this plan.
fn is_there(poses: &Path, id: Hash32) -> bool {
    let text = fs_err::read(poses).ok();
    let found = text.and_then(|text| serde_json::from_slice::<Value>(&text).ok());
    found.is_some_and(|found| found["plan"] == id.to_string())
}
