use glam::DVec3;
use proptest::prelude::*;

use super::*;
use crate::frames::Aabb;
use crate::hash::Hash32;
use crate::shard::sample;

fn manifest(n_cells: u32) -> Manifest {
    let cell = |cell_id: u32| {
        let min = DVec3::new(f64::from(cell_id) / 3.0, 0.1, -1e6);
        (Aabb { min, max: min + DVec3::ONE }, Hash32::of(b"x"), 9)
    };
    let cells: Vec<_> = (0..n_cells).map(cell).collect();
    Manifest { generation: 3, ..sample::manifest_of("yard \"7\"\n", &cells) }
}

/// Without a text model, the manifest has no member for it.
#[test]
fn text_models_are_optional_and_bounded() {
    let plain = manifest(1);
    assert!(!String::from_utf8(plain.to_bytes()).expect("JSON").contains("text_model"));
    let object = |byte| ObjectRecord { hash: Hash32([byte; 32]), len_bytes: 5 };
    let mut carrying = plain;
    for n_files in [0, 16, 17] {
        let files = (0..n_files).map(object).collect();
        carrying.encoder.text_model = Some(TextModelRecord { description: object(99), files });
        match Manifest::parse(&carrying.to_bytes()) {
            Ok(read) => assert!(read == carrying && n_files <= 16),
            Err(error) => assert!(n_files == 17 && error.to_string().contains("17 files"), "{error}"),
        }
    }
}

#[test]
fn round_trip_and_refusals() {
    assert_eq!(Manifest::parse(&manifest(4).to_bytes()).expect("valid"), manifest(4));
    let unordered = Manifest { cells: manifest(4).cells.into_iter().rev().collect(), ..manifest(0) };
    assert!(matches!(Manifest::parse(&unordered.to_bytes()), Err(ManifestError::Content { .. })));
}

/// A truncated file is damaged, wherever it was cut; another version is reported only if the version can be read.
#[test]
fn damaged_manifests_and_those_of_other_versions_are_told_apart() {
    let refused = |bytes: &[u8]| Manifest::parse(bytes).expect_err("refused");
    let bytes = manifest(2).to_bytes();
    let without_cells = String::from_utf8(bytes.clone()).expect("JSON").replace("\"cells\"", "\"cella\"");
    let cut = (0..bytes.len()).step_by(7).map(|len| &bytes[..len]);
    for damaged in cut.chain([&b"{}"[..], b"\xff\x00", &[&bytes[..], b"}"].concat()]) {
        let error = refused(damaged);
        assert!(matches!(error, ManifestError::Damaged { .. }), "{error}");
        assert!(!error.to_string().contains("matching versions"), "{error}");
    }
    for other in [
        Manifest { version: VERSION + 1, ..manifest(1) }.to_bytes(),
        b"{\"version\":3,\"of_later\":[]}".to_vec(),
        without_cells.replace("\"version\":2", "\"version\":1").into_bytes(),
    ] {
        let error = refused(&other);
        assert!(matches!(error, ManifestError::Version { found: 1 | 3 }), "{error}");
        assert!(error.to_string().contains("matching versions"), "{error}");
    }
}

/// An unknown field in the manifest, its encoder or a cell.
#[test]
fn unknown_fields_are_refused() {
    let json = String::from_utf8(manifest(1).to_bytes()).expect("JSON");
    for place in ["{\"version\"", "{\"name\"", "{\"cell_id\""] {
        assert!(json.contains(place), "{place}");
        let changed = json.replace(place, &format!("{{\"later\":1,{}", &place[1..]));
        let error = Manifest::parse(changed.as_bytes()).expect_err(place);
        assert!(matches!(error, ManifestError::Content { .. }), "{place}: {error}");
        assert!(error.to_string().contains("later"), "{place}: {error}");
    }
}

/// 64 MiB are parsed and refused as malformed; one byte more is refused for its length.
#[test]
fn manifests_above_64_mib_are_refused() {
    let parse = |len_bytes: usize| {
        let error = Manifest::parse(&vec![b'x'; len_bytes]).expect_err("no manifest");
        matches!(error, ManifestError::TooLong { len_bytes: found } if found == len_bytes as u64)
    };
    assert_eq!((parse(64 << 20), parse((64 << 20) + 1)), (false, true));
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
