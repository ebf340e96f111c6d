//! Valid inputs to start from.

use std::ops::Range;
use std::path::Path;

use glam::{DAffine3, DVec3};
use half::f16;
use slag_common::appearance::Appearance;
use slag_common::frames::Aabb;
use slag_common::landmarks::{BuiltLandmarks, Landmark};
use slag_common::occupancy::{Block, BuiltOccupancy};
use slag_common::photo_poses::BuiltPhotoPoses;
use slag_common::shard::sample::{self, SampleObject, SampleObjects};
use slag_common::shard::{
    Additions, Basis, ExactColumns, Fine, IndexColumn, Positions, Profile, Residuals, ScoreErrors,
    ShardHeader, ShardView,
};
use slag_common::{Hash32, View, container, pinhole};
use slag_edge::store::EdgeCache;

/// Longest shared file used: mutations of longer ones rarely matter.
const MAX_SHARED_BYTES: usize = 100_000;

/// Columns and rows of the photo with masks.
pub const MASKED_PX: [u32; 2] = [4, 3];

pub const ENCODER: Hash32 = Hash32([9; 32]);

/// Requests of all kinds, one with a body that is not JSON.
const HTTP_REQUESTS: &[&str] = &[
    "GET /query?text=red%20chair&near=1,2,3&limit=2 HTTP/1.1\r\nHost: localhost:7734\r\nAccept: application/json\r\nX-Request-Id: a-1\r\n\r\n",
    "POST /v1/query HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\nContent-Length: 41\r\n\r\n{\"texts\":[\"red\",\"blue mug\"],\"threshold\":0}",
    "POST /position HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nTransfer-Encoding: chunked\r\n\r\n5\r\n{\"x\":\r\n2\r\n1}\r\n0\r\n\r\n",
    "OPTIONS /v1/query HTTP/1.1\r\nHost: localhost\r\nOrigin: https://map.example\r\nAccess-Control-Request-Method: POST\r\n\r\n",
    "GET /v1/objects?limit=3&prompt_id=0 HTTP/1.1\r\nHost: localhost\r\nSec-Fetch-Site: same-origin\r\nAuthorization: Bearer abcdefghijklmnop\r\n\r\nHEAD /status HTTP/1.0\r\n\r\n",
    "GET /metrics HTTP/1.1\r\nHost: [::1]:7734\r\nExpect: 100-continue\r\n\r\n",
];

const V1_BODIES: &[&str] = &[
    r#"{"texts":["a on the b","nearest a","c"],"near":[0,0,0],"heading_rad":1.5,"limit":5,"offset":1}"#,
    r#"{"vectors":[[1,0,0.5]],"kind":"gaussians","min_score":-1,"precision":"centroids","time_budget_ms":500}"#,
    r#"{"phrases":[{"thing":"a","relation":{"is":"near","of":{"thing":"b"}}}],"relations":false,"min_count":1}"#,
    r#"{"texts":["a"],"kind":"clusters","voxel":0.5,"negatives":["b","c"],"region":{"ball":{"centre":[1,2,3],"radius":9},"box":{"from":[0,0,0],"to":[9,9,9]},"polygon":[[0,0],[9,0],[9,9]]}}"#,
];

const PHRASES: &[&str] = &[
    "where is the second largest red mug on a table near the window?",
    "chair between the sofa and the lamp in front of me",
    "third pallet from the gate",
    r#"{"thing":"mug","pick":{"by":"nearest","n":2,"from":{"thing":"gate"}},"relation":{"is":"on","of":{"thing":"me"}}}"#,
];

/// Writes a robot's cache with a one-cell scene with objects, in the space of [`ENCODER`] with three components.
pub fn write_scene(folder: &Path) {
    let bytes = shard(true);
    let bytes_of_manifest = manifest(&bytes);
    let (hash, of_manifest) = (Hash32::of(&bytes), Hash32::of(&bytes_of_manifest));
    let current = format!(
        r#"{{"manifest_hash":"{of_manifest}","profile":"compact","centre_in_world":[0.0,0.0,0.0],"radius":50.0,"cells":[{{"cell_id":5,"hash":"{hash}","len_bytes":{}}}]}}"#,
        bytes.len()
    );
    let cache = EdgeCache::open(folder);
    for (path, bytes) in [
        (cache.shard_path(hash), &bytes),
        (cache.manifest_path(of_manifest), &bytes_of_manifest),
        (cache.current_path(), &current.into_bytes()),
    ] {
        fs_err::create_dir_all(path.parent().expect("a folder")).expect("a folder");
        fs_err::write(path, bytes).expect("a file");
    }
}

/// `shared`: folder of shared test data, if it exists.
pub fn of(target: &str, shared: Option<&Path>) -> Vec<Vec<u8>> {
    let text = |text: &str| vec![text.as_bytes().to_vec()];
    let mut seeds = match target {
        "container" | "shard" => vec![shard(false), shard(true)],
        "manifest" => vec![manifest(&shard(true))],
        "current" => text(&format!(
            r#"{{"manifest_hash":"{0}","profile":"compact","centre_in_world":[0.0,1.0,2.5],"radius":50.0,"cells":[{{"cell_id":1,"hash":"{0}","len_bytes":7}}]}}"#,
            "ab".repeat(32)
        )),
        "ply" => text(PLY),
        "splat" => vec![vec![0x40; 96]],
        "spz" => vec![spz()],
        "sog_folder" => sog_folders(),
        "colmap_text" => text(
            "# cameras\n1 PINHOLE 640 480 500.0 500.0 320.0 240.0\n2 SIMPLE_RADIAL 64 48 50 32 24 0.01\n====\n1 1 0 0 0 0.5 0.25 2 1 a.jpg\n10 10 -1\n2 0 1 0 0 1 2 3 2 b.jpg\n\n",
        ),
        "colmap_bin" => vec![colmap_bin()],
        "transforms" => text(
            r#"{"camera_model":"OPENCV","fl_x":500.0,"fl_y":500.0,"cx":320.0,"cy":240.0,"w":640,"h":480,"k1":0.01,"frames":[{"file_path":"images/a.jpg","transform_matrix":[[1,0,0,0],[0,1,0,0],[0,0,1,2],[0,0,0,1]]}]}"#,
        ),
        "scannet" => text(
            "50.5 0 32 0\n0 50.5 24 0\n0 0 1 0\n0 0 0 1\n====\n0 -1 0 1.5\n1 0 0 2.5\n0 0 1 -3\n0 0 0 1\n",
        ),
        "splat_frame" => text(r#"{"transform":[[0,1,0,0.5],[1,0,0,-2],[0,0,-1,3]],"scale":0.25}"#),
        "rle" => vec![b"\x04\x00\x03\x00453".to_vec(), b"\x0a\x00\x0a\x00\x64\x00\x00\x00".to_vec()],
        "coco" => text(
            r#"{"images":[{"id":1,"file_name":"a.jpg","width":4,"height":3}],"annotations":[{"id":1,"image_id":1,"segmentation":{"size":[3,4],"counts":"453"}},{"id":2,"image_id":1,"segmentation":{"size":[3,4],"counts":[4,5,3]}}]}"#,
        ),
        "id_image" => id_images(),
        "model_toml" => vec![
            include_bytes!("../../tests/models/clip_tiny/model.toml").to_vec(),
            include_bytes!("../../tests/models/conse/model.toml").to_vec(),
        ],
        "tensors" => vec![safetensors()],
        "phrases" => vec![[b"chair\na red sofa\n====\n".as_slice(), &safetensors()].concat()],
        "contributions" => vec![contributions()],
        "region_table" => vec![region_table()],
        "cell_field" => vec![cell_field()],
        "geo" => text(r#"{"origin":{"lat":46.8,"lon":-91.9,"alt":150.0}}"#),
        "query" => text(
            "text=a+red%20chair&limit=10&threshold=0.1&near=1,2,3&radius=4&kind=gaussians&voxel=0.2&min_count=3",
        ),
        "grammar" => PHRASES.iter().map(|phrase| phrase.as_bytes().to_vec()).collect(),
        "v1" => V1_BODIES.iter().map(|body| body.as_bytes().to_vec()).collect(),
        "tuf" => super::repository::seeds(),
        "http_request" => HTTP_REQUESTS.iter().map(|request| request.as_bytes().to_vec()).collect(),
        "position" => text("1 2 3\n46.8,-91.9,150\n{\"x\":1,\"y\":2,\"z\":3}\n{\"lat\":1,\"lon\":2}\n"),
        _ => Vec::new(),
    };
    for path in shared_files(target) {
        let read = shared.and_then(|shared| fs_err::read(shared.join(path)).ok());
        seeds.extend(read.filter(|bytes| bytes.len() <= MAX_SHARED_BYTES));
    }
    seeds
}

fn shared_files(target: &str) -> &'static [&'static str] {
    match target {
        "ply" => &[
            "fixtures/formats/gsplatrs_minimal_ascii.ply",
            "fixtures/formats/gsplatrs_minimal_binary.ply",
            "fixtures/formats/playbot_lod6.compressed.ply",
        ],
        "splat" => &["fixtures/formats/minimal.splat"],
        "spz" => &[
            "fixtures/formats/minimal-v2.spz",
            "fixtures/formats/minimal-v3.spz",
            "fixtures/formats/minimal-v4.spz",
            "fixtures/formats/gsplatrs_minimal_v4_degree0.spz",
        ],
        "sog" => &["fixtures/formats/playbot_lod6.sog"],
        _ => &[],
    }
}

const PLY: &str = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nproperty float f_dc_0\nproperty float f_dc_1\nproperty float f_dc_2\nproperty float opacity\nproperty float scale_0\nproperty float scale_1\nproperty float scale_2\nproperty float rot_0\nproperty float rot_1\nproperty float rot_2\nproperty float rot_3\nend_header\n1 2 3 0.1 0.2 0.3 1 -2 -2 -2 1 0 0 0\n";

fn shard(is_exact: bool) -> Vec<u8> {
    let bounds = Aabb { min: DVec3::new(0.0, -3.0, 2.0), max: DVec3::new(66.0, 130.0, 4.0) };
    let header = ShardHeader {
        n_components: 2,
        n_subspaces: if is_exact { 0 } else { 2 },
        centroid_step: 0.01,
        encoder_id: ENCODER.0,
        ..sample::header(5, 6, 2, 3, bounds)
    };
    let embeddings = [f16::from_f32(0.5); 15];
    let (mean, codewords) = ([f16::from_f32(0.1); 3], [f16::from_f32(0.25); 32]);
    let positions = [[0, 0, 0], [1, 2, 3], [65535, 65535, 65535], [4, 4, 4], [5, 5, 5], [6, 6, 6]];
    let indices = IndexColumn::pack(&[10, 11, 12, 13, 14, 1500]);
    let view = ShardView {
        header,
        positions: Positions::Wide(&positions),
        centroid_starts: &[0, 2, 5],
        centroids: &[60, -10, 20, 127],
        radii: &[0.1, 0.2],
        basis: Some(Basis { mean: &mean, vectors: &[127, 0, 5, -3, 127, 0], steps: &[0.01, 0.01] }),
        residuals: (!is_exact).then_some(Residuals {
            subspace_starts: &[0, 1, 2],
            codewords: &codewords,
            residual_scales: &[0.1, 0.2],
            residual_norms: &[0.3, 0.4],
            codes: &[0x5a; 32],
        }),
        exact: is_exact.then_some(ExactColumns {
            input_indices: &[10, 11, 12, 13, 14, 15],
            embeddings: &embeddings,
            fine: Some(Fine {
                errors: ScoreErrors::default(),
                steps: &[0.5, 0.25],
                scales: &[0.01, 0.02],
                values: &[1, -2, 127, -128, 5, 0, 3, 4, -5, 6],
            }),
        }),
        packed_indices: (!is_exact).then(|| indices.view()),
    };
    if is_exact {
        return with_additions(&view);
    }
    let mut out = Vec::new();
    view.write(&mut out).expect("writes to memory");
    out
}

/// A shard of six Gaussians with all additions.
fn with_additions(view: &ShardView<'_>) -> Vec<u8> {
    let object = |id: u64, runs: &[Range<u32>]| SampleObject {
        id,
        position_in_world: DVec3::new(1.0, 2.0, 3.0),
        bounds: Aabb { min: DVec3::new(0.5, 1.5, 2.5), max: DVec3::new(1.5, 2.5, 4.5) },
        vectors: vec![1.0, 0.0, 0.5, -0.5, 0.0, 1.0],
        runs: runs.to_vec(),
        n_gaussians: 40,
        photo: "a.jpg".into(),
        photo_box_px: [10, 20, 110, 70],
        thumbnail: b"\xff\xd8\xff\xe0".to_vec(),
    };
    let objects = vec![object(1, std::slice::from_ref(&(3..5))), object(7, &[0..2, 5..6])];
    let objects = SampleObjects { objects, score_mean: 0.02, score_spread: 0.1, score_error_bound: 0.02 };
    let block = |z, occupied, free| Block { at: [0, 0, z], occupied, free };
    let places = BuiltOccupancy::pack(0.05, 0.1, 2, &[block(0, 1, 2), block(1, 0, !0), block(5, !0, 0)]);
    let mut photos = BuiltPhotoPoses::default();
    for name in ["a.jpg", "b.jpg"] {
        photos.push(DVec3::ONE, &photo(name, [64, 48]));
    }
    let landmark = |x: f64| Landmark { position_in_world: DVec3::splat(x), code: 5, view: 1 };
    let landmarks = BuiltLandmarks::pack(1, &[landmark(0.0), landmark(2.0)]);
    let others = Additions {
        objects: None,
        appearance: Some(Appearance { colours: &[[1; 4]; 6], sizes: &[[2; 3]; 6], rotations: &[[3; 3]; 6] }),
        occupancy: Some(places.view()),
        photo_poses: photos.view(),
        landmarks: landmarks.view(),
    };
    objects.add_to(view, others)
}

pub fn photo(name: &str, size_px: [u32; 2]) -> View {
    let intrinsics = pinhole(size_px, 50.0);
    View { name: name.into(), image_path: name.into(), intrinsics, camera_from_world: DAffine3::IDENTITY }
}

fn manifest(shard: &[u8]) -> Vec<u8> {
    sample::manifest("yard", &[(Profile::Compact, shard)]).to_bytes()
}

/// An uncompressed SPZ 2 file with one Gaussian of zeros; the target compresses it.
fn spz() -> Vec<u8> {
    let mut bytes = b"NGSP".to_vec();
    bytes.extend([2, 0, 0, 0, 1, 0, 0, 0, 0, 12, 0, 0]);
    bytes.extend([0; 19]);
    bytes
}

/// Versions 1 and 2, with one image for all columns.
fn sog_folders() -> Vec<Vec<u8>> {
    // Small, so that any pixel is a label and any row a quaternion.
    let pixels =
        image::RgbaImage::from_fn(192, 2, |x, y| image::Rgba([x as u8 % 100, 0, y as u8, 252 + x as u8 % 4]));
    let mut webp = Vec::new();
    let encoder = image::codecs::webp::WebPEncoder::new_lossless(&mut webp);
    pixels.write_with_encoder(encoder).expect("writes to memory");
    let metas = [
        r#"{"means":{"shape":[384,3],"mins":[-2,-1,0],"maxs":[2,3,1],"files":["x.webp","x.webp"]},"scales":{"mins":[-9,-8,-7],"maxs":[-1,0,1],"files":["x.webp"]},"quats":{"files":["x.webp"]},"sh0":{"mins":[-1,-2,-3,-8],"maxs":[1,2,3,8],"files":["x.webp"]},"shN":{"mins":-0.5,"maxs":1.5,"files":["x.webp","x.webp"]}}"#,
        r#"{"version":2,"count":384,"antialias":false,"means":{"mins":[0,0,0],"maxs":[1,1,1],"files":["x.webp","x.webp"]},"scales":{"codebook":[0.5],"files":["x.webp"]},"quats":{"files":["x.webp"]},"sh0":{"codebook":[0.1],"files":["x.webp"]}}"#,
    ];
    metas.map(|meta| [meta.as_bytes(), b"\n====\n", &webp].concat()).into()
}

/// Ids of 8 and of 16 bits.
fn id_images() -> Vec<Vec<u8>> {
    let [width, height] = MASKED_PX;
    let narrow = image::GrayImage::from_fn(width, height, |x, y| image::Luma([(x / 2 + y) as u8]));
    let wide = image::ImageBuffer::from_fn(width, height, |x, y| image::Luma([(x / 2 + y) as u16 * 4_000]));
    [image::DynamicImage::from(narrow), wide.into()]
        .map(|ids| {
            let mut png = std::io::Cursor::new(Vec::new());
            ids.write_to(&mut png, image::ImageFormat::Png).expect("writes to memory");
            png.into_inner()
        })
        .into()
}

fn colmap_bin() -> Vec<u8> {
    let mut bytes = 1u64.to_le_bytes().to_vec();
    // Camera 1, PINHOLE, 640 x 480.
    bytes.extend([1u32.to_le_bytes(), 1u32.to_le_bytes()].concat());
    bytes.extend([640u64.to_le_bytes(), 480u64.to_le_bytes()].concat());
    [500.0f64, 500.0, 320.0, 240.0].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
    bytes.extend(b"\n====\n");
    bytes.extend(1u64.to_le_bytes());
    bytes.extend(1u32.to_le_bytes());
    [1.0f64, 0.0, 0.0, 0.0, 0.5, 0.25, 2.0].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
    bytes.extend(1u32.to_le_bytes());
    bytes.extend(b"a.jpg\0");
    bytes.extend(0u64.to_le_bytes());
    bytes
}

fn safetensors() -> Vec<u8> {
    let head = br#"{"vectors":{"dtype":"F32","shape":[2,3],"data_offsets":[0,24]}}"#;
    let mut bytes = (head.len() as u64).to_le_bytes().to_vec();
    bytes.extend(head);
    [1.0f32, 0.0, 0.0, 0.0, 1.0, 0.0].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
    bytes
}

fn u64s(values: &[u64]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

fn u32s(values: &[u32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

fn f32s(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

fn sections(magic: &[u8; 8], version: u32, columns: &[Vec<u8>]) -> Vec<u8> {
    let sections: Vec<(u32, &[u8])> = (1..).zip(columns.iter().map(Vec::as_slice)).collect();
    let mut out = Vec::new();
    container::write(&mut out, *magic, version, &sections).expect("writes to memory");
    out
}

/// Contributions of a view as in docs/formats.md: two regions, two masks, one run of one entry.
fn contributions() -> Vec<u8> {
    let entry = [u32s(&[1]), f32s(&[0.5])].concat();
    let mut crc = flate2::Crc::new();
    crc.update(&entry);
    let checksum = u64::from(crc.sum());
    let header = [u32s(&[2, 2, 2, 1]), u64s(&[3, 1])].concat();
    let run = [u32s(&[0, 0]), u64s(&[0, checksum])].concat();
    let columns = [header, u32s(&[0, 1, 3]), u32s(&[0, 0, 1]), f32s(&[1.0, 0.0, 0.0, 1.0]), run];
    [sections(b"SLAGCONT", 2, &columns), entry].concat()
}

fn region_table() -> Vec<u8> {
    let columns = [u64s(&[2, 2, 2, 3]), f32s(&[1.0, 0.0, 0.0, 1.0]), u64s(&[0, 1, 3]), u32s(&[0, 0, 1])];
    sections(b"SLAGREGN", 2, &columns)
}

fn cell_field() -> Vec<u8> {
    let columns = [
        u64s(&[2, 3]),
        u32s(&[4, 9]),
        u64s(&[0, 1, 3]),
        u32s(&[0, 1, 3]),
        f32s(&[1.0, 0.5, 0.25]),
        f32s(&[1.0, 0.75]),
        f32s(&[0.9, 0.8]),
    ];
    sections(b"SLAGFELD", 1, &columns)
}
