//! Finding and loading ONNX Runtime; a program of its own, because a process loads it once.

use std::path::{Path, PathBuf};
use std::process::Command;

use slag_models::{ModelDir, SessionOptions, find_runtime};
use slag_test_support::{assert_error, needs_shared, onnx_runtime, workspace_root};

#[needs_shared]
fn a_library_is_found_where_it_lies() {
    let absent = PathBuf::from("no/such/libonnxruntime.so");
    assert_error(find_runtime(Some(&absent), &[]), &["no/such/libonnxruntime.so", "--runtime"]);
    let folder = tempfile::tempdir().expect("a folder");
    let bare = find_runtime(None, &[folder.path().to_owned()]).expect("the system's loader is asked");
    assert_eq!(bare, Path::new("libonnxruntime.so"));
    let library = folder.path().join("libonnxruntime.so");
    fs_err::write(&library, "not a library").expect("it is writable");
    assert_eq!(find_runtime(None, &["absent".into(), folder.path().to_owned()]).unwrap(), library);
    assert_eq!(find_runtime(Some(&library), &[]).expect("it is found"), library);
}

#[needs_shared]
fn a_wrong_library_is_refused_and_the_right_one_still_loads() {
    let absent = PathBuf::from("no/such/libonnxruntime.so");
    let folder = tempfile::tempdir().expect("a folder");
    let library = folder.path().join("libonnxruntime.so");
    fs_err::write(&library, "not a library").expect("it is writable");
    let model = ModelDir::open(&workspace_root().join("tests/models/conse")).expect("it opens");
    let refusal = |runtime: &Path| {
        let error = model.image_encoder(&SessionOptions::new(runtime.to_owned())).err();
        error.expect("it is refused").to_string()
    };
    for wrong in [library.as_path(), &absent, Path::new("libno-such-onnxruntime.so")] {
        let refusal = refusal(wrong);
        let helps = refusal.contains("scripts/get-onnxruntime.sh") && refusal.contains("--runtime");
        assert!(helps, "{refusal}");
    }

    // An old ONNX Runtime: only its version is read before it is refused.
    let source = folder.path().join("old.c");
    let old = folder.path().join("libold.so");
    let code = "static const char* version(void) { return \"1.9.0\"; }\n\
        static struct { void* get_api; const char* (*version)(void); } base = { 0, version };\n\
        void* OrtGetApiBase(void) { return &base; }\n";
    fs_err::write(&source, code).expect("it is writable");
    let built = Command::new("cc").args(["-shared", "-fPIC", "-o"]).args([&old, &source]).status();
    assert!(built.expect("the linker's compiler is there").success());
    for part in ["libold.so", "1.9.0", "1.17", "get-onnxruntime.sh"] {
        assert!(refusal(&old).contains(part), "{}", refusal(&old));
    }

    let options = SessionOptions::new(onnx_runtime());
    model.image_encoder(&options).expect("the right library still loads");
    fs_err::copy(&options.runtime, &library).expect("it is writable");
    assert!(refusal(&library).contains("use one per process"), "{}", refusal(&library));
    model.image_encoder(&options).expect("the loaded one stays in use");
}
