//! An encode uses its own threads. A separate program, because rayon's global pool belongs to the process.

use slag_encoder::encode::{self, EncodeSettings, Engines, Masks};
use slag_encoder::{progress::Silent, raster::CpuRasterizer, segment::SamSettings};
use slag_lab::generate::{Scene, grammar};
use slag_models::{ModelDir, SessionOptions};
use slag_test_support::{needs_shared, onnx_runtime, workspace_root};

/// Also with SAM, whose filters run beside the thread that waits for the model.
#[needs_shared]
fn an_encode_leaves_rayons_global_pool_alone() {
    let folder = tempfile::tempdir().expect("a folder");
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a pool");
    let mut room = pool.install(|| Scene::new(&[grammar::SceneKind::Room], 1, 2));
    let files = pool.install(|| room.write(folder.path(), &Silent).expect("a room"));
    let mut settings = EncodeSettings::new(files.scene, files.views, folder.path().join("store"), true);
    settings.run.threads = 2;
    // Random weights give weak masks.
    let sam = SamSettings {
        points_per_side: 4,
        predicted_iou: 0.0,
        stability: 0.2,
        stability_offset: 0.05,
        ..SamSettings::default()
    };
    let dir = workspace_root().join("tests/models/sam_tiny");
    settings.view.masks = Masks::Sam { dir, settings: sam, n_model_threads: 1 };
    let (models, session) = (ModelDir::colours(), SessionOptions::new(onnx_runtime()));
    let engines = Engines::new(&models, &session, &CpuRasterizer);
    let summary = encode::encode(&settings, &engines, &Silent, &false.into()).expect("encodes");
    assert!(
        summary.n_views == 2 && summary.n_masks > 0,
        "{} views, {} masks",
        summary.n_views,
        summary.n_masks
    );
    // The global pool is built once: by its first user, else here.
    let made = rayon::ThreadPoolBuilder::new().num_threads(1).build_global();
    made.expect("the encode made rayon's global pool");
}
