//! Pulling a segmenter, which keeps its weights beside its graphs, and naming one that has no published export.

use super::*;

use slag_models::sam::Sam;

use super::server::{Server, hub_of, sha256};
use crate::common::model_dir;

const TABLE: &str = r#"
hub = "http://127.0.0.1:1"
[layout.sam2]
description = '''
[segment]
kind = "sam2"
size_px = 256
image_encoder = { path = "IMAGE_ENCODER" }
mask_decoder = { path = "MASK_DECODER" }
'''
[[model]]
name = "sam2"
about = "A segmenter."
layout = "sam2"
licence = "Apache-2.0"
licence_url = "https://licence.example/"
repository = "owner/made"
files = { image_encoder = "vision_encoder.onnx", mask_decoder = "prompt_encoder_mask_decoder.onnx" }
data = { image_encoder = "vision_encoder.onnx_data", mask_decoder = "prompt_encoder_mask_decoder.onnx_data" }
"#;
const EXPORTED: &str = r#"
[[model]]
name = "dense"
about = "Weights without an export."
layout = "sam2"
licence = "Apache-2.0"
licence_url = "https://licence.example/"
repository = "owner/dense"
export = "scripts/export.py"
"#;

fn server() -> Server {
    let server = Server::start();
    for part in ["vision_encoder", "prompt_encoder_mask_decoder"] {
        for end in ["onnx", "onnx_data"] {
            let name = format!("{part}.{end}");
            let bytes = fs_err::read(model_dir("sam2_tiny").join(&name)).expect("it is readable");
            server.change(|files| {
                files.bytes.insert(name, bytes);
            });
        }
    }
    server
}

#[test]
fn weights_beside_a_graph_are_pulled_checked_and_described() {
    let (server, root) = (server(), tempfile::tempdir().expect("a folder"));
    let hub = hub_of(TABLE, &server.url, root.path());
    // No consent is asked for; a robot has no use for it.
    assert_error(hub.pull("sam2", Side::Text, false), &["slag-encoder"]);
    let pulled = hub.pull("sam2", Side::Both, false).expect("it is pulled");
    let files: Vec<_> = pulled.iter().map(|file| (file.path.as_str(), file.hash_source)).collect();
    let expected = ["vision_encoder.onnx", "vision_encoder.onnx_data"]
        .into_iter()
        .chain(["prompt_encoder_mask_decoder.onnx", "prompt_encoder_mask_decoder.onnx_data"])
        .map(|path| (path, Source::Hub));
    assert_eq!(files, expected.collect::<Vec<_>>());
    let folder = hub.resolve(Path::new("sam2")).expect("it is here");
    let text = fs_err::read_to_string(folder.join("model.toml")).expect("it is readable");
    for name in ["vision_encoder.onnx_data", "prompt_encoder_mask_decoder.onnx"] {
        assert!(text.contains(&sha256(&server.bytes(name))), "{text}");
    }
    assert_eq!(Hub::verify(&folder).expect("as recorded").len(), 4);
    assert_eq!(hub.here(hub.entry("sam2").expect("known")), Here::All);
    Sam::open(&folder, &options()).expect("it opens");

    let data = folder.join("vision_encoder.onnx_data");
    let mut bytes = fs_err::read(&data).expect("it is readable");
    bytes[7] ^= 1;
    fs_err::write(&data, bytes).expect("it is writable");
    assert_error(Hub::verify(&folder), &["vision_encoder.onnx_data: SHA-256 is"]);
    fs_err::remove_file(&data).expect("it is there");
    assert_eq!(hub.here(hub.entry("sam2").expect("known")), Here::No);
}

#[test]
fn a_model_without_a_published_export_names_its_script() {
    let (server, root) = (server(), tempfile::tempdir().expect("a folder"));
    let hub = hub_of(&format!("{TABLE}{EXPORTED}"), &server.url, root.path());
    let error = hub.pull("dense", Side::Both, true).expect_err("nothing to pull");
    assert!(error.to_string().contains("no ONNX files"), "{error}");
    let error = error.to_string();
    for part in ["owner/dense", "scripts/export.py", root.path().join("dense").to_str().expect("UTF-8")] {
        assert!(error.contains(part), "{error}");
    }
    assert!(server.asked().is_empty());
    assert_eq!(hub.here(hub.entry("dense").expect("known")), Here::No);
    let folder = root.path().join("dense");
    fs_err::create_dir_all(&folder).expect("it is writable");
    fs_err::copy(model_dir("sam2_tiny").join("model.toml"), folder.join("model.toml")).expect("it copies");
    assert_eq!(hub.resolve(Path::new("dense")).expect("made by the script"), folder);
}
