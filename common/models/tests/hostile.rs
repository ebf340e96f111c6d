//! Descriptions, vector files and phrase lists with 1,000 damages each: accepted or refused, never a panic.

use std::collections::BTreeMap;

use crate::common::model_dir;
use safetensors::tensor::{Dtype, TensorView};
use slag_math::random::Random;
use slag_models::phrases::PhraseEncoder;
use slag_models::{ModelDir, TextEncoder, tensors};
use slag_test_support::damaged;

const N_MUTATIONS: u64 = 1000;

#[test]
fn descriptions_are_used_or_refused() {
    let text = fs_err::read(model_dir("conse").join("model.toml")).expect("it is readable");
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("model.toml");
    let mut n_refused = 0;
    for seed in 0..N_MUTATIONS {
        let _ = fs_err::remove_file(&path);
        fs_err::write(&path, damaged(&text, &mut Random::new(seed))).expect("it is writable");
        if let Err(error) = ModelDir::open(folder.path()) {
            assert!(!error.to_string().is_empty());
            n_refused += 1;
        }
    }
    // Flips within comments and prose do no harm.
    assert!(n_refused > N_MUTATIONS / 4, "{n_refused}");
}

#[test]
fn vectors_and_phrases_are_used_or_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let (vectors_path, phrases_path) =
        (folder.path().join("vectors.safetensors"), folder.path().join("phrases.txt"));
    let values: Vec<u8> = (0..12).flat_map(|i| (i as f32 - 5.5).to_le_bytes()).collect();
    let tensor = TensorView::new(Dtype::F32, vec![3, 4], &values).expect("a tensor");
    let vectors = safetensors::serialize(BTreeMap::from([("vectors", tensor)]), None).expect("serialises");
    let phrases = b"red chair\ntable\nfloor lamp\n";
    let write = |vectors: &[u8], phrases: &[u8]| {
        for (path, bytes) in [(&vectors_path, vectors), (&phrases_path, phrases)] {
            let _ = fs_err::remove_file(path);
            fs_err::write(path, bytes).expect("it is writable");
        }
    };
    let open = || PhraseEncoder::open("test", 4, &phrases_path, (&vectors_path, "vectors"), None);
    write(&vectors, phrases);
    assert_eq!(open().expect("valid").encode("table").expect("known").len(), 4);
    for seed in 0..N_MUTATIONS {
        write(&damaged(&vectors, &mut Random::new(seed)), phrases);
        if let Err(error) = tensors::read(&vectors_path, "vectors", Some(3), 4) {
            assert!(error.to_string().contains("vectors.safetensors"), "{error}");
        }
        write(&vectors, &damaged(phrases, &mut Random::new(seed)));
        if let Ok(mut encoder) = open() {
            let vector = encoder.encode("floor lamp").unwrap_or_else(|_| vec![0.0; 4]);
            assert!(vector.iter().all(|v| v.is_finite()));
        }
    }
}
