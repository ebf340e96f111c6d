use std::collections::BTreeMap;

use glam::DVec3;
use proptest::prelude::*;

use super::*;
use crate::frames::Aabb;
use crate::hash::Hash32;
use crate::shard::{Profile, ScoreErrors};

fn manifest(n_cells: u32) -> Manifest {
    Manifest {
        version: VERSION,
        scene: "yard \"7\"\n".into(),
        generation: 3,
        created_unix_secs: 1_700_000_000,
        expires_unix_secs: Some(1_800_000_000),
        next_key: Some(Hash32([5; 32])),
        metric: true,
        geo_reference: None,
        encoder: EncoderRecord {
            name: "e".into(),
            id: Hash32([7; 32]),
            dim: 512,
            default_threshold: 0.1,
            calibration: None,
        },
        n_gaussians: 10,
        n_without_evidence: 1,
        n_rejected: 0,
        cells: (0..n_cells)
            .map(|cell_id| {
                let min = DVec3::new(f64::from(cell_id) / 3.0, 0.1, -1e6);
                let record = ShardRecord {
                    hash: Hash32::of(b"x"),
                    len_bytes: 9,
                    n_centroids: 2,
                    score_error_bound: 0.1,
                    score_errors: ScoreErrors::default(),
                    position_error: 1e-3,
                };
                let shards = BTreeMap::from([(Profile::Compact, record)]);
                CellRecord { cell_id, bounds: Aabb { min, max: min + DVec3::ONE }, n_gaussians: 5, shards }
            })
            .collect(),
    }
}

#[test]
fn signed_round_trip_and_refusals() {
    let (key, other) = (generate_key(), generate_key());
    let public = Hash32(key.verifying_key().to_bytes());
    let bytes = manifest(4).sign(&key);
    let (back, signer) = Manifest::verify(&bytes, &TrustedKeys::FirstContact).expect("valid");
    assert_eq!((back, signer), (manifest(4), public));
    assert!(Manifest::verify(&bytes, &TrustedKeys::Only(vec![public])).is_ok());
    let stranger = TrustedKeys::Only(vec![Hash32(other.verifying_key().to_bytes())]);
    assert!(matches!(Manifest::verify(&bytes, &stranger), Err(ManifestError::UnknownKey { .. })));
    assert!(
        manifest(1).check_expiry(1_800_000_001).is_err() && manifest(1).check_expiry(1_799_999_999).is_ok()
    );
    let unordered = Manifest { cells: manifest(4).cells.into_iter().rev().collect(), ..manifest(0) };
    assert!(matches!(
        Manifest::verify(&unordered.sign(&key), &TrustedKeys::FirstContact),
        Err(ManifestError::Content { .. })
    ));
    let own_successor = Manifest { next_key: Some(public), ..manifest(1) };
    assert!(matches!(
        Manifest::verify(&own_successor.sign(&key), &TrustedKeys::FirstContact),
        Err(ManifestError::Content { .. })
    ));
}

/// Under a valid signature: a field that this version does not know, in the manifest, its encoder and a cell.
#[test]
fn unknown_fields_are_refused() {
    use ed25519_dalek::Signer;
    let key = generate_key();
    let signed = manifest(1).sign(&key);
    let end = signed.iter().position(|byte| *byte == b'\n').expect("a first line") + 1;
    let json = std::str::from_utf8(&signed[end..]).expect("JSON");
    let verify = |json: &str| {
        let public = hex::encode(key.verifying_key().to_bytes());
        let signature = hex::encode(key.sign(json.as_bytes()).to_bytes());
        let text = format!("slag-manifest {VERSION} ed25519 {public} {signature}\n{json}");
        Manifest::verify(text.as_bytes(), &TrustedKeys::FirstContact)
    };
    assert_eq!(verify(json).expect("valid").0, manifest(1));
    for place in ["{\"version\"", "{\"name\"", "{\"cell_id\""] {
        assert!(json.contains(place), "{place}");
        let changed = json.replace(place, &format!("{{\"later\":1,{}", &place[1..]));
        let error = verify(&changed).expect_err(place);
        assert!(matches!(error, ManifestError::Content { .. }), "{place}: {error}");
        assert!(error.to_string().contains("later"), "{place}: {error}");
    }
}

/// 64 MiB are parsed, and refused as malformed; one byte more is refused for its length.
#[test]
fn manifests_above_64_mib_are_refused() {
    let verify = |len_bytes: usize| {
        let error =
            Manifest::verify(&vec![b'x'; len_bytes], &TrustedKeys::FirstContact).expect_err("no manifest");
        matches!(error, ManifestError::TooLong { len_bytes: found } if found == len_bytes as u64)
    };
    assert_eq!((verify(64 << 20), verify((64 << 20) + 1)), (false, true));
}

#[test]
fn every_flipped_bit_is_refused() {
    let key = generate_key();
    let trusted = TrustedKeys::Only(vec![Hash32(key.verifying_key().to_bytes())]);
    let bytes = manifest(1).sign(&key);
    for at in 0..bytes.len() {
        for bit in 0..8 {
            let mut flipped = bytes.clone();
            flipped[at] ^= 1 << bit;
            // The case of the signature's hex digits does not matter.
            let same = flipped.eq_ignore_ascii_case(&bytes) && at < 256;
            assert!(Manifest::verify(&flipped, &trusted).is_err() || same, "byte {at} bit {bit}");
        }
    }
}

proptest! {
    /// Oracle: brute force over the boxes.
    #[test]
    fn radius_search_equals_brute_force(
        boxes in prop::collection::vec((prop::array::uniform3(-50.0..50.0f64), prop::array::uniform3(0.0..20.0f64)), 0..60),
        centre in prop::array::uniform3(-60.0..60.0f64), radius in 0.0..50.0f64,
    ) {
        let template = manifest(1).cells.remove(0);
        let cells: Vec<CellRecord> = boxes.iter().map(|(min, size)| {
            let min = DVec3::from(*min);
            CellRecord { bounds: Aabb { min, max: min + DVec3::from(*size) }, ..template.clone() }
        }).collect();
        let expected: Vec<usize> = (0..cells.len()).filter(|i| {
            let nearest = DVec3::from(centre).clamp(cells[*i].bounds.min, cells[*i].bounds.max);
            nearest.distance_squared(centre.into()) <= radius * radius
        }).collect();
        prop_assert_eq!(CellIndex::new(&cells).within(centre.into(), radius), expected);
    }
}
