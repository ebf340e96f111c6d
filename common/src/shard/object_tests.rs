use glam::DVec3;
use slag_math::random::Random;

use super::sample::{self, SampleShard};
use super::*;
use crate::container::{self, AlignedBytes, Layout};
use crate::frames::Aabb;
use crate::objects::{
    MAX_THUMBNAIL_BYTES, NO_OBJECT, ObjectRecord, Objects, ObjectsHeader, Thumbnails, collect_runs,
    object_score, quantise_vectors,
};

struct Parts {
    header: ObjectsHeader,
    records: Vec<ObjectRecord>,
    steps: Vec<f32>,
    run_ends: Vec<u32>,
    run_objects: Vec<u16>,
    photos: Vec<u8>,
    /// Ends and pictures.
    thumbnails: Option<(Vec<u32>, Vec<u8>)>,
}

const PICTURE: [u8; 5] = [0xff, 0xd8, 0xff, 1, 2];

fn record(id: u64, n_here: u32, photo: std::ops::Range<u32>) -> ObjectRecord {
    ObjectRecord {
        id,
        position_in_world: [1.0, 2.0, 3.0],
        box_min: [0.5, 1.5, 2.5],
        box_max: [1.5, 2.5, 4.5],
        n_gaussians: 40,
        n_gaussians_here: n_here,
        photo_box_px: [10, 20, 110, 70],
        photo_start: photo.start,
        photo_bytes: photo.len() as u32,
    }
}

/// Six Gaussians of three dimensions, one centroid; objects 1, 1, none, 0, 0, 1.
fn written(edit: impl FnOnce(&mut Parts)) -> Vec<u8> {
    let mut parts = Parts {
        header: ObjectsHeader {
            n_objects: 2,
            n_vectors: 2,
            n_runs: 4,
            photos_bytes: 10,
            score_mean: 0.02,
            score_spread: 0.1,
            score_error_bound: 0.02,
        },
        records: vec![record(0xdead_beef_0000_0001, 2, 0..5), record(7, 3, 5..10)],
        steps: vec![0.01, 0.02, 0.005, 0.0],
        run_ends: vec![2, 3, 5, 6],
        run_objects: vec![1, NO_OBJECT, 0, 1],
        photos: "a.jpgü.png".bytes().take(10).collect(),
        thumbnails: Some((vec![0, 5], PICTURE.into())),
    };
    // The umlaut has two bytes: "a.jpg" and "ü.pn".
    edit(&mut parts);
    let bounds = Aabb { min: DVec3::ZERO, max: DVec3::splat(66.0) };
    let shard = SampleShard {
        header: ShardHeader { centroid_step: 0.01, ..sample::header(5, 6, 1, 3, bounds) },
        positions: vec![[1, 2, 3]; 6],
        centroid_starts: vec![0, 5],
        centroids: vec![100, 0, 0],
        radii: vec![0.5],
        embeddings: None,
    };
    let objects = Objects {
        header: parts.header,
        records: &parts.records,
        vectors: &[100, 0, 0, 0, 50, 0, 0, 0, 120, 1, 2, 3],
        steps: &parts.steps,
        run_ends: &parts.run_ends,
        run_objects: &parts.run_objects,
        photos: &parts.photos,
        thumbnails: parts.thumbnails.as_ref().map(|(ends, pictures)| Thumbnails { ends, pictures }),
    };
    let sections: Vec<(u32, Vec<u8>)> = {
        let out = shard.to_bytes();
        let own = Layout::check(&out, MAGIC, VERSION).expect("valid");
        let ids = (1..=19).filter_map(|id| own.find(id).map(|range| (id, out[range].to_vec())));
        let of_objects = objects.sections().map(|(id, bytes)| (id, bytes.to_vec()));
        ids.chain(of_objects).collect()
    };
    let sections: Vec<(u32, &[u8])> = sections.iter().map(|(id, bytes)| (*id, &bytes[..])).collect();
    let mut out = Vec::new();
    container::write(&mut out, MAGIC, VERSION, &sections).expect("writes");
    out
}

#[test]
fn round_trip() {
    let bytes = AlignedBytes::copy_of(&written(|_| {}));
    let layout = ShardLayout::check(&bytes).expect("valid");
    let objects = layout.additions(&bytes).objects.expect("has objects");
    assert_eq!(objects.records, [record(0xdead_beef_0000_0001, 2, 0..5), record(7, 3, 5..10)]);
    assert_eq!(objects.records.iter().map(|r| objects.photo(r)).collect::<Vec<_>>(), ["a.jpg", "ü.pn"]);
    let thumbnails = objects.thumbnails.expect("has thumbnails");
    assert_eq!([0, 1].map(|object| thumbnails.get(object)), [None, Some(&PICTURE[..])]);
    let runs: Vec<_> = objects.runs().collect();
    assert!(runs.iter().enumerate().all(|(at, (run, _))| objects.run(at) == *run));
    assert_eq!(runs, [(0..2, Some(1)), (2..3, None), (3..5, Some(0)), (5..6, Some(1))]);
    // By hand: object 0 has mean (1, 0, 0) and side (0, 1, 0); object 1 has mean (0, 0, 0.6) and side 0.
    let scores = layout.view(&bytes).object_scores(&objects, &[0.5, 0.25, -1.0]);
    for (found, expected) in scores.iter().zip([0.5 * (0.5 + 0.25), 0.5 * -0.6]) {
        assert!((found - expected).abs() < 1e-6, "{scores:?}");
    }
    // Writing both at once gives the same bytes; a shard without objects has no sections for them.
    let again = objects;
    let mut out = Vec::new();
    layout
        .view(&bytes)
        .write_with(&mut out, Additions { objects: Some(again), ..Additions::default() })
        .expect("writes to memory");
    assert_eq!(out, &bytes[..]);
    out.clear();
    layout.view(&bytes).write(&mut out).expect("writes to memory");
    let bytes = AlignedBytes::copy_of(&out);
    assert!(ShardLayout::check(&bytes).expect("valid").additions(&bytes).objects.is_none());
}

/// A hostile writer can compute correct checksums over invalid contents.
#[test]
fn invalid_contents_are_refused() {
    let refused = |edit: fn(&mut Parts)| ShardLayout::check(&written(edit)).unwrap_err().to_string();
    assert!(refused(|p| p.header.n_objects = u32::MAX).contains("objects of"));
    assert!(refused(|p| p.header.n_objects = 65_534).contains("bytes"));
    assert!(refused(|p| p.header.n_objects = 1).contains("bytes"));
    assert!(refused(|p| p.header.n_vectors = 0).contains("vectors"));
    assert!(refused(|p| p.header.n_vectors = u32::MAX).contains("vectors"));
    assert!(refused(|p| p.header.n_runs = u32::MAX).contains("bytes"));
    assert!(refused(|p| p.header.photos_bytes = u32::MAX).contains("bytes"));
    assert!(refused(|p| p.header.score_mean = f32::NAN).contains("cosines"));
    assert!(refused(|p| p.header.score_spread = -0.1).contains("cosines"));
    assert!(refused(|p| p.header.score_error_bound = f32::INFINITY).contains("cosines"));
    assert!(refused(|p| p.steps[1] = f32::NAN).contains("steps"));
    assert!(refused(|p| p.steps[1] = -0.5).contains("steps"));
    assert!(refused(|p| p.run_ends[1] = 2).contains("ascend"));
    assert!(refused(|p| p.run_ends[0] = 0).contains("ascend"));
    assert!(refused(|p| p.run_ends[3] = 7).contains("ascend"));
    assert!(refused(|p| p.run_objects[0] = 2).contains("object 2 of 2"));
    assert!(refused(|p| p.run_objects[0] = 0).contains("differs from the runs"));
    assert!(refused(|p| p.records[0].n_gaussians = 1).contains("fewer Gaussians"));
    assert!(refused(|p| p.records[1].box_max[2] = f64::INFINITY).contains("not finite"));
    assert!(refused(|p| p.records[1].box_min[0] = 2.0).contains("empty"));
    assert!(refused(|p| p.records[1].position_in_world[0] = f64::NAN).contains("not finite"));
    assert!(refused(|p| p.records[0].photo_box_px[2] = 9).contains("inverted"));
    assert!(refused(|p| p.records[0].photo_start = u32::MAX).contains("name"));
    assert!(refused(|p| p.records[0].photo_bytes = u32::MAX).contains("name"));
    assert!(refused(|p| p.records[0].photo_bytes = 6).contains("name"), "cuts a character");
    assert!(refused(|p| p.photos[0] = 0xff).contains("UTF-8"));
    assert!(refused(|p| p.photos[0] = 0x1b).contains("UTF-8"), "an escape");
    let refused = |ends: &[u32], pictures: &[u8]| {
        let bytes = written(|p| p.thumbnails = Some((ends.into(), pictures.into())));
        ShardLayout::check(&bytes).expect_err("must be refused").to_string()
    };
    assert!(refused(&[5], &PICTURE).contains("bytes"));
    assert!(refused(&[5, 4], &PICTURE).contains("ascend"));
    assert!(refused(&[6, 5], &PICTURE).contains("ascend"));
    assert!(refused(&[0, 6], &PICTURE).contains("ascend"));
    assert!(refused(&[2, 5], &PICTURE).contains("thumbnail of object 0"));
    assert!(refused(&[0, 4], &PICTURE[1..]).contains("thumbnail of object 1"));
    let mut long = PICTURE.to_vec();
    long.resize(MAX_THUMBNAIL_BYTES + 1, 0);
    assert!(refused(&[0, long.len() as u32], &long).contains("thumbnail of object 1"));
}

/// The runs of the Gaussians of [`written`].
#[test]
fn consecutive_gaussians_of_an_object_are_a_run() {
    let of_gaussians = [1, 1, NO_OBJECT, 0, 0, 1];
    assert_eq!(collect_runs(of_gaussians), (vec![2, 3, 5, 6], vec![1, NO_OBJECT, 0, 1]));
    assert_eq!(collect_runs([NO_OBJECT; 3]), (vec![3], vec![NO_OBJECT]));
    assert_eq!(collect_runs([]), (vec![], vec![]));
}

/// Oracle: products in float64. The error stays within its bound, and repeated vectors change no score.
#[test]
fn rounded_vectors_keep_scores() {
    let dim = 64;
    let mut random = Random::new(5);
    let vectors: Vec<f32> = (0..3).flat_map(|_| random.unit_vector(dim)).collect();
    let (rounded, steps) = quantise_vectors(&vectors, dim, 5);
    assert_eq!((rounded.len(), steps.len()), (5 * dim, 5));
    for _ in 0..50 {
        let query = random.unit_vector(dim);
        let product =
            |v: &mut dyn Iterator<Item = f64>| -> f64 { v.zip(&query).map(|(v, q)| v * f64::from(*q)).sum() };
        let exact: Vec<f32> =
            vectors.chunks(dim).map(|v| product(&mut v.iter().map(|v| f64::from(*v))) as f32).collect();
        let kept: Vec<f32> = rounded
            .chunks(dim)
            .zip(&steps)
            .map(|(v, s)| product(&mut v.iter().map(|v| f64::from(*v) * f64::from(*s))) as f32)
            .collect();
        let bound = steps.iter().fold(0.0f32, |most, s| most.max(*s)) / 2.0 * (dim as f32).sqrt();
        let error = (object_score(&kept) - object_score(&exact)).abs();
        assert!(error <= bound && bound < 0.02, "{error} {bound}");
    }
    assert!(object_score(&[]).is_nan());
    assert_eq!(object_score(&[0.5]), 0.5);
}
