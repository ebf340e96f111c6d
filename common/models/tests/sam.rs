//! SAM's two files against tensors recorded with transformers and PyTorch; wrong files, one clear message each.

use super::*;

use crate::common::max_difference_of_planes as max_difference;
use slag_models::sam::Embedding;

fn open() -> (std::path::PathBuf, Sam) {
    let (golden, options) = (shared("models/sam_tiny/golden.npz"), options());
    (golden, Sam::open(&model_dir("sam_tiny"), &options).expect("it opens"))
}

fn recorded_embedding(golden: &Path, sam: &Sam) -> Embedding {
    sam.embed(&image(golden, "image")).expect("it runs")
}

#[needs_shared]
fn pixel_values_and_embeddings_equal_the_recorded_ones() {
    let (golden, sam) = open();
    let photo = image(&golden, "image");
    let (_, expected) = array::<f32>(&golden, "pixel_values_sub16");
    let difference = max_difference(&sam.pixel_values(&photo), 1024, 16, &expected);
    assert!(difference < 1e-6, "pixel values: {difference}");

    let embedding = recorded_embedding(&golden, &sam);
    let (_, [height, width]) = size(&golden, "reshaped_size");
    assert_eq!(
        embedding.letterbox,
        Letterbox { size_px: 1024, image_px: [211, 150], resized_px: [width, height], is_stretched: false }
    );
    let mut n_tensors = 0;
    for (name, shape, values) in embedding.tensors() {
        assert_eq!(shape, [1, 32, 64, 64]);
        let (_, expected) = array::<f32>(&golden, &format!("{name}_sub8"));
        let difference = max_difference(values, 64, 8, &expected);
        // ONNX Runtime and torch differ by 3.7e-6.
        assert!(difference < 1e-5, "{name}: {difference}");
        n_tensors += 1;
    }
    assert_eq!(n_tensors, 2);
}

fn size(golden: &Path, name: &str) -> (Vec<usize>, [u32; 2]) {
    let (shape, size) = array::<i64>(golden, name);
    (shape, [size[0] as u32, size[1] as u32])
}

#[needs_shared]
fn masks_and_scores_equal_the_recorded_ones() {
    let (golden, sam) = open();
    let embedding = recorded_embedding(&golden, &sam);
    let (_, points) = array::<f32>(&golden, "input_points");
    let (_, labels) = array::<i64>(&golden, "input_labels");
    let points = points.as_chunks::<2>().0;
    let decoded = sam.decode(&embedding, 3, points, &labels).expect("it runs");
    assert_eq!(decoded.logits_px, [256, 256]);
    let (_, expected) = array::<f32>(&golden, "iou_scores");
    let difference = max_difference(&decoded.predicted_ious, 9, 1, &expected);
    assert!(difference < 1e-5, "scores: {difference}");
    let (_, expected) = array::<f32>(&golden, "pred_masks_sub8");
    let difference = max_difference(&decoded.logits, 256, 8, &expected);
    assert!(difference < 1e-5, "masks: {difference}");
    let (_, positive) = array::<u8>(&golden, "pred_masks_positive");
    let differing = decoded.logits.iter().enumerate().filter(|&(at, &logit)| {
        let is_positive = positive[at / 8] & (0x80 >> (at % 8)) != 0;
        (logit > 0.0) != is_positive && logit.abs() > 1e-5
    });
    assert_eq!(differing.count(), 0);

    // The first point of the third prompt alone, as automatic masks are asked for.
    let decoded = sam.decode(&embedding, 1, &points[4..5], &[1]).expect("it runs");
    let (_, expected) = array::<f32>(&golden, "single_point_pred_masks_sub8");
    let difference = max_difference(&decoded.logits, 256, 8, &expected);
    assert!(difference < 1e-5, "a single point: {difference}");
}

#[needs_shared]
fn wrong_descriptions_and_files_are_named() {
    let (models, options) = (shared("models"), options());
    let description = fs_err::read_to_string(model_dir("sam_tiny").join("model.toml")).unwrap();
    let (encoder, decoder) = ("vision_encoder.onnx", "prompt_encoder_mask_decoder.onnx");
    let message = |replacements: &[(&str, &str)], hashes: bool| {
        let folder = tempfile::tempdir().expect("a folder");
        link_models(folder.path());
        let cut = fs_err::read(models.join("sam_tiny").join(decoder)).expect("it is readable");
        fs_err::write(folder.path().join("cut.onnx"), &cut[..cut.len() / 2]).expect("it is writable");
        let mut text =
            description.replace("../../../../shared/models", ".").replace("sam_tiny/", "models/sam_tiny/");
        if !hashes {
            text = unhashed(&text);
        }
        for (from, to) in replacements {
            assert!(text.contains(from), "{from:?} is not in the description");
            text = text.replace(from, to);
        }
        fs_err::write(folder.path().join("model.toml"), text).expect("it is writable");
        Sam::open(folder.path(), &options).expect_err("it must be refused").to_string()
    };
    for (from, to, expected) in [
        ("kind = \"sam\"", "kind = \"sam3\"", "sam3"),
        ("kind = \"sam\"", "kind = \"sam\"\nsize_px = 7", "segment.size_px is 7, expected 64 to 2048"),
        ("kind = \"sam\"", "kind = \"sam\"\nstd = [0.0, 1.0, 1.0]", "segment.std is [0.0"),
        ("kind = \"sam\"", "kind = \"sam\"\nboxes = true", "boxes"),
        ("[segment]", "[image]", "image"),
        ("name = \"sam-tiny-random\"", "name = \"two words\"", "name is \"two words\""),
        ("models/sam_tiny/vision", "../vision", "segment.image_encoder is ../vision_encoder.onnx"),
        ("38dc6328", "00000000", "SHA-256 is 38dc6328"),
        ("vision_encoder.onnx", "absent.onnx", "absent.onnx"),
    ] {
        let message = message(&[(from, to)], true);
        assert!(message.contains(expected), "{to}: {message}");
    }
    let swapped = [(encoder, "temporary"), (decoder, encoder), ("temporary", decoder)];
    for (replacements, expected) in [
        (&swapped[..], "expected an image encoder's only one, f32 [-1, 3, 1024, 1024]"),
        (&[(decoder, encoder)], "expected points f32"),
        (&[("sam_tiny/vision_encoder", "clip_tiny/vision_model")], "expected f32 [-1, 3, 1024, 1024]"),
        (
            &[("kind = \"sam\"", "kind = \"sam\"\nsize_px = 512")],
            "is f32 [-1, 3, 1024, 1024], expected f32 [-1, 3, 512, 512]",
        ),
        (&[("sam_tiny/prompt_encoder_mask_decoder", "clip_tiny/text_model")], "expected points f32"),
        (&[("models/sam_tiny/prompt_encoder_mask_decoder.onnx", "cut.onnx")], "fetch the model file again"),
        (&[(decoder, "golden.npz")], "fetch the model file again"),
    ] {
        let message = message(replacements, false);
        assert!(message.contains(expected), "{replacements:?}: {message}");
    }
}
