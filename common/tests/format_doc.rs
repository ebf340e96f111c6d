//! The tables of docs/formats.md agree with the constants and layouts of the code.

use super::*;
use std::mem::offset_of;

use slag_common::manifest;
use slag_common::objects::{self, ObjectRecord, ObjectsHeader};
use slag_common::occupancy::{self, OccupancyHeader};
use slag_common::shard;

/// Cells of all table rows of the document.
fn rows() -> Vec<Vec<String>> {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/formats.md");
    let text = fs_err::read_to_string(path).expect("docs/formats.md exists");
    text.lines()
        .filter(|line| line.starts_with('|'))
        .map(|line| line.trim_matches('|').split('|').map(|cell| cell.trim().to_owned()).collect())
        .collect()
}

fn has(expected: &[&str]) -> bool {
    rows().iter().any(|row| row.iter().zip(expected).all(|(a, b)| a == b) && row.len() >= expected.len())
}

#[test]
fn header_offsets_match_the_struct() {
    macro_rules! field {
        ($name:ident, $size:expr, $kind:expr) => {
            let offset = offset_of!(ShardHeader, $name).to_string();
            assert!(has(&[&offset, &$size.to_string(), $kind, stringify!($name)]), "{}", stringify!($name));
        };
    }
    field!(cell_id, 4, "u32");
    field!(n_gaussians, 4, "u32");
    field!(n_centroids, 4, "u32");
    field!(dim, 4, "u32");
    field!(n_components, 4, "u32");
    field!(n_subspaces, 4, "u32");
    field!(position_bits, 4, "u8 x 4");
    field!(centroid_step, 4, "f32");
    field!(origin_in_world, 24, "f64 x 3");
    field!(position_step, 24, "f64 x 3");
    field!(box_min, 24, "f64 x 3");
    field!(box_max, 24, "f64 x 3");
    field!(errors, 16, "f32 x 4");
    field!(encoder_id, 32, "bytes");
    assert_eq!(size_of::<ShardHeader>(), 176, "a field is missing in docs/formats.md");
}

#[test]
fn objects_match_the_structs() {
    macro_rules! field {
        ($of:ident, $name:ident, $size:expr, $kind:expr) => {
            let offset = offset_of!($of, $name).to_string();
            assert!(has(&[&offset, &$size.to_string(), $kind, stringify!($name)]), "{}", stringify!($name));
        };
    }
    field!(ObjectsHeader, n_objects, 4, "u32");
    field!(ObjectsHeader, n_vectors, 4, "u32");
    field!(ObjectsHeader, n_runs, 4, "u32");
    field!(ObjectsHeader, photos_bytes, 4, "u32");
    field!(ObjectsHeader, score_mean, 4, "f32");
    field!(ObjectsHeader, score_spread, 4, "f32");
    field!(ObjectsHeader, score_error_bound, 4, "f32");
    field!(ObjectRecord, id, 8, "u64");
    field!(ObjectRecord, position_in_world, 24, "f64 x 3");
    field!(ObjectRecord, box_min, 24, "f64 x 3");
    field!(ObjectRecord, box_max, 24, "f64 x 3");
    field!(ObjectRecord, n_gaussians, 4, "u32");
    field!(ObjectRecord, n_gaussians_here, 4, "u32");
    field!(ObjectRecord, photo_box_px, 16, "u32 x 4");
    field!(ObjectRecord, photo_start, 4, "u32");
    field!(ObjectRecord, photo_bytes, 4, "u32");
    field!(OccupancyHeader, voxel, 8, "f64");
    field!(OccupancyHeader, first_block, 12, "i32 x 3");
    field!(OccupancyHeader, n_blocks, 12, "u32 x 3");
    field!(OccupancyHeader, n_runs, 4, "u32");
    field!(OccupancyHeader, n_mixed, 4, "u32");
    field!(OccupancyHeader, min_opacity, 4, "f32");
    field!(OccupancyHeader, min_views, 4, "u32");
    assert_eq!(size_of::<OccupancyHeader>(), 48, "a field is missing");
    assert_eq!([size_of::<ObjectsHeader>(), size_of::<ObjectRecord>()], [28, 112], "a field is missing");
}

#[test]
fn sections_and_versions_match_the_code() {
    let sections = [
        (section::HEADER, "header"),
        (section::POSITIONS, "positions"),
        (section::CENTROID_STARTS, "centroid_starts"),
        (section::CENTROIDS, "centroids"),
        (section::RADII, "radii"),
        (section::INPUT_INDICES, "input_indices"),
        (section::EMBEDDINGS, "embeddings"),
        (section::MEAN, "mean"),
        (section::BASIS, "basis"),
        (section::BASIS_STEPS, "basis_steps"),
        (section::SUBSPACE_STARTS, "subspace_starts"),
        (section::CODEWORDS, "codewords"),
        (section::RESIDUAL_SCALES, "residual_scales"),
        (section::RESIDUAL_NORMS, "residual_norms"),
        (section::CODES, "codes"),
        (section::FINE_ERRORS, "fine_errors"),
        (section::FINE_STEPS, "fine_steps"),
        (section::FINE_SCALES, "fine_scales"),
        (section::FINE, "fine"),
        (section::PACKED_INDICES_HEADER, "packed_indices_header"),
        (section::PACKED_INDICES, "packed_indices"),
        (section::COLOURS, "colours"),
        (section::SIZES, "sizes"),
        (section::ROTATIONS, "rotations"),
        (objects::section::HEADER, "objects_header"),
        (objects::section::RECORDS, "objects"),
        (objects::section::VECTORS, "object_vectors"),
        (objects::section::STEPS, "object_steps"),
        (objects::section::RUN_ENDS, "run_ends"),
        (objects::section::RUN_OBJECTS, "run_objects"),
        (objects::section::PHOTOS, "photos"),
        (occupancy::section::HEADER, "occupancy_header"),
        (occupancy::section::RUNS, "block_runs"),
        (occupancy::section::MASKS, "block_masks"),
    ];
    for (id, name) in sections {
        assert!(has(&[&id.to_string(), name]), "section {id} {name}");
    }
    let magic = String::from_utf8(shard::MAGIC.to_vec()).expect("ASCII");
    assert!(has(&["shard", &format!("`{magic}`"), &shard::VERSION.to_string()]));
    assert!(has(&["manifest", "none: JSON", &manifest::VERSION.to_string()]));
    assert!(has(&["12", "4", "u32", "n_sections", &format!("0..={}", container::MAX_SECTIONS)]));
    assert!(has(&[&container::PREAMBLE_BYTES.to_string(), &format!("{} n", container::SECTION_ROW_BYTES)]));
}
