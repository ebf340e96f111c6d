//! SigLIP 2's two sides as `models pull` describes them, against transformers and PyTorch
//! (`tests/models/siglip2_tiny/export.py`): preprocessing, tokens with their end and padding, vectors.

use super::*;

/// Components of a vector, and pixels of the square; the public models have 768 and 224.
const DIM: usize = 24;
const SIZE_PX: usize = 48;

/// Writes the model with the description that a pulled SigLIP 2 gets, `change` applied.
fn pulled(folder: &Path, change: impl Fn(String) -> String) -> ModelDir {
    let table: toml::Table = include_str!("../models.toml").parse().expect("it is TOML");
    let layout = table["layout"]["siglip2"]["description"].as_str().expect("a text");
    let mut description = layout.replace("size_px = 224", &format!("size_px = {SIZE_PX}"));
    assert_ne!(description, layout);
    for (name, file) in
        [("IMAGE", "vision_model.onnx"), ("TEXT", "text_model.onnx"), ("TOKENIZER", "tokenizer.json")]
    {
        description = description.replace(name, file);
        fs_err::copy(model_dir("siglip2_tiny").join(file), folder.join(file)).expect("it copies");
    }
    let head = format!("name = \"siglip2-tiny-random\"\ndim = {DIM}\nlicence = \"Apache-2.0 OR MIT\"\n");
    fs_err::write(folder.join("model.toml"), head + &change(description)).expect("it is writable");
    ModelDir::open(folder).expect("it opens")
}

/// The texts as recorded, with their 64 ids.
fn texts() -> Vec<(String, Vec<u32>)> {
    let json = fs_err::read(model_dir("siglip2_tiny").join("golden_tokens.json")).expect("it is readable");
    let json: serde_json::Value = serde_json::from_slice(&json).expect("it is JSON");
    let of = |entry: &serde_json::Value| {
        let ids = entry["ids"].as_array().expect("a list");
        let ids = ids.iter().map(|id| id.as_u64().expect("an id") as u32).collect();
        (entry["text"].as_str().expect("a text").to_owned(), ids)
    };
    json.as_array().expect("a list").iter().map(of).collect()
}

#[test]
fn pixel_values_equal_the_processors() {
    let golden = model_dir("siglip2_tiny").join("golden.npz");
    let steps = Preprocess::new(SIZE_PX as u32, Resize::Stretch, Filter::Bilinear, [0.5; 3], [0.5; 3]);
    let (shape, expected) = array::<f32>(&golden, "pixel_values");
    assert_eq!(shape, [3, 3, SIZE_PX, SIZE_PX]);
    for (k, expected) in expected.chunks_exact(3 * SIZE_PX * SIZE_PX).enumerate() {
        let mut values = Vec::new();
        steps.append_pixel_values(&steps.square(&image(&golden, &format!("image_{k}"))), &mut values);
        let expected: Vec<f64> = expected.iter().copied().map(f64::from).collect();
        let difference = max_difference(&values, &expected);
        assert!(difference < 1e-6, "image {k}: {difference}");
    }
}

#[test]
fn image_vectors_equal_the_recorded_ones() {
    let (folder, golden) = (tempfile::tempdir().unwrap(), model_dir("siglip2_tiny").join("golden.npz"));
    let mut encoder = pulled(folder.path(), |as_it_is| as_it_is).image_encoder(&options()).expect("it loads");
    let crops: Vec<Crop> = (0..3).map(|k| Crop::whole(image(&golden, &format!("image_{k}")))).collect();
    let found = encoder.encode(&crops).expect("it encodes");
    assert_recorded(&found, &array::<f32>(&golden, "image_embeds").1, DIM, 2e-6);
}

/// Ids up to the end; the rest of the recorded 64 is padding.
#[test]
fn tokens_equal_those_of_transformers() {
    let file = model_dir("siglip2_tiny").join("tokenizer.json");
    let tokens = Tokens::open(&(&file).into(), 64, 1).expect("it opens");
    let mut longest = 0;
    for (text, expected) in texts() {
        let ids = tokens.ids(&text.to_lowercase()).expect("it encodes");
        assert!(expected.len() == 64 && expected[ids.len()..].iter().all(|id| *id == 0), "{text:?}");
        assert_eq!(ids, expected[..ids.len()], "{text:?}");
        longest = longest.max(ids.len());
    }
    assert_eq!(longest, 64, "one text is cut");
}

#[test]
fn text_vectors_equal_the_recorded_ones() {
    let folder = tempfile::tempdir().expect("a folder");
    let bare = |description: String| description.replace("a photo of a {}", "{}");
    let mut encoder = pulled(folder.path(), bare).text_encoder(&options()).expect("it loads");
    let (_, expected) = array::<f32>(&model_dir("siglip2_tiny").join("golden.npz"), "text_embeds");
    let vectors: Vec<Vec<f64>> = expected.chunks_exact(DIM).map(unit).collect();
    for ((text, _), expected) in texts().iter().zip(&vectors) {
        let difference = max_difference(&encoder.encode(text).expect("it encodes"), expected);
        assert!(difference < 1e-5, "{text:?}: {difference}");
    }
    // With the description's own prompt the noun alone has the first vector.
    let other = tempfile::tempdir().expect("a folder");
    let mut encoder = pulled(other.path(), |as_it_is| as_it_is).text_encoder(&options()).expect("it loads");
    let found = encoder.encode(" Chair").expect("it encodes");
    assert!(max_difference(&found, &vectors[0]) < 1e-5);
    assert!(max_difference(&found, &vectors[1]) > 0.01, "vectors of texts differ");
}
