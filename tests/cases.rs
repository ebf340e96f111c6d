//! User inputs that often cause trouble, in `check` and `encode`.
//!
//! `../shared/cases` makes them by small changes of the labelled house. A row states a command's exit code and
//! words of its output. The ordinary run does the rows marked `fast`; `.ci/nightly` does all.

use super::*;

use slag_common::manifest::Manifest;
use slag_tests::*;

/// Scripts of `../shared/cases`, in order of dependence.
const SCRIPTS: [&str; 6] =
    ["make_clean", "make_cases", "make_masks", "make_ply", "make_more", "make_floaters"];

#[derive(Clone, Copy, PartialEq)]
enum Speed {
    Fast,
    Slow,
}
use Speed::{Fast, Slow};

/// Poses from a folder of `cases`, with the clean splat: speed, poses, further flags, exit code, words.
const POSES: &[(Speed, &str, &str, i32, &str)] = &[
    (Slow, "a1_spaces/sparse/0", "", 0, "match the photos"),
    (Fast, "a2_three_words_no_features/sparse/0", "", 0, "match the photos"),
    (Slow, "a3_one_word_no_features/sparse/0", "", 0, "match the photos"),
    (Fast, "a4_bom_crlf/sparse/0", "", 0, "match the photos"),
    (Slow, "a5_crlf/sparse/0", "", 0, "match the photos"),
    (Slow, "a6_unicode_subfolders/sparse/0", "", 0, "match the photos"),
    (Fast, "a7_two_models", "", 0, "match the photos"),
    (Fast, "a7_two_models/sparse/0", "", 0, "COLMAP made several models"),
    (Slow, "a8_ext_case", "", 0, "10 photos have other names"),
    (Fast, "a9_ext_png", "", 0, "10 photos have other names"),
    (Fast, "a10_full_opencv", "", 1, "FULL_OPENCV is not supported"),
    (Slow, "a11_simple_radial_fisheye", "", 1, "SIMPLE_RADIAL_FISHEYE is not supported"),
    (Slow, "a12_principal_zero", "", 4, "the principal point is at 0"),
    (Fast, "a13_realityscan_6params", "", 1, "OPENCV has 8 parameters, found 6"),
    (Slow, "a14_two_cameras", "", 0, "match the photos"),
    (Fast, "a15_odd_downscale", "", 1, "no uniform scale"),
    (Fast, "a16_missing_3", "", 3, "3 of 10 photos are missing"),
    (Fast, "a16_missing_3", "--strict", 1, "3 of 10 photos are missing"),
    (Slow, "a17_sparse_direct/sparse", "", 0, "match the photos"),
    (Slow, "b1_exif6_same_pixels", "", 0, "match the photos"),
    (Slow, "b2_exif6_rotated_storage", "", 0, "match the photos"),
    (Slow, "b3_exif3_upside_down", "", 4, "upside down"),
    (Slow, "b4_rgba_png_named_jpg", "", 0, "match the photos"),
    (Slow, "b6_cmyk", "", 0, "match the photos"),
    (Slow, "b7_progressive", "", 0, "match the photos"),
    (Slow, "b8_png16_named_jpg", "", 0, "match the photos"),
    (Fast, "b9_truncated_one", "", 3, "ends before its image does"),
    (Slow, "b9_truncated_one", "--strict", 1, "ends before its image does"),
    (Slow, "b10_no_eoi_one", "", 3, "ends before its image does"),
    (Slow, "b11_tiff", "", 1, "none of the 8 sampled photos can be read"),
    (Slow, "b5_gray", "", 0, "match the photos"),
    (Slow, "b12_empty_one", "", 3, "1 photos are left out"),
    (Fast, "b13_heic_named_jpg", "", 1, "a HEIC or AVIF image"),
    (Slow, "c1_backslash", "", 0, "match the photos"),
    (Fast, "c2_windows_absolute", "", 0, "10 photos are not where the file says"),
    (Slow, "c2_windows_absolute", "--images cases/c2_windows_absolute/images", 0, "10 photos are not where"),
    (Slow, "c3_linux_absolute", "--images cases/c3_linux_absolute/images", 0, "10 photos are not where"),
    (Slow, "c4_per_frame", "", 0, "match the photos"),
    (Slow, "c5_no_w_h_fly", "", 0, "match the photos"),
    (Slow, "c6_ngp_no_ext", "", 0, "match the photos"),
    (Slow, "c7_nan_sharpness", "", 0, "match the photos"),
    (Fast, "c8_nan_pose", "", 3, "1 of 10 frames have no pose"),
    (Slow, "c9_bom", "", 0, "match the photos"),
    (Slow, "c10_parent_paths", "", 0, "match the photos"),
    (Slow, "c11_equirectangular", "", 1, "EQUIRECTANGULAR is not supported"),
    (Slow, "c12_scaled_matrix", "", 1, "without scale or shear"),
    (Fast, "c13_left_handed", "", 1, "left-handed axes"),
    (Slow, "c14_string_number", "", 1, "invalid type: string"),
    (Slow, "c15_applied_3x4", "", 0, "match the photos"),
    (Slow, "d1_bin_model_11", "", 1, "number 11 is not supported"),
    (Slow, "d3_stale_bin", "", 4, "images.txt"),
    (Slow, "d3_stale_bin/sparse/0/images.txt", "", 0, "images.bin"),
    (Slow, "d3b_rigs", "", 0, "match the photos"),
    (Slow, "d11_ns_layout/colmap", "--images cases/d11_ns_layout/images", 0, "match the photos"),
    (Fast, "d12_duplicate", "", 1, "two images have the name"),
    (Fast, "d13_zero_quat", "", 3, "1 of 10 frames have no pose"),
    (Slow, "d15_huge", "", 0, "match the photos"),
];

/// Splats from `ply`, with the clean poses.
const SPLATS: &[(Speed, &str, i32, &str)] = &[
    // Without six of ten Gaussians, or without the third axis, they do not match the photos either.
    (Slow, "p1_zero_rows_60", 4, "Gaussians cannot be drawn"),
    (Fast, "p1b_zero_rows_all_but_one", 4, "Gaussians cannot be drawn"),
    (Slow, "p2_linear_scales", 4, "--activated scales"),
    (Slow, "p3_sigmoid_opacity", 4, "--activated opacities"),
    (Slow, "p4_both_activated", 4, "--activated scales,opacities"),
    (Slow, "p5_2dgs", 4, "flat, as those of 2DGS"),
    (Slow, "p6_nonfinite", 0, "match the photos"),
    (Slow, "p7_big_endian", 0, "match the photos"),
    (Slow, "p8_double", 0, "match the photos"),
    (Slow, "p9_crlf", 0, "match the photos"),
    (Slow, "p10_face", 0, "match the photos"),
    (Slow, "p11_shuffled_extra", 0, "match the photos"),
    (Slow, "p12_rgb", 0, "match the photos"),
    (Slow, "p13_rgb_float", 0, "match the photos"),
    (Fast, "p14_point_cloud", 1, "perhaps a point cloud"),
    (Slow, "p15_utm", 4, "UTM"),
    (Fast, "p16_truncated", 1, "up to the end of the file"),
    (Slow, "p18_far_floaters", 0, "match the photos"),
    (Fast, "p19_lfs", 1, "git lfs pull"),
    (Slow, "p20_xyzw", 4, "rotations are x, y, z, w"),
    (Slow, "q1_rot180x", 4, "y and z negated"),
    (Slow, "q2_mirrored_x", 4, "mirror images"),
    (Fast, "q3_empty", 4, "no Gaussians that can be drawn"),
    // A fifth of the Gaussians does not match the photos, but its harmonics are read.
    (Slow, "q4_sh4", 4, "the inputs do not fit together"),
    (Fast, "q5_rest_odd", 1, "properties f_rest_*"),
    (Slow, "q6_ascii_msvc_nan", 4, "1 of 2000 Gaussians cannot be drawn"),
    (Slow, "q7_ascii_comma", 1, "a number"),
    (Slow, "q9_transparent", 4, "transparent"),
];

/// Masks from `masks`, in an encode of the clean scene.
const MASKS: &[(Speed, &str, &str, i32, &str)] = &[
    (Slow, "m1_amg_folders", "", 0, ""),
    (Slow, "m2_rle_string", "", 0, ""),
    (Slow, "m3_rle_list", "", 0, ""),
    (Slow, "m4_coco_other_names.json", "", 0, ""),
    (Slow, "m5_coco_with_folder.json", "", 0, ""),
    (Slow, "m6_16bit", "", 0, ""),
    (Slow, "m7_rgb", "", 1, "expected ids"),
    (Slow, "m8_palette", "", 0, ""),
    (Slow, "m9_half", "", 1, "make the masks from the same photos"),
    (Slow, "m10_all_background", "", 1, "no Gaussian has an embedding"),
    (Slow, "m10_all_background", "--allow-empty", 0, ""),
    (Slow, "m11_keep_masks", "", 0, "objects need a mask for each thing"),
    (Fast, "m12_langsplat", "", 1, "LangSplat's maps"),
    (Slow, "m13_some", "", 0, "6 of 10 views have no masks"),
    (Fast, "m13_some", "--strict", 1, "6 of 10 photos have no masks"),
    (Slow, "m14_bytes_repr", "", 3, ""),
];

/// Splats from `ply`, in an encode with the clean poses and masks.
const ENCODED: &[(Speed, &str, i32, &str)] = &[
    (Slow, "p1_zero_rows_60", 3, "unusable"),
    (Fast, "p1b_zero_rows_all_but_one", 1, "hardly any of 104878 Gaussians can be seen"),
    (Slow, "q3_empty", 1, "hardly any of 0 Gaussians can be seen"),
    (Slow, "q9_transparent", 1, "hardly any of 104878 Gaussians can be seen"),
];

fn made(dir: &Path) {
    let python = python_with("tests/cases");
    for script in SCRIPTS {
        let script = shared("cases").join(script).with_extension("py");
        run(Command::new(&python).arg(script).env("CASES", dir).env("PYTHONDONTWRITEBYTECODE", "1"));
    }
}

/// Runs a command; returns what is wrong with its outcome.
fn judged(name: &str, command: &mut Command, exit: i32, words: &str) -> Option<String> {
    let output = command.output().expect("the program starts");
    let said =
        [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
    let is_right = output.status.code() == Some(exit) && said.contains(words);
    (!is_right).then(|| format!("{name}: {}, expected {exit} and {words:?}:\n{said}", output.status))
}

/// Runs the rows that `chosen` accepts; fails with all wrong outcomes.
pub fn run_cases(chosen: impl Fn(bool) -> bool) {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let dir = dir.path();
    made(dir);
    let (views, scene) = (dir.join("clean/sparse/0"), dir.join("clean/point_cloud.ply"));
    let is_chosen = |speed: Speed| chosen(speed == Fast);
    let check = |scene: &Path, views: &Path, flags: &str| {
        let mut command =
            encoder(&["check", "--scene", text(scene), "--views", text(views), "--device", "cpu"]);
        command.args(flags.split_whitespace()).current_dir(dir);
        command
    };
    let mut wrong = Vec::new();
    for (_, poses, flags, exit, words) in POSES.iter().filter(|row| is_chosen(row.0)) {
        let mut command = check(&scene, &dir.join("cases").join(poses), flags);
        wrong.extend(judged(&format!("{poses} {flags}"), &mut command, *exit, words));
    }
    for (_, splat, exit, words) in SPLATS.iter().filter(|row| is_chosen(row.0)) {
        let splat_path = dir.join("ply").join(splat).with_extension("ply");
        wrong.extend(judged(splat, &mut check(&splat_path, &views, ""), *exit, words));
    }
    for (at, (_, masks, flags, exit, words)) in MASKS.iter().enumerate().filter(|(_, row)| is_chosen(row.0)) {
        let (masks_path, store) = (dir.join("masks").join(masks), dir.join(format!("store{at}")));
        let mut command = encode(&scene, &views, &masks_path, &store);
        let command = command.args(flags.split_whitespace());
        wrong.extend(judged(&format!("{masks} {flags}"), command, *exit, words));
    }
    for (_, splat, exit, words) in ENCODED.iter().filter(|row| is_chosen(row.0)) {
        let (splat_path, store) = (dir.join("ply").join(splat).with_extension("ply"), dir.join("encoded"));
        let mut command = encode(&splat_path, &views, &dir.join("clean/masks"), &store);
        wrong.extend(judged(splat, &mut command, *exit, words));
    }
    assert!(wrong.is_empty(), "{} outcomes are wrong:\n{}", wrong.len(), wrong.join("\n"));
}

fn encode(scene: &Path, views: &Path, masks: &Path, store: &Path) -> Command {
    let mut command =
        encoder(&["encode", "--scene", text(scene), "--views", text(views), "--masks", text(masks)]);
    command.args(["--models", "colours", "--device", "cpu", "--store", text(store)]);
    command.args(["--profiles", "compact", "--input-indices"]);
    command
}

/// Largest distance of a stored position from its Gaussian near the house, and largest stated error.
fn position_errors(store: &Path, splat: &Path) -> (f64, f64) {
    let scene = splat::read(splat, &ReadOptions::default()).expect("reads");
    let reader = StoreReader::open(store).expect("a published store");
    let manifest: &Manifest = reader.manifest();
    let (mut largest, mut stated) = (0.0f64, 0.0f64);
    for record in manifest.cells.iter().map(|cell| &cell.shards[&Profile::Compact]) {
        let bytes = AlignedBytes::copy_of(&reader.read_object(record.hash).expect("there"));
        let layout = ShardLayout::check(&bytes).expect("valid");
        let shard = layout.view(&bytes);
        for place in 0..shard.header.n_gaussians as usize {
            let mean = scene.means_in_world[shard.input_index(place).expect("asked for") as usize];
            if mean.length() < 30.0 {
                let off = (shard.position_in_world(place) - mean).abs().max_element();
                assert!(off <= record.position_error, "{off} {}", record.position_error);
                (largest, stated) = (largest.max(off), stated.max(record.position_error));
            }
        }
    }
    (largest, stated)
}

/// Strays far away do not reduce the precision of other Gaussians, in any unit.
fn strays_cost_no_precision(files: &[&str]) {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let dir = dir.path();
    made(dir);
    for file in files {
        for flags in [&[][..], &["--position-error", "0.01"], &["--metric"]] {
            let (splat, store): (PathBuf, PathBuf) = (dir.join("ply").join(file), dir.join("store"));
            let mut command = encode(&splat, &dir.join("clean/sparse/0"), &dir.join("clean/masks"), &store);
            run(command.args(flags));
            let (largest, stated) = position_errors(&store, &splat);
            assert!(largest > 0.0 && stated <= 0.01, "{file} {flags:?}: {largest} {stated}");
            fs_err::remove_dir_all(&store).expect("removed");
        }
    }
}

#[needs_shared]
fn the_fast_cases_end_as_expected() {
    run_cases(|is_fast| is_fast);
}

#[needs_shared]
#[nightly("all inputs, several minutes")]
fn all_cases_end_as_expected() {
    run_cases(|_| true);
}

#[needs_shared]
fn a_stray_costs_no_precision() {
    strays_cost_no_precision(&["f_1_100000.ply"]);
}

#[needs_shared]
#[nightly("fifteen encodes")]
fn strays_at_any_distance_cost_no_precision() {
    strays_cost_no_precision(&[
        "p18_far_floaters.ply",
        "f_20_10000.ply",
        "f_1_1000.ply",
        "f_1_10000.ply",
        "f_1_1000000.ply",
    ]);
}
