use slag_math::random::Random;

use super::*;
use crate::container::{self, AlignedBytes, ContainerError, Layout};

const MAGIC: [u8; 8] = *b"SLAGTEST";

fn written(sections: &[(u32, &[u8])]) -> AlignedBytes {
    let mut out = Vec::new();
    container::write(&mut out, MAGIC, 1, sections).expect("writes to memory");
    AlignedBytes::copy_of(&out)
}

fn checked(bytes: &AlignedBytes) -> Result<Option<Occupancy<'_>>, ContainerError> {
    let layout = Layout::check(bytes, MAGIC, 1).expect("a container");
    check(bytes, &layout).map(|()| Occupancy::of(bytes, &layout))
}

fn blocks(random: &mut Random, n: i32) -> Vec<Block> {
    let mut all = Vec::new();
    for at in (-n..n).flat_map(|x| (-n..n).flat_map(move |y| (-n..n).map(move |z| [x, y, z]))) {
        let (a, b) = (random.bits(), random.bits());
        let (occupied, free) = match random.bits() % 5 {
            0 => (0, 0),
            1 => (0, !0),
            2 => (!0, 0),
            3 => (a, b & !a),
            _ => continue,
        };
        all.push(Block { at, occupied, free });
    }
    all
}

fn blocks_of(occupancy: &Occupancy<'_>) -> Vec<Block> {
    let of_run = |run: BlockRun<'_>| -> Vec<Block> {
        let OccupancyHeader { first_block: [x, y, z], n_blocks: [_, n_y, n_z], .. } = occupancy.header;
        let block = |index: u32| {
            let offset = [index / n_z / n_y, index / n_z % n_y, index % n_z].map(|n| n as i32);
            let [occupied, free] = run.masks_of(index);
            Block { at: [x + offset[0], y + offset[1], z + offset[2]], occupied, free }
        };
        run.blocks.clone().map(block).collect()
    };
    occupancy.runs().flat_map(of_run).collect()
}

#[test]
fn every_block_with_a_known_voxel_comes_back() {
    let mut random = Random::new(3);
    for n in 0..4 {
        // Ascending by place, as runs are.
        let mut blocks = blocks(&mut random, n);
        let built = BuiltOccupancy::pack(0.05, 0.1, 2, &blocks);
        let bytes = written(&built.view().sections());
        let view = checked(&bytes).expect("valid").expect("there");
        assert_eq!((view.header.voxel, view.header.min_opacity, view.header.min_views), (0.05, 0.1, 2));
        blocks.retain(|block| block.occupied | block.free != 0);
        assert_eq!(blocks_of(&view), blocks);
    }
}

/// By hand: a stray block 4 km up is dropped instead of enlarging the box.
#[test]
fn stray_blocks_are_left_out() {
    let block = |at| Block { at, occupied: 1, free: 0 };
    let blocks = [block([0, 0, 0]), block([5, 0, 0]), block([5, 0, 10_000])];
    let built = BuiltOccupancy::pack(0.1, 0.1, 1, &blocks);
    assert_eq!(built.view().header.n_blocks, [6, 1, 1]);
    assert_eq!(blocks_of(&built.view()), blocks[..2]);
}

#[test]
fn damage_is_named() {
    let block = |z, occupied, free| Block { at: [0, 0, z], occupied, free };
    let good = BuiltOccupancy::pack(0.05, 0.1, 2, &[block(0, 1, 2), block(1, 0, !0), block(5, !0, 0)]);
    let refused = |header: OccupancyHeader, runs: &[StoredRun], masks: &[[u64; 2]]| {
        let view = Occupancy { header, runs, masks };
        checked(&written(&view.sections())).err().map(|e| e.to_string()).unwrap_or_default()
    };
    let Occupancy { header, runs, masks } = good.view();
    assert_eq!(refused(header, runs, masks), "");
    let with = |edit: &dyn Fn(&mut OccupancyHeader)| {
        let mut header = header;
        edit(&mut header);
        refused(header, runs, masks)
    };
    assert!(with(&|h| h.voxel = f64::NAN).contains("voxels of NaN"));
    assert!(with(&|h| h.n_blocks = [1 << 20, 1 << 20, 1 << 20]).contains("blocks from"));
    assert!(with(&|h| h.n_blocks = [0, 1, 6]).contains("blocks from"));
    assert!(with(&|h| h.first_block = [i32::MAX, 0, 0]).contains("blocks from"));
    assert!(with(&|h| h.min_opacity = -1.0).contains("least opacity"));
    assert!(with(&|h| h.n_blocks = [1, 1, 5]).contains("run 2"));
    assert!(with(&|h| h.n_runs = 2).contains("runs of blocks"));
    assert!(with(&|h| h.n_mixed = 2).contains("masks of blocks"));
    let run = |start, len_and_kind| StoredRun { start, len_and_kind };
    assert!(refused(header, &[run(0, 7), run(0, 5), run(5, 6)], masks).contains("run 1"));
    assert!(refused(header, &[run(0, 7), run(1, 4), run(5, 6)], masks).contains("run 1"));
    assert!(refused(header, &[run(0, 3), run(1, 5), run(5, 6)], masks).contains("run 0"));
    assert!(refused(header, &[run(0, 5), run(1, 5), run(5, 6)], masks).contains("0 mixed blocks"));
    assert!(refused(header, runs, &[[3, 1]]).contains("free and occupied"));
}
