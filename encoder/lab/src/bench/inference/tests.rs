//! The benchmark on the processor, with small models.

use super::*;

#[slag_test_support::needs_shared]
#[test]
fn crops_and_photos_are_counted_on_the_processor() {
    let dir = tempfile::tempdir().expect("a folder");
    for file in ["vision_encoder.onnx", "prompt_encoder_mask_decoder.onnx"] {
        let from = slag_test_support::shared("models/sam_tiny").join(file);
        fs_err::copy(from, dir.path().join(file)).expect("copies");
    }
    let description = "name = 'tiny'\nlicence = 'MIT'\n[segment]\nkind = 'sam'\n\
                       image_encoder = { path = 'vision_encoder.onnx' }\n\
                       mask_decoder = { path = 'prompt_encoder_mask_decoder.onnx' }\n";
    fs_err::write(dir.path().join("model.toml"), description).expect("writes");
    let options = InferenceOptions {
        models: Some(ModelDir::embedded().expect("opens")),
        segmenter: Some(dir.path().to_owned()),
        session: SessionOptions::new(slag_test_support::onnx_runtime()),
        gpus: vec![0, 1],
        grids: vec![1],
        points_per_batch: 4,
        secs: 0.2,
        n_threads: 1,
        rivals: None,
    };
    let report = run(&options).expect("runs");
    let whats: Vec<(&str, usize)> = report.measured.iter().map(|m| (&*m.what, m.gpus.len())).collect();
    let of_photos = ["photos, grid 1, models alone", "photos, grid 1, all masks filtered"];
    let expected = [("crops", 1), (of_photos[0], 1), (of_photos[1], 1)];
    assert_eq!(whats[..3], expected);
    assert_eq!(whats[3..], expected.map(|(what, _)| (what, 2)));
    for measured in &report.measured {
        let Measured { n, secs, per_sec, .. } = measured;
        assert!(*n > 0 && *secs >= 0.2 && (per_sec - *n as f64 / secs).abs() < 1e-9, "{measured:?}");
    }
    assert!(report.measured[0].n.is_multiple_of(CROPS_PER_VIEW));
    assert!(report.to_string().contains("photos, grid 1, models alone"));
}
