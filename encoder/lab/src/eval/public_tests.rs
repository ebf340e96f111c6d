//! Layouts of public data sets, on a wall that is red on the left and blue on the right.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use glam::{DAffine3, DVec3};
use serde_json::{Value, json};
use slag_common::gaussians::SH_C0;
use slag_common::shard::Profile;
use slag_common::{Gaussians, Intrinsics, poses, splat};
use slag_models::{InferenceError, ModelDir, SessionOptions, TextEncoder};

use super::lerf::{self, LerfLabels};
use super::scannet::{self, Scan, ScanReport, ScannetReport};
use slag_encoder::cells::CellLimits;
use slag_encoder::encode::{self, EncodeSettings, Engines, Masks};
use slag_encoder::lift::Aggregation;
use slag_encoder::progress::Silent;
use slag_encoder::raster::{CpuRasterizer, RasterView, Rasterizer, pinhole};
use slag_encoder::store::StoreReader;
use slag_test_support::assert_error;

/// Gaussians across and down, 0.1 m apart, 2 m in front of the camera.
const COLUMNS: usize = 24;
const ROWS: usize = 16;
const PHOTO_PX: [u32; 2] = [320, 240];

fn on_wall() -> impl Iterator<Item = (f64, f64)> {
    (0..COLUMNS * ROWS).map(|i| ((i % COLUMNS) as f64 * 0.1 - 1.15, (i / COLUMNS) as f64 * 0.1 - 0.75))
}

struct Wall {
    dir: tempfile::TempDir,
    gaussians: Gaussians,
    views: PathBuf,
}

impl Wall {
    fn new() -> Self {
        let dir = tempfile::tempdir().expect("a folder");
        let mut gaussians = Gaussians::balls(on_wall().map(|(x, y)| DVec3::new(x, y, 2.0)).collect(), 0.05);
        gaussians.scales.fill([0.05, 0.05, 0.002]);
        gaussians.opacities.fill(0.99);
        let rgb = |x: f64| if x < 0.0 { [0.85, 0.08, 0.06] } else { [0.06, 0.1, 0.85] };
        gaussians.sh_dc = on_wall().map(|(x, _)| rgb(x).map(|c: f32| (c - 0.5) / SH_C0)).collect();
        let scene = dir.path().join("scene.ply");
        splat::ply::write(&scene, &gaussians).expect("writes");
        let mut frames = Vec::new();
        for folder in ["images", "masks"] {
            fs_err::create_dir_all(dir.path().join(folder)).expect("makes");
        }
        for (number, x) in [(1, 0.0), (2, 0.1)] {
            let view = RasterView {
                camera_from_world: DAffine3::from_translation(DVec3::new(-x, 0.0, 0.0)),
                intrinsics: camera(),
            };
            let drawing = CpuRasterizer.draw(&gaussians, &view, [0.5; 3]).expect("draws");
            let bytes = drawing.rgb.iter().map(|c| (c.clamp(0.0, 1.0) * 255.0) as u8).collect();
            let photo = image::RgbImage::from_raw(PHOTO_PX[0], PHOTO_PX[1], bytes).expect("its size");
            let name = format!("frame_{number:05}.png");
            photo.save(dir.path().join("images").join(&name)).expect("writes");
            let middle = 160 - (x * 100.0) as u32;
            let mask = image::GrayImage::from_fn(PHOTO_PX[0], PHOTO_PX[1], |px, py| {
                let on_wall = (middle - 120..middle + 120).contains(&px) && (40..200).contains(&py);
                image::Luma([if !on_wall { 0 } else { 1 + u8::from(px >= middle) }])
            });
            mask.save(dir.path().join("masks").join(&name)).expect("writes");
            // Nerfstudio's axes: y up, z backwards.
            let matrix = json!([[1, 0, 0, x], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]);
            frames.push(json!({"file_path": format!("images/{name}"), "transform_matrix": matrix}));
        }
        let Intrinsics { focal_x_px, focal_y_px, centre_x_px, centre_y_px, .. } = camera();
        let views = dir.path().join("transforms.json");
        let poses = json!({"w": PHOTO_PX[0], "h": PHOTO_PX[1], "fl_x": focal_x_px, "fl_y": focal_y_px,
            "cx": centre_x_px, "cy": centre_y_px, "frames": frames});
        fs_err::write(&views, poses.to_string()).expect("writes");
        let mut settings = EncodeSettings::new(scene, views.clone(), dir.path().join("store"), true);
        settings.view.masks = Masks::Given { dir: dir.path().join("masks"), ignore_ids: Vec::new() };
        settings.view.min_mask_px = 10;
        settings.aggregation = Aggregation::default();
        settings.cells.limits = CellLimits::by_count(4096);
        settings.cells.shards.profiles = vec![Profile::Compact];
        settings.cells.objects = false;
        settings.run.threads = 1;
        settings.run.memory_bytes = 1 << 28;
        settings.run.strict = true;
        let (models, session) = (ModelDir::colours(), SessionOptions::new(PathBuf::new()));
        let engines = Engines::new(&models, &session, &CpuRasterizer);
        encode::encode(&settings, &engines, &Silent, &AtomicBool::new(false)).expect("encodes");
        Self { dir, gaussians, views }
    }

    fn reader(&self) -> StoreReader {
        StoreReader::open(&self.dir.path().join("store")).expect("published")
    }

    fn folder(&self, name: &str) -> PathBuf {
        let path = self.dir.path().join(name);
        fs_err::create_dir_all(&path).expect("makes");
        path
    }
}

fn camera() -> Intrinsics {
    pinhole(PHOTO_PX, 200.0)
}

/// The built-in colour encoder with other words for its colours.
struct Renamed(Box<dyn TextEncoder>, BTreeMap<&'static str, &'static str>);

impl TextEncoder for Renamed {
    fn dim(&self) -> usize {
        self.0.dim()
    }

    fn encode(&mut self, text: &str) -> Result<Vec<f32>, InferenceError> {
        self.0.encode(self.1.get(text).copied().unwrap_or(text))
    }
}

fn renamed(words: &[(&'static str, &'static str)]) -> Renamed {
    let session = SessionOptions::new(PathBuf::new());
    let encoder = ModelDir::colours().text_encoder(&session).expect("needs no runtime");
    Renamed(encoder, words.iter().copied().collect())
}

fn rectangle(category: &str, [x1, y1, x2, y2]: [u32; 4]) -> Value {
    json!({"category": category, "segmentation": [[x1, y1], [x2, y1], [x2, y2], [x1, y2]]})
}

fn label(dir: &Path, name: &str, size: [u32; 2], objects: &[Value]) {
    let label = json!({"info": {"name": format!("{name}.jpg"), "width": size[0], "height": size[1]},
        "objects": objects});
    fs_err::write(dir.join(format!("{name}.json")), label.to_string()).expect("writes");
}

/// The wall's left half is red: the label "red" there is matched, the label "blue" is not. A word unknown to the
/// encoder is not found, and a frame without a pose is named. One frame's labels are of a photo twice as large.
#[test]
fn lerf_labels_are_judged_on_their_frames() {
    let wall = Wall::new();
    let dir = wall.folder("label");
    let objects = [
        rectangle("red", [40, 40, 159, 199]),
        rectangle("blue", [40, 40, 159, 199]),
        rectangle("chair", [0, 0, 30, 30]),
    ];
    label(&dir, "frame_00001", PHOTO_PX, &objects);
    // One thing in two parts; the camera stands 10 px farther to the right.
    let parts = [rectangle("blue", [300, 80, 400, 399]), rectangle("blue", [400, 80, 539, 399])];
    label(&dir, "frame_00002", [640, 480], &parts);
    label(&dir, "frame_00009", PHOTO_PX, &objects);
    let views = poses::read(&wall.views, None).expect("poses").views;
    let labels = LerfLabels::read(&dir, &views).expect("labels");
    let judge = |labels: &LerfLabels, scene: &Gaussians| {
        lerf::judge(&wall.reader(), labels, scene, &mut renamed(&[]), &[0.28, 2.0])
    };
    let report = judge(&labels, &wall.gaussians).expect("judges");
    println!("{report}");
    let of = |frame: &str, word: &str| {
        let found = report.things.iter().find(|t| t.frame == frame && t.category == word).expect("judged");
        found.ious[0]
    };
    for (frame, word, expected) in [
        ("frame_00001", "red", 0.85..1.1),
        ("frame_00001", "blue", 0.0..0.1),
        ("frame_00002", "blue", 0.85..1.1),
        ("frame_00001", "chair", 0.0..1e-9),
    ] {
        assert!(expected.contains(&of(frame, word)), "{frame}, {word}: {}", of(frame, word));
    }
    assert_eq!(report.things.len(), 4);
    let mean = report.things.iter().map(|t| t.ious[0]).sum::<f64>() / 4.0;
    let [miou, _, above_half] = report.means(0);
    assert!((miou.expect("a mean") - mean).abs() < 1e-12, "the unknown word is in the mean");
    assert_eq!((above_half, report.means(1)), (Some(0.5), [Some(0.0); 3]));
    assert_eq!(report.frames_without_view, ["frame_00009"]);
    assert_eq!(report.unknown_words.keys().collect::<Vec<_>>(), ["chair"]);
    assert!(report.to_string().contains("left out without a pose: frame_00009"));

    // Without any known word there is an error, not an empty mean.
    let mut only = labels.clone();
    only.frames.iter_mut().for_each(|frame| frame.things.retain(|thing| thing.category == "chair"));
    assert!(judge(&only, &wall.gaussians).expect_err("no word").to_string().contains("none of 1 words"));
    // Another splat than the one that was encoded.
    let mut other = wall.gaussians.clone();
    other.means_in_world.pop();
    assert_error(judge(&labels, &other), &["the store has 384 Gaussians, the splat 383"]);
}

#[test]
fn wrong_lerf_labels_are_named() {
    let wall = Wall::new();
    let views = poses::read(&wall.views, None).expect("poses").views;
    let dir = wall.folder("wrong");
    let message = |dir: &Path| format!("{:#}", LerfLabels::read(dir, &views).expect_err("wrong"));
    assert!(message(&dir).contains("no frame_*.json"), "{}", message(&dir));
    label(&dir, "frame_00007", PHOTO_PX, &[]);
    assert!(message(&dir).contains("none of 1 labelled frames has a pose, the first is frame_00007"));
    label(&dir, "frame_00001", [320, 200], &[]);
    assert!(message(&dir).contains("320 x 200 pixels of a view of [320, 240]"));
    label(&dir, "frame_00001", [u32::MAX, u32::MAX], &[]);
    assert!(message(&dir).contains("4294967295"), "{}", message(&dir));
    label(&dir, "frame_00001", PHOTO_PX, &[json!({"category": "red", "bbox": [1, 2]})]);
    assert!(message(&dir).contains("frame_00001.json") && message(&dir).contains("expected info"));
}

/// Vertices just in front of the wall: left half `wall`, right half `floor`; five far away; two of no class.
fn vertices() -> Vec<([f64; 3], u16)> {
    let on_wall = on_wall().map(|(x, y)| ([x + 0.01, y, 1.98], if x < 0.0 { 1 } else { 2 }));
    let far = (0..5).map(|i| ([f64::from(i), 0.0, 9.0], 1));
    on_wall.chain(far).chain([([0.0, 0.0, 2.0], 0), ([0.0, 0.0, 2.0], 38)]).collect()
}

fn write_mesh(path: &Path, rows: &[([f64; 3], u16)]) {
    let mut text = format!("ply\nformat ascii 1.0\nelement vertex {}\n", rows.len());
    text += "property float x\nproperty float y\nproperty float z\nproperty ushort label\n";
    text += "element face 1\nproperty list uchar int vertex_indices\nend_header\n";
    for ([x, y, z], label) in rows {
        text += &format!("{x} {y} {z} {label}\n");
    }
    fs_err::write(path, text + "3 0 1 2\n").expect("writes");
}

/// By hand: all 192 + 192 vertices on the wall are correct; five of class `wall` are out of reach and count as
/// wrong.
#[test]
fn scans_are_judged_by_the_protocol() {
    let wall = Wall::new();
    let dir = wall.folder("scene0062_00");
    write_mesh(&dir.join("scene0062_00_vh_clean_2.labels.ply"), &vertices());
    let scan = Scan::read(&dir).expect("a scan");
    let wrong = wall.folder("scene0070_00");
    write_mesh(&wrong.join("scene0070_00_vh_clean_2.labels.ply"), &[([0.0; 3], 41)]);
    assert_error(Scan::read(&wrong), &["label 41, expected 0 to 40"]);
    let mut encoder = renamed(&[("wall", "red"), ("floor", "blue"), ("toilet", "green")]);
    let judge = |scan: &Scan, scene: &Gaussians, encoder: &mut Renamed| {
        scannet::judge(&wall.reader(), scan, scene, encoder, false)
    };
    let report = judge(&scan, &wall.gaussians, &mut encoder).expect("judges");
    assert_eq!((report.n_labelled, report.n_without_answer), (192 * 2 + 5, 5));
    for subset in &report.subsets {
        assert_eq!(subset.n_classes, 2);
        for figure in [subset.miou, subset.macc] {
            assert!((figure.expect("two classes") - (192.0 / 197.0 + 1.0) / 2.0).abs() < 1e-12, "{subset:?}");
        }
    }
    assert_eq!(report.unknown_words.len(), 16);
    let all = ScannetReport::new(vec![report]);
    assert_eq!(all.missing_scenes.len(), 9);
    assert!(all.to_string().contains("the means differ from the protocol's: scene0000_00"), "{all}");
    assert!(all.to_string().contains("5 of 389 labelled vertices have no answer"), "{all}");

    // Swapped words: no answer is correct.
    let mut swapped = renamed(&[("wall", "blue"), ("floor", "red")]);
    assert_eq!(judge(&scan, &wall.gaussians, &mut swapped).expect("judges").subsets[0].miou, Some(0.0));
    let none = judge(&scan, &wall.gaussians, &mut renamed(&[])).expect_err("no word");
    assert!(none.to_string().contains("none of the 19 words"), "{none}");

    // Transparent Gaussians do not answer: of the first row and the 16 behind it, one has a neighbour within reach.
    let mut faint = wall.gaussians.clone();
    faint.opacities[..40].fill(0.05);
    let judged = judge(&scan, &faint, &mut encoder).expect("judges");
    assert_eq!((judged.n_labelled, judged.n_without_answer), (192 * 2 + 5, 5 + 39));
}

/// Oracle: the rules restated. The wall's answers are known (left half `wall`, right half `floor`); segments and
/// labels are made at random; votes are counted segment by segment, IoU and accuracy by sets.
#[test]
fn filtered_answers_are_the_majority_of_each_segment() {
    let wall = Wall::new();
    let dir = wall.folder("scene0097_00");
    let mut random = slag_math::random::Random::new(5);
    let n = COLUMNS * ROWS;
    // 30 segments with large numbers, each mostly of one half; labels mostly right, some of neither class.
    let answers: Vec<usize> = (0..n).map(|i| usize::from(i % COLUMNS >= COLUMNS / 2)).collect();
    let segments: Vec<u32> = answers
        .iter()
        .map(|answer| {
            let half = if random.below(4) == 0 { 1 - answer } else { *answer };
            4_000_000_000 - 1000 * (half as u32 * 15 + random.below(15) as u32)
        })
        .collect();
    let rows: Vec<([f64; 3], u16)> = (0..n)
        .map(|i| {
            let label = match random.below(10) {
                0 => 0,
                1 => 4,
                2 => 2 - answers[i] as u16,
                _ => 1 + answers[i] as u16,
            };
            (wall.gaussians.means_in_world[i].to_array(), label)
        })
        .collect();
    write_mesh(&dir.join("scene0097_00_vh_clean_2.labels.ply"), &rows);
    let scan = Scan::read(&dir).expect("a scan");
    let mut encoder = renamed(&[("wall", "red"), ("floor", "blue")]);
    let mut judged = |segments| -> anyhow::Result<ScanReport> {
        scannet::judge(&wall.reader(), &scan, &wall.gaussians, &mut encoder, segments)
    };
    let message = format!("{:#}", judged(true).expect_err("no segments"));
    assert!(message.contains("segs.json"), "{message}");
    let path = dir.join("scene0097_00_vh_clean_2.0.010000.segs.json");
    fs_err::write(&path, json!({"segIndices": segments[1..]}).to_string()).expect("writes");
    assert!(judged(true).expect_err("short").to_string().contains("383 segments"));
    fs_err::write(&path, json!({"segIndices": segments}).to_string()).expect("writes");
    assert!(judged(false).expect("judges").filtered.is_none());
    let report = judged(true).expect("judges");

    let voted: Vec<usize> = (0..n)
        .map(|i| {
            let of_segment = (0..n).filter(|k| segments[*k] == segments[i]);
            let (walls, floors): (Vec<usize>, Vec<usize>) = of_segment.partition(|k| answers[*k] == 0);
            usize::from(floors.len() > walls.len())
        })
        .collect();
    let means = |answers: &[usize]| {
        let of_class = |(class, label): (usize, u16)| {
            // Vertices of other labels than the classes' are not judged.
            let judged = (0..n).filter(|i| [1, 2, 4].contains(&rows[*i].1));
            let (mut both, mut either, mut truth) = (0.0, 0.0, 0.0);
            for i in judged {
                let (is, said) = (rows[i].1 == label, answers[i] == class);
                both += f64::from(u8::from(is && said));
                either += f64::from(u8::from(is || said));
                truth += f64::from(u8::from(is));
            }
            [both / either, both / truth]
        };
        // `bed` is in the scene and never the answer.
        let figures = [(0, 1), (1, 2)].map(of_class);
        [0, 1].map(|at| (figures[0][at] + figures[1][at]) / 3.0)
    };
    let filtered = report.filtered.as_ref().expect("filtered");
    assert_ne!(voted, answers, "the filter changes answers");
    for (subsets, expected) in [(&report.subsets, means(&answers)), (filtered, means(&voted))] {
        for subset in subsets {
            assert_eq!(subset.n_classes, 3);
            let found = [subset.miou, subset.macc].map(|figure| figure.expect("three classes"));
            assert!((0..2).all(|at| (found[at] - expected[at]).abs() < 1e-12), "{found:?} {expected:?}");
        }
    }
    let text = ScannetReport::new(vec![report]).to_string();
    for row in ["scene0097_00 PF", "mean PF", "| SLAG PF (paper)      | 0.375      | 0.500 | 0.377"] {
        assert!(text.contains(row), "{row}\n{text}");
    }
}
