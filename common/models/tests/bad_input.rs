//! Wrong descriptions and files: one clear message each, no panic.

use super::*;

use slag_models::EncoderId;

/// A copy of the description `name` with replacements, without its files.
fn changed(name: &str, replacements: &[(&str, &str)]) -> TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    let mut text = fs_err::read_to_string(model_dir(name).join("model.toml")).expect("it is readable");
    for (from, to) in [("../../../../shared/models", "models")].iter().chain(replacements) {
        assert!(text.contains(from), "{from:?} is not in the description");
        text = text.replace(from, to);
    }
    fs_err::write(folder.path().join("model.toml"), text).expect("it is writable");
    folder
}

/// The same, with its files beside it as `models`.
fn changed_with_files(name: &str, replacements: &[(&str, &str)]) -> TempDir {
    let folder = changed(name, replacements);
    link_models(folder.path());
    folder
}

/// The error of opening the description or one of its encoders.
fn failure(folder: &Path, options: &SessionOptions) -> String {
    let opened = ModelDir::open(folder).and_then(|model| {
        model.image_encoder(options)?;
        model.text_encoder(options)?;
        Ok(())
    });
    opened.expect_err("it must be refused").to_string()
}

#[test]
fn wrong_descriptions_are_named_by_field_or_line() {
    let no_runtime = SessionOptions::new("no-such-library.so".into());
    let hash = "sha256 = \"7651536597622dcf6d1e2f9ab46450187797180727d08ccc1ee903e1eed44469\"";
    for (from, to, expected) in [
        ("dim = 512", "dim = 0", "dim is 0, expected 1 to 65536"),
        ("dim = 512", "dim = -1", "line 4"),
        ("dim = 512", "dimension = 512", "dimension"),
        ("size_px = 224", "size_px = 5000", "image.size_px is 5000"),
        ("batch = 16", "batch = 0", "image.batch is 0"),
        ("batch = 16", "batch = 16\nbatches = 2", "batches"),
        ("resize = \"stretch\"", "resize = \"tile\"", "tile"),
        ("threshold = 0.35", "threshold = nan", "score is { threshold = NaN }"),
        ("std = [0.5019607843137255", "std = [0.0", "image.std is [0.0"),
        ("name = \"conse-mobilenetv2\"", "name = \"two words\"", "name is \"two words\""),
        ("path = \"clip_text/phrases.txt\"", "path = \"../phrases.txt\"", "text.phrases is ../phrases.txt"),
        ("path = \"clip_text/phrases.txt\"", "path = \"/phrases.txt\"", "text.phrases is /phrases.txt"),
        ("kind = \"phrases\"", "kind = \"sentences\"", "sentences"),
        ("tensor = \"vectors\"", "tensors = \"vectors\"", "tensors"),
        (hash, "sha256 = \"7651\"", "64 hexadecimal digits"),
        (&format!(", {hash}"), "", "records no sha256"),
        ("[text]", "[text", "line"),
    ] {
        let folder = changed("conse", &[(from, to)]);
        let message = failure(folder.path(), &no_runtime);
        assert!(message.contains(expected), "{to}: {message}");
        assert!(message.contains("model.toml"), "{to}: {message}");
    }
    let message = failure(Path::new("no-such-folder"), &no_runtime);
    assert!(message.contains("no-such-folder/model.toml"), "{message}");
    // Files are opened with the encoder.
    let folder = changed("conse", &[]);
    let message = failure(folder.path(), &no_runtime);
    assert!(message.contains("conse_mnv2_int8.onnx") && message.contains("put the file there"), "{message}");
}

#[needs_shared]
fn files_that_do_not_fit_their_description_are_refused() {
    let options = options();
    let vision = ", sha256 = \"e0bca5c7dd0e39ddb0137356acde890cf58930766dccd276ae8242a868f39ae4\"";
    let text = ", sha256 = \"1965ec622a100a1beebea6db591985d88f12e057f9772fc83dc8c4c8cd6e5ef0\"";
    for (replacements, expected) in [
        (&[("e0bca5c7", "00000000")][..], "SHA-256 is e0bca5c7"),
        (&[("input = \"pixel_values\"", "input = \"image\"")], "no input \"image\", it has pixel_values"),
        (&[("output = \"image_embeds\"", "output = \"x\"")], "it has image_embeds, last_hidden_state"),
        (
            &[("output = \"image_embeds\"", "output = \"last_hidden_state\"")],
            "expected f32 [-1, 512]; correct the description",
        ),
        (&[("size_px = 224", "size_px = 256")], "expected f32 [-1, 3, 256, 256]"),
        (&[("dim = 512", "dim = 256")], "expected f32 [-1, 256]"),
        (
            &[(vision, ""), ("clip_tiny/vision_model.onnx", "clip_tiny/text_model.onnx")],
            "no input \"pixel_values\", it has input_ids",
        ),
        (
            &[(text, ""), ("clip_tiny/text_model.onnx", "clip_tiny/text_model_mask.onnx")],
            "input \"attention_mask\" is required by the model",
        ),
        (&[(text, ""), ("clip_tiny/text_model.onnx", "clip_tiny/golden.npz")], "fetch the model file again"),
        (&[("end_token_id = 49407", "end_token_id = 2")], "the model's end token is 2"),
        (&[("clip_tiny/text_model.onnx", "clip_tiny/absent.onnx")], "absent.onnx"),
    ] {
        let folder = changed_with_files("clip_tiny", replacements);
        let message = failure(folder.path(), &options);
        assert!(message.contains(expected), "{replacements:?}: {message}");
    }
    for (replacements, expected) in [
        (&[("tensor = \"vectors\"", "tensor = \"v\"")][..], "no tensor \"v\", it has mean, vectors"),
        (&[("tensor = \"vectors\"", "tensor = \"mean\"")], "is F32 [512], expected F16 or F32 [1612, 512]"),
    ] {
        let folder = changed_with_files("conse", replacements);
        let message = failure(folder.path(), &options);
        assert!(message.contains(expected), "{replacements:?}: {message}");
    }
}

#[needs_shared]
fn a_tokenizer_of_another_vocabulary_is_refused() {
    let (models, options) = (shared("models"), options());
    let hash = ", sha256 = \"e77528f5a52e0f4b4f98e1b3b4c13453f7762f2e38ec23c9ed352278a65de0a4\"";
    let folder = changed("clip_tiny", &[(hash, ""), ("clip_tokenizer/tokenizer.json", "tokenizer.json")]);
    fs_err::create_dir(folder.path().join("models")).expect("it is writable");
    std::os::unix::fs::symlink(
        models.join("clip_tiny").canonicalize().expect("it exists"),
        folder.path().join("models/clip_tiny"),
    )
    .expect("a link");
    let path = folder.path().join("models/tokenizer.json");
    for (tokenizer, expected) in [
        (
            r#"{"version":"1.0","model":{"type":"WordLevel","vocab":{"a":0,"chair":1,"[UNK]":2},"unk_token":"[UNK]"},
            "added_tokens":[],"normalizer":null,"pre_tokenizer":{"type":"Whitespace"},"post_processor":null,"decoder":null}"#,
            "texts end in token None, but the model's end token is 49407",
        ),
        ("{}", "fetch tokenizer.json again"),
        ("", "fetch tokenizer.json again"),
    ] {
        fs_err::write(&path, tokenizer).expect("it is writable");
        let message = failure(folder.path(), &options);
        assert!(message.contains(expected) && message.contains("tokenizer.json"), "{message}");
    }
}

#[needs_shared]
fn cut_files_are_refused() {
    let (models, options) = (shared("models"), options());
    for (name, path, expected) in [
        ("clip_tiny", "clip_tiny/vision_model.onnx", "fetch the model file again"),
        ("conse", "clip_text/vectors.safetensors", "fetch the file again"),
        (
            "conse",
            "clip_text/phrases.txt",
            "expected F16 or F32 [865, 512]; correct the description, or fetch its files again",
        ),
    ] {
        let bytes = fs_err::read(models.join(path)).expect("it is readable");
        let text = fs_err::read_to_string(model_dir(name).join("model.toml")).expect("it is readable");
        let description = unhashed(&text.replace("../../../../shared/models", "."));
        let folder = tempfile::tempdir().expect("a folder");
        fs_err::write(folder.path().join("model.toml"), description).expect("it is writable");
        for sub in ["clip_tiny", "clip_text", "clip_tokenizer", "image_encoder"] {
            fs_err::create_dir(folder.path().join(sub)).expect("it is writable");
            for entry in fs_err::read_dir(models.join(sub)).expect("it is readable") {
                let entry = entry.expect("it is readable");
                let target = folder.path().join(sub).join(entry.file_name());
                std::os::unix::fs::symlink(entry.path().canonicalize().expect("it exists"), target)
                    .expect("a link");
            }
        }
        let cut = folder.path().join(path);
        for n_bytes in [0, 7, bytes.len() / 2] {
            fs_err::remove_file(&cut).expect("it is there");
            fs_err::write(&cut, &bytes[..n_bytes]).expect("it is writable");
            let message = failure(folder.path(), &options);
            assert!(n_bytes < bytes.len() / 2 || message.contains(expected), "{path}: {message}");
        }
    }
}

#[test]
fn the_encoder_id_needs_no_files() {
    let full = ModelDir::open(&model_dir("conse")).expect("no file is needed");
    let id = full.encoder_id();
    assert_eq!((id.name.as_str(), id.dim), ("conse-mobilenetv2", 512));
    let json = serde_json::to_string(id).expect("it serialises");
    assert_eq!(&serde_json::from_str::<EncoderId>(&json).expect("it parses"), id);
    // SHA-256 of the canonical form, computed with Python's json and hashlib.
    assert_eq!(hex::encode(id.hash()), "da98fdf4e454ee19d1004878866c36c289f4f0fa0f1673ff38e16bd6b0f10a92");
    assert!(id.to_string().starts_with("conse-mobilenetv2@"));
    assert_ne!(id.hash(), ModelDir::colours().encoder_id().hash());
}

#[needs_shared]
fn a_hash_that_is_left_out_is_computed_from_the_file() {
    let full = ModelDir::open(&model_dir("conse")).expect("no file is needed");
    let id = full.encoder_id();
    // Without a recorded hash, it is computed from the file.
    let hash = ", sha256 = \"0799d6716c84b2a15511cf1b267a0fb6ee91c8ca5b2155680b1b46770b798952\"";
    let folder = changed_with_files("conse", &[(hash, "")]);
    assert_eq!(ModelDir::open(folder.path()).expect("it opens").encoder_id(), id);
    let folder = changed_with_files("conse", &[("0799d6716c84", "0799d6716c85")]);
    assert_ne!(ModelDir::open(folder.path()).expect("it opens").encoder_id().hash(), id.hash());
}
