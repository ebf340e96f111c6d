//! Encodes whose inputs change meanwhile, or whose store cannot be published into.

use super::*;
use std::path::PathBuf;
use std::sync::Mutex;

use slag_encoder::encode;
use slag_encoder::encode::EncodeSummary;
use slag_encoder::progress::Progress;

/// Acts when a view has its masks, and when a stage begins.
struct When<F>(F);

impl<F: Fn(&str) + Sync> Progress for When<F> {
    fn begin(&self, stage: &str, _: &str, _: u64, _: u64) {
        self.0(stage);
    }

    fn advance(&self, _: u64) {}

    fn end(&self) {}

    fn segmented(&self, view: &str, _: usize, _: &dyn Fn() -> RgbImage) {
        self.0(view);
    }
}

struct Room {
    folder: tempfile::TempDir,
    settings: EncodeSettings,
}

impl Room {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let files = Scene::new(&[grammar::SceneKind::Room], 1, 4).write(folder.path(), &Silent).unwrap();
        let store = folder.path().join("store");
        let mut settings = EncodeSettings::new(files.scene, files.views, store, true);
        settings.view.masks = Masks::Graph;
        settings.run.threads = 1;
        settings.run.keep_views = true;
        Self { folder, settings }
    }

    fn photos(&self) -> Vec<PathBuf> {
        let set = slag_common::poses::read(&self.settings.inputs.views, None).unwrap();
        set.views.into_iter().map(|view| view.image_path).collect()
    }

    fn encode(&self, when: impl Fn(&str) + Sync) -> Result<EncodeSummary, String> {
        let (models, session) = (ModelDir::colours(), SessionOptions::new("".into()));
        let engines = Engines::new(&models, &session, &CpuRasterizer);
        encode::encode(&self.settings, &engines, &When(when), &false.into()).map_err(|e| e.to_string())
    }
}

/// A photo that is rewritten, truncated or deleted while its view is processed is omitted and named, or ends the
/// encode with `strict`. No view is kept under the hash of bytes that were not used.
#[test]
fn photos_that_change_are_left_out() {
    let mut room = Room::new();
    let photos = room.photos();
    let bytes: Vec<Vec<u8>> = photos.iter().map(|path| fs_err::read(path).unwrap()).collect();
    let change = |view: &str| {
        let Some(at) = photos.iter().position(|path| path.ends_with(view)) else { return };
        match at {
            0 => fs_err::write(&photos[0], &bytes[3]).unwrap(),
            1 => fs_err::write(&photos[1], &bytes[1][..bytes[1].len() / 2]).unwrap(),
            2 => fs_err::remove_file(&photos[2]).unwrap(),
            _ => {}
        }
    };
    let restore = || photos.iter().zip(&bytes).for_each(|(path, bytes)| fs_err::write(path, bytes).unwrap());
    let summary = room.encode(change).unwrap();
    let skipped = summary.skipped_views;
    assert_eq!((summary.n_views, skipped.len()), (1, 3), "{skipped:?}");
    assert!(skipped.iter().all(|of| of.reason.contains("changed after the encode began")), "{skipped:?}");
    restore();
    assert_eq!(room.encode(|_| {}).unwrap().n_views_resumed, 1);

    // Landmarks read the photos again, after all views.
    room.settings.cells.landmarks = true;
    let at_landmarks = |stage: &str| {
        if stage == "landmarks" {
            fs_err::write(&photos[0], &bytes[3]).unwrap();
        }
    };
    let message = room.encode(at_landmarks).unwrap_err();
    assert!(message.contains("changed after the encode began"), "{message}");

    restore();
    room.settings.run.strict = true;
    room.settings.output.store = room.folder.path().join("other");
    let message = room.encode(change).unwrap_err();
    assert!(message.contains("changed after the encode began"), "{message}");
}

/// A missing key is reported before the first photo is read.
#[test]
fn a_missing_key_is_told_before_the_work() {
    let room = Room::new();
    room.encode(|_| {}).unwrap();
    fs_err::remove_file(room.settings.output.store.join("keys/snapshot.key")).unwrap();
    let seen = Mutex::new(Vec::new());
    let message = room.encode(|what| seen.lock().unwrap().push(what.to_owned())).unwrap_err();
    assert!(message.contains("snapshot.key: it is missing") && message.contains("keys rotate"), "{message}");
    assert_eq!(*seen.lock().unwrap(), [""; 0]);
}

/// A camera above the scene that looks up is no use, and the summary says so.
#[test]
fn views_that_see_nothing_are_left_out() {
    let room = Room::new();
    let poses = &room.settings.inputs.views;
    let mut json: serde_json::Value = serde_json::from_slice(&fs_err::read(poses).unwrap()).unwrap();
    json["frames"][1]["transform_matrix"] =
        serde_json::json!([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1e6], [0, 0, 0, 1]]);
    fs_err::write(poses, json.to_string()).unwrap();
    let summary = room.encode(|_| {}).unwrap();
    let skipped = summary.skipped_views;
    assert_eq!((summary.n_views, skipped.len()), (3, 1), "{skipped:?}");
    assert!(skipped[0].reason.contains("sees no Gaussian"), "{skipped:?}");
    // The store is as without them.
    let cells = || {
        slag_encoder::store::StoreReader::open(&room.settings.output.store).unwrap().manifest().cells.clone()
    };
    let with_it = cells();
    json["frames"].as_array_mut().unwrap().remove(1);
    fs_err::write(poses, json.to_string()).unwrap();
    assert_eq!(room.encode(|_| {}).unwrap().skipped_views.len(), 0);
    assert!(cells() == with_it);
}
