use glam::DVec3;
use half::f16;

use super::*;
use crate::container::AlignedBytes;

struct Parts {
    header: ShardHeader,
    centroid_starts: Vec<u32>,
    radii: Vec<f32>,
    subspace_starts: Vec<u32>,
    codewords: Vec<f16>,
    mean: Vec<f16>,
    indices: IndicesHeader,
    index_words: Vec<u32>,
}

/// Six Gaussians, five of them with evidence, in two centroids; four dimensions, three components, two subspaces.
fn written(edit: impl FnOnce(&mut Parts)) -> Vec<u8> {
    let mut parts = Parts {
        header: ShardHeader {
            cell_id: 5,
            n_gaussians: 6,
            n_centroids: 2,
            dim: 4,
            n_components: 3,
            n_subspaces: 2,
            position_bits: [11, 12, 9, 0],
            centroid_step: 0.01,
            origin_in_world: [1e6, -2.0, 3.0],
            position_step: [0.001, 0.002, 0.0],
            box_min: [1e6 - 1.0, -3.0, 2.0],
            box_max: [1e6 + 66.0, 130.0, 4.0],
            errors: ScoreErrors { mean: 0.01, likely: 0.1, max: 0.2, spread: 0.07 },
            encoder_id: [9; 32],
        },
        centroid_starts: vec![0, 2, 5],
        radii: vec![0.1, 0.2],
        subspace_starts: vec![0, 1, 3],
        codewords: (0..48).map(|i| f16::from_f32(i as f32 / 64.0)).collect(),
        mean: [0.5, 0.25, 0.0, -0.5].map(f16::from_f32).to_vec(),
        indices: IndicesHeader { least: 1000, width_bits: 6 },
        // 1, 63, 0, 7, 2 and 9, six bits each; the last begins at bit 30 and ends in the second word.
        index_words: vec![1 | 63 << 6 | 7 << 18 | 2 << 24 | 9 << 30, 9 >> 2],
    };
    edit(&mut parts);
    let mut codes = vec![0u8; BLOCK];
    (0..5).for_each(|i| codes[i] = (i as u8 + 1) << 4 | (15 - i as u8));
    let packed = [0, 1 | 2 << 11 | 3 << 23, u32::MAX, 4, 5, 6];
    let mut out = Vec::new();
    ShardView {
        header: parts.header,
        positions: Positions::Packed(&packed),
        centroid_starts: &parts.centroid_starts,
        centroids: &[1, 2, 3, -4, 5, -128],
        radii: &parts.radii,
        basis: Some(Basis {
            mean: &parts.mean,
            vectors: &[127, 0, 0, 0, 0, 127, 0, 0, 0, 64, -64, 0],
            steps: &[0.01, 0.02, 0.03],
        }),
        residuals: Some(Residuals {
            subspace_starts: &parts.subspace_starts,
            codewords: &parts.codewords,
            residual_scales: &[0.5, 2.0],
            residual_norms: &[1.0, 3.0],
            codes: &codes,
        }),
        exact: None,
        packed_indices: Some(PackedIndices { header: parts.indices, words: &parts.index_words }),
    }
    .write(&mut out)
    .expect("writes to memory");
    out
}

#[test]
fn round_trip() {
    let bytes = AlignedBytes::copy_of(&written(|_| {}));
    let shard = ShardLayout::check(&bytes).expect("valid").view(&bytes);
    let seen = (shard.members(1), shard.centroid_of(1), shard.centroid_of(2), shard.centroid_of(4));
    assert_eq!(seen, (2..5, 0, 1, 1));
    assert_eq!(shard.n_with_evidence(), 5);
    let indices = (0..6).map(|index| shard.input_index(index));
    assert_eq!(indices.collect::<Vec<_>>(), [1001, 1063, 1000, 1007, 1002, 1009].map(Some));
    let p = shard.position_in_world(2);
    assert!((p - DVec3::new(1e6 + 2.047, -2.0 + 4095.0 * 0.002, 3.0)).length() < 1e-9, "{p}");
    assert_eq!(shard.position_in_world(1), DVec3::new(1e6 + 0.001, -2.0 + 0.004, 3.0));
    assert_eq!(shard.position_box().max, p);
    // By hand: components of centroid 1, then code 13 of subspace 0 (codeword 13/64), code 3 of subspace 1
    // (codewords (16 + 6)/64 and 23/64), doubled.
    let mut decoded = [0.0; 4];
    shard.decode(2, &mut decoded);
    let c = [-0.04 + 2.0 * 13.0 / 64.0, 0.05 + 2.0 * 22.0 / 64.0, -1.28 + 2.0 * 23.0 / 64.0];
    let expected = [0.5 + c[0] * 1.27, 0.25 + c[1] * 2.54 + c[2] * 64.0 * 0.03, c[2] * -64.0 * 0.03, -0.5];
    for (found, expected) in decoded.iter().zip(expected) {
        assert!((found - expected).abs() < 1e-6, "{decoded:?} {expected:?}");
    }
    let query = [0.1f32, -0.2, 0.3, 0.4];
    let score: f64 = decoded.iter().zip(query).map(|(d, q)| d * f64::from(q)).sum();
    assert!((shard.scores(&query)[2] - score).abs() < 1e-12);
}

/// A hostile writer can compute correct checksums over invalid contents.
#[test]
fn invalid_contents_are_refused() {
    let refused = |edit: fn(&mut Parts)| ShardLayout::check(&written(edit)).unwrap_err().to_string();
    assert!(refused(|p| p.header.n_gaussians = u32::MAX).contains("bytes"));
    assert!(refused(|p| p.header.n_centroids = 7).contains("centroids"));
    assert!(refused(|p| p.header.dim = 0).contains("components"));
    assert!(refused(|p| p.header.dim = u32::MAX).contains("components"));
    assert!(refused(|p| p.header.n_components = 5).contains("components"));
    assert!(refused(|p| p.header.n_components = 2).contains("bytes"));
    assert!(refused(|p| p.header.n_subspaces = 1).contains("subspaces"));
    assert!(refused(|p| p.header.n_subspaces = u32::MAX).contains("subspaces"));
    assert!(refused(|p| p.header.position_bits = [16; 4]).contains("positions"));
    assert!(refused(|p| p.header.position_bits = [16, 16, 17, 0]).contains("positions"));
    assert!(refused(|p| p.header.position_bits = [16, 16, 16, 0]).contains("positions"));
    assert!(refused(|p| p.header.origin_in_world[1] = f64::NAN).contains("finite"));
    assert!(refused(|p| p.header.box_max[0] = -1.0).contains("empty"));
    assert!(refused(|p| p.header.centroid_step = f32::NAN).contains("step"));
    assert!(refused(|p| p.header.errors.max = -1.0).contains("error"));
    assert!(refused(|p| p.centroid_starts[1] = 9).contains("ascend"));
    assert!(refused(|p| p.centroid_starts[2] = 7).contains("ascend"));
    assert!(refused(|p| p.radii[1] = f32::INFINITY).contains("radii"));
    assert!(refused(|p| p.subspace_starts[2] = 4).contains("ascend"));
    assert!(refused(|p| p.subspace_starts[1] = 3).contains("ascend"));
    assert!(refused(|p| p.codewords[4] = f16::INFINITY).contains("finite"));
    assert!(refused(|p| p.mean[0] = f16::NAN).contains("finite"));
    assert!(refused(|p| p.indices.width_bits = 33).contains("33 bits"));
    assert!(refused(|p| p.indices.width_bits = 32).contains("bytes"));
    assert!(refused(|p| p.indices.least = u32::MAX - 62).contains("Gaussian 1"));
    assert!(refused(|p| p.index_words[1] |= 1 << 4).contains("not zero"));
}

/// The first bytes of a file suffice for its header; fewer, or those of another file, do not.
#[test]
fn a_header_is_read_from_the_start_of_a_file() {
    let bytes = written(|_| {});
    let whole = AlignedBytes::copy_of(&bytes);
    let layout = ShardLayout::check(&whole).expect("valid");
    let start = &bytes[..bytes.len().min(HEADER_END_BYTES as usize)];
    let header = ShardHeader::of_start(start).expect("it is there");
    assert_eq!(header, layout.header);
    assert_eq!(header.position_box(), layout.view(&whole).position_box());
    let other = [&b"OTHER"[..], &start[5..]].concat();
    for start in [&start[..0], &start[..40], &start[..200], &other[..]] {
        assert_eq!(ShardHeader::of_start(start), None);
    }
}
