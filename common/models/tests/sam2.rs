//! SAM 2.1's two files, with their weights beside them, against tensors recorded with transformers and PyTorch
//! (`tests/models/sam2_tiny/export.py`).

use super::*;
use std::path::PathBuf;

use crate::common::max_difference_of_planes as max_difference;

fn golden() -> PathBuf {
    model_dir("sam2_tiny").join("golden.npz")
}

fn open() -> Sam {
    Sam::open(&model_dir("sam2_tiny"), &options()).expect("it opens")
}

#[test]
fn photos_are_stretched_and_their_three_maps_equal_the_recorded_ones() {
    let (golden, sam) = (golden(), open());
    let photo = image(&golden, "image");
    let (_, expected) = array::<f32>(&golden, "pixel_values_sub8");
    let difference = max_difference(&sam.pixel_values(&photo), 256, 8, &expected);
    assert!(difference < 1e-6, "pixel values: {difference}");
    let embedding = sam.embed(&photo).expect("it runs");
    assert_eq!(embedding.letterbox, Letterbox::stretched(256, [101, 67]));
    assert_eq!(embedding.letterbox.point([101.0, 67.0]), [256.0, 256.0]);
    let mut shapes = Vec::new();
    for (k, (name, shape, values)) in embedding.tensors().enumerate() {
        assert_eq!(name, format!("image_embeddings.{k}"));
        let (_, expected) = array::<f32>(&golden, &format!("embedding_{k}_sub8"));
        let difference = max_difference(values, shape[3] as usize, 8, &expected);
        // ONNX Runtime and PyTorch differ by 1.0e-5 on values up to 10.
        assert!(difference < 5e-5, "{name}: {difference}");
        shapes.push(shape.to_vec());
    }
    assert_eq!(shapes, [[1, 2, 64, 64], [1, 4, 32, 32], [1, 16, 16, 16]]);
}

#[test]
fn scores_masks_and_objects_equal_the_recorded_ones() {
    let (golden, sam) = (golden(), open());
    let embedding = sam.embed(&image(&golden, "image")).expect("it runs");
    let (_, points) = array::<f32>(&golden, "points");
    let points = points.as_chunks::<2>().0;
    // The decoder takes one prompt a call; all nine at once give what each gives alone.
    let decoded = sam.decode(&embedding, points.len(), points, &vec![1; points.len()]).expect("it runs");
    assert_eq!(decoded.logits_px, [64, 64]);
    let (_, scores) = array::<f32>(&golden, "iou_scores");
    let (_, objects) = array::<f32>(&golden, "object_score_logits");
    let (_, masks) = array::<f32>(&golden, "pred_masks_sub4");
    assert!(max_difference(&decoded.predicted_ious, 27, 1, &scores) < 1e-5);
    assert!(max_difference(&decoded.object_logits, 9, 1, &objects) < 1e-5);
    assert!(max_difference(&decoded.logits, 64, 4, &masks) < 5e-5);
    assert!(objects.iter().any(|&x| x > 0.0) && objects.iter().any(|&x| x < 0.0), "{objects:?}");
}

/// Copies the model and returns the error of opening it after `change`.
fn refusal(change: impl Fn(&Path)) -> String {
    let folder = tempfile::tempdir().expect("a folder");
    for entry in fs_err::read_dir(model_dir("sam2_tiny")).expect("it is readable") {
        let path = entry.expect("it is readable").path();
        fs_err::copy(&path, folder.path().join(path.file_name().expect("a file"))).expect("it copies");
    }
    change(folder.path());
    Sam::open(folder.path(), &options()).expect_err("it must be refused").to_string()
}

#[test]
fn weights_beside_the_graph_are_part_of_the_model() {
    let data = "vision_encoder.onnx_data";
    let message = refusal(|folder| {
        let mut bytes = fs_err::read(folder.join(data)).expect("it is readable");
        bytes[100] ^= 1;
        fs_err::write(folder.join(data), bytes).expect("it is writable");
    });
    assert!(message.contains(data) && message.contains("SHA-256 is"), "{message}");
    let message = refusal(|folder| fs_err::remove_file(folder.join(data)).expect("it is there"));
    assert!(message.contains(data), "{message}");
    let replace = |from: &'static str, to: &'static str| {
        move |folder: &Path| {
            let path = folder.join("model.toml");
            let text = fs_err::read_to_string(&path).expect("it is readable");
            assert!(text.contains(from));
            fs_err::write(path, text.replace(from, to)).expect("it is writable");
        }
    };
    let message =
        refusal(replace("path = \"vision_encoder.onnx_data\"", "path = \"../vision_encoder.onnx_data\""));
    assert!(message.contains("a relative path without .."), "{message}");
    let message = refusal(replace("kind = \"sam2\"\nsize_px = 256", "kind = \"sam2\"\nsize_px = 1024"));
    assert!(message.contains("[-1, 3, 256, 256], expected f32 [-1, 3, 1024, 1024]"), "{message}");
    // The weights' hashes are in the identity.
    let sam = open();
    let description = fs_err::read_to_string(model_dir("sam2_tiny").join("model.toml")).unwrap();
    let hashes: Vec<_> = description.split("sha256 = \"").skip(1).map(|rest| &rest[..64]).collect();
    assert!(hashes.len() == 4 && hashes.iter().all(|hash| sam.id().contains(hash)), "{}", sam.id());
}
