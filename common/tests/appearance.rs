//! Shards with an appearance: round trip, and refusal of columns of another length.

use super::*;
use slag_common::appearance::Appearance;
use slag_common::container::Layout;
use slag_common::shard::{Additions, MAGIC, VERSION};

fn written(appearance: Option<Appearance<'_>>) -> Vec<u8> {
    let bounds = Aabb { min: DVec3::ZERO, max: DVec3::ONE };
    let shard = SampleShard {
        header: ShardHeader { centroid_step: 0.5, ..sample::header(1, 2, 1, 2, bounds) },
        positions: vec![[0, 0, 0], [1, 0, 0]],
        centroid_starts: vec![0, 2],
        centroids: vec![1, -2],
        radii: vec![0.0],
        embeddings: None,
    };
    let shard = shard.view();
    // By hand: the centroid is (0.5, -1).
    assert_eq!(shard.centroid_scores(&[1.0, 0.25]), [0.25]);
    let mut out = Vec::new();
    shard.write_with(&mut out, Additions { appearance, ..Additions::default() }).expect("writes to memory");
    out
}

const COLOURS: [[u8; 4]; 2] = [[1, 2, 3, 4], [5, 6, 7, 8]];
const SIZES: [[u8; 3]; 2] = [[9; 3], [10; 3]];
const ROTATIONS: [[u8; 3]; 2] = [[11; 3], [12; 3]];

#[test]
fn appearances_come_back() {
    let appearance = Appearance { colours: &COLOURS, sizes: &SIZES, rotations: &ROTATIONS };
    let bytes = AlignedBytes::copy_of(&written(Some(appearance)));
    let layout = ShardLayout::check(&bytes).expect("valid");
    let found = layout.additions(&bytes).appearance.expect("an appearance");
    assert_eq!((found.colours, found.sizes, found.rotations), (&COLOURS[..], &SIZES[..], &ROTATIONS[..]));
    let bytes = AlignedBytes::copy_of(&written(None));
    assert!(ShardLayout::check(&bytes).expect("valid").additions(&bytes).appearance.is_none());
}

#[test]
fn columns_of_another_length_are_refused() {
    let appearance = Appearance { colours: &COLOURS, sizes: &SIZES, rotations: &ROTATIONS };
    let bytes = AlignedBytes::copy_of(&written(Some(appearance)));
    let layout = Layout::check(&bytes, MAGIC, VERSION).expect("valid");
    for cut in [section::COLOURS, section::SIZES, section::ROTATIONS] {
        for without in [false, true] {
            if without && cut == section::COLOURS {
                continue;
            }
            let ids = (1..=5).chain([section::COLOURS, section::SIZES, section::ROTATIONS]);
            let sections: Vec<(u32, &[u8])> = ids
                .filter(|id| !(without && *id == cut))
                .map(|id| {
                    let bytes = &bytes[layout.find(id).expect("there")];
                    (id, if id == cut { &bytes[..bytes.len() - 1] } else { bytes })
                })
                .collect();
            let mut out = Vec::new();
            container::write(&mut out, MAGIC, VERSION, &sections).expect("writes");
            assert!(ShardLayout::check(&out).is_err(), "section {cut}, {without}");
        }
    }
}
