//! Damages the encoder's own files and the geo-reference in 1,000 ways each: they are refused with the reason,
//! without a panic.

use std::path::Path;

use slag_common::container::AlignedBytes;
use slag_encoder::ingest::read_geo_reference;
use slag_encoder::lift::{
    CellField, Contribution, ContributionError, ContributionIndex, PartContributions, RegionTable,
    ViewContributions,
};
use slag_math::random::Random;
use slag_test_support::damaged;

const N_MUTATIONS: u64 = 1000;

fn contributions() -> ViewContributions {
    let entry = |local, region| Contribution { local, region, weight: 2.5 };
    ViewContributions {
        dim: 4,
        mask_vectors: vec![0.5; 8],
        masks_of_region: vec![vec![0], vec![0, 1]],
        entries_of_cell: vec![(0, vec![entry(0, 0), entry(1, 1)]), (3, vec![entry(0, 1)])],
    }
}

/// Opens, reads and transposes a contribution file, as an encode does.
fn read_contributions(path: &Path) -> Result<(RegionTable, Vec<PartContributions>), ContributionError> {
    let (index, table) = ContributionIndex::open(&[path.to_owned()], 4, &[2, 2, 2, 2])?;
    let raw = index.read(0..index.parts().len())?;
    let contributions = index.transpose(&raw, &table)?;
    Ok((table, contributions))
}

/// Checksums cover the sections, but not the padding between them.
#[test]
fn contributions_regions_and_fields_refuse_damage() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let path = dir.path().join("view.contributions");
    contributions().write(&path).expect("writes");
    let file = fs_err::read(&path).expect("reads");
    let (table, parts) = read_contributions(&path).expect("valid");
    let field = CellField::new(vec![8, 9], parts[0].clone(), &table, &mut [0.0; 8]);
    let (mut table_file, mut field_file) = (Vec::new(), Vec::new());
    table.write(&mut table_file).expect("writes to memory");
    field.write(&mut field_file).expect("writes to memory");
    let mut n_refused = 0;
    for seed in 0..N_MUTATIONS {
        fs_err::remove_file(&path).expect("removes");
        fs_err::write(&path, damaged(&file, &mut Random::new(seed))).expect("writes");
        match read_contributions(&path) {
            Ok(read) => assert_eq!(read, (table.clone(), parts.clone()), "seed {seed}"),
            Err(error) => {
                assert!(error.to_string().contains("view.contributions"), "{error}");
                n_refused += 1;
            }
        }
        match RegionTable::from_bytes(&AlignedBytes::copy_of(&damaged(&table_file, &mut Random::new(seed)))) {
            Ok(read) => assert_eq!(read, table, "seed {seed}"),
            Err(error) => assert!(!error.to_string().is_empty()),
        }
        match CellField::from_bytes(
            &AlignedBytes::copy_of(&damaged(&field_file, &mut Random::new(seed))),
            table.len(),
        ) {
            Ok(read) => assert_eq!(read, field, "seed {seed}"),
            Err(error) => assert!(!error.to_string().is_empty()),
        }
    }
    // The padding between the sections of so small a file is about half of it.
    assert!(n_refused > N_MUTATIONS / 2, "{n_refused}");
}

#[test]
fn geo_references_are_read_or_refused() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let path = dir.path().join("geo.json");
    let text = br#"{"origin": {"lat": 46.842657, "lon": -91.994008, "alt": 158.509}, "crs_note": "ENU"}"#;
    fs_err::write(&path, text).expect("writes");
    read_geo_reference(&path).expect("valid");
    for seed in 0..N_MUTATIONS {
        fs_err::remove_file(&path).expect("removes");
        fs_err::write(&path, damaged(text, &mut Random::new(seed))).expect("writes");
        match read_geo_reference(&path) {
            Ok(geo) => assert!(geo.origin.latitude_deg.abs() <= 90.0 && geo.origin.height_m.is_finite()),
            Err(error) => assert!(error.to_string().contains("geo.json"), "{error}"),
        }
    }
}
