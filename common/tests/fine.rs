//! Fine residuals of exact shards: round trip, decoding as in docs/formats.md, refusal of invalid ones.

use super::*;
use half::f16;
use slag_common::container::ContainerError;
use slag_common::shard::{Basis, ExactColumns, Fine, ScoreErrors, ShardView};

struct Parts {
    errors: ScoreErrors,
    steps: Vec<f32>,
    scales: Vec<f32>,
    values: Vec<i8>,
}

/// Three Gaussians with evidence in two centroids and one without; three dimensions, two components.
fn written(edit: impl FnOnce(&mut Parts)) -> AlignedBytes {
    let mut parts = Parts {
        errors: ScoreErrors { mean: 0.001, likely: 0.005, max: 0.01, spread: 0.07 },
        steps: vec![0.5, 0.25],
        scales: vec![0.01, 0.02],
        values: vec![1, -2, 127, -128, 5, 0],
    };
    edit(&mut parts);
    let Parts { errors, steps, scales, values } = &parts;
    let fine = Fine { errors: *errors, steps, scales, values };
    let mean = [0.5, 0.25, -0.5].map(f16::from_f32);
    let mut out = Vec::new();
    let bounds = Aabb { min: DVec3::ZERO, max: DVec3::ONE };
    let shard = SampleShard {
        header: ShardHeader { n_components: 2, centroid_step: 0.125, ..sample::header(1, 4, 2, 3, bounds) },
        positions: vec![[0; 3]; 4],
        centroid_starts: vec![0, 1, 3],
        centroids: vec![4, -8, 16, 2],
        radii: vec![0.1, 0.2],
        embeddings: None,
    };
    ShardView {
        basis: Some(Basis { mean: &mean, vectors: &[100, 0, 50, 0, -20, 10], steps: &[0.01, 0.02] }),
        exact: Some(ExactColumns {
            input_indices: &[3, 2, 1, 0],
            embeddings: &[f16::from_f32(0.5); 9],
            fine: Some(fine),
        }),
        ..shard.view()
    }
    .write(&mut out)
    .expect("writes to memory");
    AlignedBytes::copy_of(&out)
}

#[test]
fn fine_residuals_are_read_and_decoded() {
    let bytes = written(|_| {});
    let shard = ShardLayout::check(&bytes).expect("valid").view(&bytes);
    let fine = shard.exact.and_then(|exact| exact.fine).expect("written");
    assert_eq!((fine.errors.likely, fine.steps, fine.scales), (0.005, &[0.5, 0.25][..], &[0.01, 0.02][..]));
    // By hand: Gaussian 1 belongs to centroid 1 with components 2 and 0.25; its residual adds 127 * 0.5 * 0.02 and
    // -128 * 0.25 * 0.02.
    let c = [2.0 + 1.27, 0.25 - 0.64];
    let expected = [0.5 + c[0], 0.25 + c[1] * -0.4, -0.5 + c[0] * 0.5 + c[1] * 0.2];
    let mut decoded = [0.0; 3];
    shard.decode_fine(1, &fine, &mut decoded);
    for (found, expected) in decoded.iter().zip(expected) {
        assert!((found - expected).abs() < 1e-6, "{decoded:?} {expected:?}");
    }
}

#[test]
fn invalid_contents_are_refused() {
    let refused = |edit: fn(&mut Parts)| -> String {
        let error: ContainerError = ShardLayout::check(&written(edit)).expect_err("must be refused");
        error.to_string()
    };
    assert!(refused(|p| p.errors.mean = f32::NAN).contains("error"));
    assert!(refused(|p| p.steps[1] = -1.0).contains("fine steps"));
    assert!(refused(|p| p.steps.truncate(1)).contains("bytes"));
    assert!(refused(|p| p.scales[0] = f32::INFINITY).contains("fine scales"));
    assert!(refused(|p| p.values.truncate(5)).contains("bytes"));
}
