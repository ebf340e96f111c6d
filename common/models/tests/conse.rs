//! The real small pair: ConSE image vectors and CLIP phrase vectors.

use super::*;
use std::sync::Arc;

use ::image::{RgbImage, imageops};
use half::f16;
use safetensors::SafeTensors;

fn golden_images(golden: &std::path::Path) -> Vec<RgbImage> {
    let (shape, levels) = array::<u8>(golden, "images");
    assert_eq!(shape, [3, 224, 224, 3]);
    levels
        .chunks_exact(224 * 224 * 3)
        .map(|levels| RgbImage::from_raw(224, 224, levels.to_vec()).expect("it is RGB"))
        .collect()
}

#[needs_shared]
fn image_vectors_equal_the_recorded_ones_in_any_batch() {
    let (golden, options) = (shared("models/image_encoder/golden.npz"), options());
    let model = ModelDir::open(&model_dir("conse")).expect("it opens");
    let mut encoder = model.image_encoder(&options).expect("it loads");
    let images = golden_images(&golden);
    let (_, expected) = array::<f32>(&golden, "embedding");
    let alone: Vec<f32> = images
        .iter()
        .flat_map(|image| encoder.encode(&[Crop::whole(image.clone())]).expect("it encodes"))
        .collect();
    // Recorded with ONNX Runtime 1.19; its 8-bit kernels round like ours.
    assert_recorded(&alone, &expected, 512, 1e-5);
    // 20 crops: one whole batch and one part.
    let crops: Vec<Crop> = (0..20).map(|i| Crop::whole(images[i % 3].clone())).collect();
    let together = encoder.encode(&crops).expect("it encodes");
    for (i, found) in together.chunks_exact(512).enumerate() {
        assert!(found == &alone[i % 3 * 512..][..512], "crop {i} depends on its batch");
    }
    assert_eq!(together.len(), 20 * 512);
    let four_threads = SessionOptions { intra_op_threads: 4, ..options };
    let again = model.image_encoder(&four_threads).expect("it loads").encode(&crops).expect("it encodes");
    assert!(again == together, "vectors depend on the number of threads");
}

#[needs_shared]
fn phrase_vectors_equal_the_file_centred_in_f64() {
    let models = shared("models");
    // No ONNX Runtime is needed: a robot with the text files only.
    let no_runtime = SessionOptions::new("no-such-library.so".into());
    let mut encoder = ModelDir::open(&model_dir("conse")).unwrap().text_encoder(&no_runtime).unwrap();
    let bytes = fs_err::read(models.join("clip_text/vectors.safetensors")).expect("it is readable");
    let tensors = SafeTensors::deserialize(&bytes).expect("it parses");
    let mean: Vec<f64> = tensors
        .tensor("mean")
        .expect("it is there")
        .data()
        .as_chunks()
        .0
        .iter()
        .map(|&b| f64::from(f32::from_le_bytes(b)))
        .collect();
    let vectors = tensors.tensor("vectors").expect("it is there");
    let phrases = fs_err::read_to_string(models.join("clip_text/phrases.txt")).expect("it is readable");
    let mut found_of = std::collections::HashMap::new();
    for (phrase, row) in phrases.lines().zip(vectors.data().chunks_exact(1024)) {
        let row: Vec<f32> = row.as_chunks().0.iter().map(|&b| f16::from_le_bytes(b).to_f32()).collect();
        let centred: Vec<f64> = unit(&row).iter().zip(&mean).map(|(t, m)| t - m).collect();
        let norm = centred.iter().map(|x| x * x).sum::<f64>().sqrt();
        let found = encoder.encode(phrase).expect("it is known");
        let difference = max_difference(&found, &centred.iter().map(|x| x / norm).collect::<Vec<_>>());
        assert!(difference < 1e-6, "{phrase}: {difference}");
        found_of.insert(phrase, found);
    }
    assert_eq!(encoder.vocabulary().expect("it is a list").len(), found_of.len());
    // Cosines that the vectors' makers list.
    for (a, b, expected) in [("chair", "armchair", 0.816), ("chair", "banana", -0.039), ("cat", "dog", 0.548)]
    {
        let cosine: f32 = found_of[a].iter().zip(&found_of[b]).map(|(a, b)| a * b).sum();
        assert!((cosine - expected).abs() < 1e-3, "{a}, {b}: {cosine}");
    }
    for same in [" Chair", "the chair", "A  CHAIR\t", "an chair", "chairs"] {
        assert_eq!(encoder.encode(same).expect("it is known"), found_of["chair"], "{same:?}");
    }
    let others = [("knives", "knife"), ("boxes", "box"), ("butterflies", "butterfly")];
    let spelt = [("lamb chop", "lamb-chop"), ("traffic-lights", "traffic light")];
    let limited = Arc::clone(encoder.known_phrases().expect("it knows some"));
    let called = [("tractor", "tractor (farm equipment)"), ("basins", "bowl/basin")];
    for (asked, known) in others.into_iter().chain(spelt).chain(called) {
        assert_eq!(encoder.encode(asked).expect("it is known"), found_of[known], "{asked:?}");
        assert_eq!(limited.asked_as(asked), None, "{asked:?}");
    }
    for (asked, known) in [("settee", "sofa"), ("Wheelie-bins", "trash can"), ("hard hat", "helmet")] {
        assert_eq!(limited.asked_as(asked).as_deref(), Some(known));
        assert_eq!(encoder.encode(asked).expect("it is known"), found_of[known], "{asked:?}");
    }
    assert_eq!((limited.asked_as("sofa"), limited.asked_as("red settee")), (None, None));
}

#[needs_shared]
fn an_unknown_phrase_is_answered_with_near_ones() {
    let no_runtime = SessionOptions::new("no-such-library.so".into());
    let mut encoder = ModelDir::open(&model_dir("conse")).unwrap().text_encoder(&no_runtime).unwrap();
    let mut near = |text: &str| match encoder.encode(text) {
        Err(InferenceError::UnknownPhrase { near, n_known: 1612, .. }) => near,
        other => panic!("{text:?}: {other:?}"),
    };
    assert_eq!(near("refridgerator")[0], "refrigerator");
    assert_eq!(near("chiar")[0], "chair");
    // "cup" comes first in the list, and is its beginning.
    assert_eq!(near("cupcaks")[..2], ["cupcake", "cup"]);
    assert!(near("red sofa").contains(&"sofa".to_owned()));
    assert_eq!(near("zzzzzzzz"), Vec::<String>::new());
    assert_eq!(near(&"very long ".repeat(1000)), Vec::<String>::new());
    assert!(matches!(encoder.encode("  "), Err(InferenceError::EmptyText)));
}

#[needs_shared]
fn a_photograph_finds_its_words() {
    let (golden, options) = (shared("models/image_encoder/golden.npz"), options());
    let model = ModelDir::open(&model_dir("conse")).expect("it opens");
    let mut images = model.image_encoder(&options).expect("it loads");
    let mut texts = model.text_encoder(&options).expect("it loads");
    // Grace Hopper in uniform, twice as large and stretched: the resizing is the encoder's.
    let large = imageops::resize(&golden_images(&golden)[0], 500, 330, imageops::FilterType::CatmullRom);
    let vector = images.encode(&[Crop::whole(large)]).expect("it encodes");
    let mut score = |text: &str| -> f32 {
        texts.encode(text).expect("it is known").iter().zip(&vector).map(|(a, b)| a * b).sum()
    };
    let (right, wrong) = (score("tie").max(score("suit")), score("banana").max(score("refrigerator")));
    assert!(right > wrong + 0.2, "{right} {wrong}");
}
