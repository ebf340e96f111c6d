//! CLIP's two sides against vectors recorded with transformers, Pillow and openai/CLIP.

use super::*;
use slag_models::clean::clean;
use slag_models::preprocess::{Window, resample};

fn clip_preprocess() -> Preprocess {
    let (mean, std) = ([0.48145466, 0.4578275, 0.40821073], [0.26862954, 0.26130258, 0.27577711]);
    Preprocess::new(224, Resize::ShortestEdge, Filter::Bicubic, mean, std)
}

#[needs_shared]
fn every_step_of_preprocessing_equals_pillow() {
    let golden = shared("models/clip_tiny/golden.npz");
    let clip = clip_preprocess();
    for k in 0..6 {
        let photo = image(&golden, &format!("image_{k}"));
        let (resized, _) = clip.plan(photo.width(), photo.height());
        let (_, expected) = array::<i64>(&golden, &format!("resized_size_{k}"));
        assert_eq!(resized.map(|x| x as i64)[..], expected[..], "size of image {k}");
        if [0, 3].contains(&k) {
            let whole =
                Window { left_px: 0, top_px: 0, width_px: resized[0] as u32, height_px: resized[1] as u32 };
            let found = resample(&photo, Filter::Bicubic, resized, whole);
            assert!(found == image(&golden, &format!("resized_{k}")), "pixels of resized {k}");
        }
        if [0, 3, 5].contains(&k) {
            assert!(clip.square(&photo) == image(&golden, &format!("cropped_{k}")), "pixels of cropped {k}");
        }
    }
    let mut values = Vec::new();
    clip.append_pixel_values(&image(&golden, "image_0"), &mut values);
    let (_, expected) = array::<f32>(&golden, "pixel_values");
    let expected: Vec<f64> = expected.into_iter().map(f64::from).collect();
    assert!(max_difference(&values, &expected) < 1e-6, "{}", max_difference(&values, &expected));
}

/// Squares prepared in advance have the vectors of their crops: nothing is resized twice.
#[test]
fn a_square_stays_as_it_is() {
    let photo =
        image::RgbImage::from_fn(61, 97, |x, y| image::Rgb([(x * y) as u8, (3 * x) as u8, (y ^ x) as u8]));
    for resize in [Resize::ShortestEdge, Resize::Stretch, Resize::Pad] {
        let steps = Preprocess::new(48, resize, Filter::Bicubic, [0.5; 3], [0.5; 3]);
        let square = steps.square(&photo);
        assert!(steps.square(&square) == square, "{resize:?}");
    }
}

#[needs_shared]
fn image_vectors_equal_the_recorded_ones() {
    let (golden, options) = (shared("models/clip_tiny/golden.npz"), options());
    let mut encoder = ModelDir::open(&model_dir("clip_tiny")).unwrap().image_encoder(&options).unwrap();
    let crops: Vec<Crop> = (0..6).map(|k| Crop::whole(image(&golden, &format!("image_{k}")))).collect();
    let found = encoder.encode(&crops).expect("it encodes");
    // ONNX Runtime and torch differ by 1.8e-6 on vectors of length 10 or so.
    assert_recorded(&found, &array::<f32>(&golden, "image_embeds").1, 512, 2e-6);
}

#[needs_shared]
fn token_ids_equal_those_of_openai() {
    let (golden, tokenizer) =
        (shared("models/clip_tokenizer/golden_tokens.json"), shared("models/clip_tokenizer/tokenizer.json"));
    let golden: serde_json::Value =
        serde_json::from_slice(&fs_err::read(golden).expect("it is readable")).expect("it is JSON");
    let tokens = Tokens::open(&(&tokenizer).into(), 77, 49407).expect("it opens");
    let ids = |value: &serde_json::Value| -> Vec<u32> {
        let ids: Vec<u32> = value.as_array().unwrap().iter().map(|id| id.as_u64().unwrap() as u32).collect();
        let end = ids.iter().position(|&id| id == 49407).expect("an end token");
        ids[..=end].to_vec()
    };
    let mut different = Vec::new();
    for entry in golden["texts"].as_array().expect("a list") {
        let text = entry["text"].as_str().expect("a text");
        // Without cleaning, the tokenizer equals Hugging Face's; with cleaning, OpenAI's.
        let hf = if entry["hf_tokenizer_json_equal"] == true { &entry["ids"] } else { &entry["hf_ids"] };
        assert_eq!(tokens.ids(text).expect("it encodes"), ids(hf), "{text:?}");
        if tokens.ids(&clean(text)).expect("it encodes") != ids(&entry["ids"]) {
            different.push(text.to_owned());
        }
    }
    // Python lower-cases the Greek capital sigma by its place in the word, the tokenizer file does not.
    assert_eq!(different, ["İstanbul STRASSE ß Σίσυφος ΣΑΣ"]);
}

#[needs_shared]
fn text_vectors_equal_the_padded_ones_with_and_without_mask() {
    let (models, options) = (shared("models"), options());
    let golden = models.join("clip_tiny/golden.npz");
    let texts: serde_json::Value = serde_json::from_slice(
        &fs_err::read(models.join("clip_tokenizer/golden_tokens.json")).expect("it is readable"),
    )
    .expect("it is JSON");
    let (_, expected) = array::<f32>(&golden, "text_embeds");
    let description = fs_err::read_to_string(model_dir("clip_tiny").join("model.toml")).unwrap();
    let plain = description.replace("a photo of a {}", "{}").replace("../../../../shared/models", "models");
    let masked = plain
        .replace("clip_tiny/text_model.onnx", "clip_tiny/text_model_mask.onnx")
        .replace(
            "1965ec622a100a1beebea6db591985d88f12e057f9772fc83dc8c4c8cd6e5ef0",
            "3d72f35ce559765618898fe79c19c96d767053f3bac0e8ce6541a8e0634ead85",
        )
        .replace("input_ids = ", "attention_mask = \"attention_mask\"\ninput_ids = ");
    for description in [plain, masked] {
        let folder = tempfile::tempdir().expect("a folder");
        link_models(folder.path());
        fs_err::write(folder.path().join("model.toml"), description).expect("it is writable");
        let mut encoder = ModelDir::open(folder.path()).unwrap().text_encoder(&options).unwrap();
        for (k, expected) in expected.chunks_exact(512).enumerate() {
            let text = texts["texts"][k]["text"].as_str().expect("a text");
            // The third is the empty text, which is no query.
            if text.is_empty() {
                assert!(encoder.encode(text).is_err());
                continue;
            }
            let found = encoder.encode(text).expect("it encodes");
            let difference = max_difference(&found, &unit(expected));
            assert!(difference < 1e-5, "{text:?}: {difference}");
        }
    }
}

#[needs_shared]
fn the_prompt_goes_around_the_text() {
    let options = options();
    let mut encoder = ModelDir::open(&model_dir("clip_tiny")).unwrap().text_encoder(&options).unwrap();
    // Recorded: the first text is "a photo of a chair".
    let golden = shared("models/clip_tiny/golden.npz");
    let (_, expected) = array::<f32>(&golden, "text_embeds");
    let found = encoder.encode("  Chair ").expect("it encodes");
    assert!(max_difference(&found, &unit(&expected[..512])) < 1e-5);
}
