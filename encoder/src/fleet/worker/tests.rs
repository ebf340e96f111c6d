use slag_models::{ModelDir, SessionOptions};

use super::*;
use crate::progress::Silent;
use crate::raster::CpuRasterizer;

/// A folder lives as long as its worker; the next worker removes a killed one's folder, and nothing else.
#[test]
fn folders_go_with_their_workers() {
    let dir = tempfile::tempdir().expect("a folder");
    let scratch = dir.path().join("scratch");
    let names = || {
        let entries = fs_err::read_dir(&scratch).expect("reads");
        let mut names: Vec<_> = entries.map(|entry| entry.expect("reads").path()).collect();
        names.sort();
        names
    };
    let first = RunFolder::make(&scratch).expect("made");
    fs_err::create_dir_all(first.path().join("photos")).expect("made");
    fs_err::write(first.path().join("photos/a.png"), "a").expect("written");
    // A killed worker's folder, and neighbours'.
    let left = scratch.join("slag-worker-left-1");
    fs_err::create_dir_all(left.join("photos")).expect("made");
    fs_err::write(left.join(LOCK), "").expect("written");
    let foreign = [scratch.join("photos"), scratch.join("slag-worker-without-a-lock")];
    foreign.iter().for_each(|path| fs_err::create_dir_all(path).expect("made"));

    let second = RunFolder::make(&scratch).expect("made");
    assert_ne!(first.path(), second.path());
    let mut expected = vec![first.path().to_owned(), second.path().to_owned()];
    expected.extend(foreign.clone());
    expected.sort();
    assert_eq!(names(), expected);
    drop((first, second));
    assert_eq!(names(), foreign);
}

/// A worker on another bucket than its coordinator would otherwise end without an error or any work.
#[test]
fn a_worker_that_finds_no_run_says_so() {
    let dir = tempfile::tempdir().expect("a folder");
    let bucket = Arc::new(Bucket::open(dir.path().to_str().expect("UTF-8"), []).expect("opens"));
    let (models, session) = (ModelDir::colours(), SessionOptions::new(PathBuf::new()));
    let settings = WorkerSettings {
        dispatch: Dispatch::Share { index: 0, of: 1, help_after: Duration::ZERO },
        n_threads: 1,
        gpus: Vec::new(),
        memory_bytes: 0,
        folder: dir.path().to_owned(),
        segmenter: None,
        patience: Duration::from_millis(100),
    };
    let engines = Engines::new(&models, &session, &CpuRasterizer);
    let error = work(&bucket, &settings, &engines, &Silent, &AtomicBool::new(false)).expect_err("no run");
    assert!(error.to_string().contains("no encode began within 0 s; check --blobs"), "{error}");
}
