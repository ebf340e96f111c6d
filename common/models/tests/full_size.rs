//! CLIP ViT-B/32 in its full size: texts cut after the end token and filled up to 77 tokens, batches of images.
//!
//! Needs its ONNX files, of any weights, in 32 and in 8 bits (text_model, text_model_int8, vision_model,
//! vision_model_int8), in the folder that SLAG_CLIP_B32 names.

use std::path::{Path, PathBuf};

use crate::common::{model_dir, options, shared};
use slag_models::{ModelDir, SessionOptions};
use tempfile::TempDir;

fn setting() -> (PathBuf, PathBuf, SessionOptions) {
    let folder = std::env::var_os("SLAG_CLIP_B32").expect("SLAG_CLIP_B32 names a folder");
    (folder.into(), shared("models"), options())
}

/// The small model's description with full-size files.
fn described(text: &str, image: &str) -> String {
    let path = model_dir("clip_tiny").join("model.toml");
    let mut description = String::new();
    for line in fs_err::read_to_string(path).expect("it is readable").lines() {
        let is_replaced = line.contains("clip_tiny/");
        description += if is_replaced { line.split(", sha256").next().expect("a part") } else { line };
        description += if is_replaced { " }\n" } else { "\n" };
    }
    description
        .replace("../../../../shared/models", ".")
        .replace("clip_tiny/text_model.onnx", &format!("full/{text}"))
        .replace("clip_tiny/vision_model.onnx", &format!("full/{image}"))
        .replace("clip_tokenizer/", "models/clip_tokenizer/")
}

fn opened(described: &str, models: &Path, folder: &Path) -> (TempDir, ModelDir) {
    let place = tempfile::tempdir().expect("a folder");
    for (from, to) in [(models, "models"), (folder, "full")] {
        let from = from.canonicalize().expect("it exists");
        std::os::unix::fs::symlink(from, place.path().join(to)).expect("a link");
    }
    fs_err::write(place.path().join("model.toml"), described).expect("it is writable");
    let model = ModelDir::open(place.path()).expect("it opens");
    (place, model)
}

#[test]
#[ignore = "needs 320 MB of model files: SLAG_CLIP_B32=DIR"]
fn cut_texts_equal_padded_ones_in_32_bits_and_nearly_in_8() {
    let (folder, models, options) = setting();
    let golden = fs_err::read(models.join("clip_tokenizer/golden_tokens.json")).expect("it is readable");
    let golden: serde_json::Value = serde_json::from_slice(&golden).expect("it is JSON");
    let texts = golden["texts"].as_array().expect("a list").iter();
    let texts: Vec<&str> =
        texts.filter_map(|entry| entry["text"].as_str()).filter(|t| !t.trim().is_empty()).collect();
    for (file, least_cosine) in [("text_model.onnx", 1.0 - 1e-6), ("text_model_int8.onnx", 0.999)] {
        let encoder = |padding: &str| {
            let described =
                described(file, "vision_model.onnx").replace("prompt =", &format!("{padding}\nprompt ="));
            let (_place, model) = opened(&described, &models, &folder);
            model.text_encoder(&options).expect("it loads")
        };
        let (mut cut, mut padded) = (encoder(""), encoder("padding = { n_tokens = 77, token_id = 49407 }"));
        let mut cosines = Vec::new();
        for text in &texts {
            let (cut, padded) = (cut.encode(text).expect("it runs"), padded.encode(text).expect("it runs"));
            let cosine = cut.iter().zip(&padded).map(|(&a, &b)| f64::from(a) * f64::from(b)).sum::<f64>();
            cosines.push((cosine, text));
        }
        cosines.sort_by(|a, b| a.0.total_cmp(&b.0));
        let (least, median) = (cosines[0], cosines[cosines.len() / 2].0);
        println!(
            "{file}: {} texts, least cosine {:.7} ({:?}), median {median:.7}",
            texts.len(),
            least.0,
            least.1
        );
        assert!((least_cosine..=1.0 + 1e-6).contains(&least.0), "{file}: {least:?}");
    }
}

#[test]
#[ignore = "needs 440 MB of model files: SLAG_CLIP_B32=DIR"]
fn batches_of_8_bit_images_are_fixed() {
    let (folder, models, options) = setting();
    for file in ["vision_model.onnx", "vision_model_int8.onnx"] {
        let described = described("text_model.onnx", file).replace("batch = 8", "");
        let (_place, model) = opened(&described, &models, &folder);
        let batch = model.image_encoder(&options).expect("it loads").preferred_batch();
        println!("{file}: batches of {batch}");
        assert!(file == "vision_model.onnx" || batch == 16);
    }
}
