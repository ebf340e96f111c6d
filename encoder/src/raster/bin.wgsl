// Twin of bin.rs: lists (tile, Gaussian) pairs from near to far, and the range of each tile.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> counters: array<u32, N_COUNTERS>;
@group(0) @binding(2) var<storage, read> screen: array<Screen>;
@group(0) @binding(3) var<storage, read> tile_counts: array<u32>;
// Order of the visible Gaussians by depth; in `find_ranges`, order of the pairs by tile.
@group(0) @binding(4) var<storage, read> order: array<u32>;
@group(0) @binding(5) var<storage, read_write> block_counts: array<u32>;
@group(0) @binding(6) var<storage, read_write> pairs: array<Pair>;

fn tiles_of(at: u32, n: u32) -> u32 {
    if at < n {
        return tile_counts[order[at]];
    }
    return 0u;
}

@compute @workgroup_size(WORKGROUP_SIZE)
fn count_pairs(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let n = min(counters[COUNTER_VISIBLE], view.capacity_visible);
    let n_blocks = (n + WORKGROUP_SIZE - 1u) / WORKGROUP_SIZE;
    for (var block = group.x; block < n_blocks; block += groups.x) {
        let n_tiles = tiles_of(block * WORKGROUP_SIZE + thread, n);
        let before = block_scan(n_tiles, thread);
        if thread == WORKGROUP_SIZE - 1u {
            block_counts[block] = before + n_tiles;
        }
    }
}

// Writes the pairs of one row of tiles, from index `start` on.
fn write_row(member: u32, row: u32, columns: PixelSpan, start: u32) {
    let first = (row - view.first_tile_row) * view.tile_columns;
    for (var column = columns.first; column <= columns.last; column++) {
        let at = start + column - columns.first;
        if at < view.capacity_pairs {
            pairs[at] = Pair(first + column, member);
        }
    }
}

fn width_of(columns: PixelSpan) -> u32 {
    return select(0u, columns.last - columns.first + 1u, columns.is_some);
}

// Writes the pairs of a visible Gaussian, from index `start` on.
fn write_tiles(member: u32, start: u32) {
    var at = start;
    let g = screen[member];
    let extent = extent_px(g);
    let rows = tile_rows(g, view.height_px);
    let end = min(rows.last + 1u, view.end_tile_row);
    for (var row = max(rows.first, view.first_tile_row); row < end; row++) {
        let columns = tile_columns(g, extent, row, view.width_px, view.height_px);
        if columns.is_some {
            write_row(member, row, columns, at);
        }
        at += width_of(columns);
    }
}

// A Gaussian with more tiles is written by all threads of its block, one row each.
const MAX_OWN_TILES = 64u;

struct Wide {
    member: u32,
    start: u32,
    first_row: u32,
    end_row: u32,
}

var<workgroup> n_wide: atomic<u32>;
var<workgroup> n_wide_shared: u32;
var<workgroup> wide: array<Wide, WORKGROUP_SIZE>;
var<workgroup> wide_shared: Wide;
var<workgroup> n_of_rows: u32;

@compute @workgroup_size(WORKGROUP_SIZE)
fn write_pairs(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let n = min(counters[COUNTER_VISIBLE], view.capacity_visible);
    let n_blocks = (n + WORKGROUP_SIZE - 1u) / WORKGROUP_SIZE;
    for (var block = group.x; block < n_blocks; block += groups.x) {
        if thread == 0u {
            atomicStore(&n_wide, 0u);
        }
        let position = block * WORKGROUP_SIZE + thread;
        let n_tiles = tiles_of(position, n);
        let at = block_counts[block] + block_scan(n_tiles, thread);
        if n_tiles > MAX_OWN_TILES {
            let rows = tile_rows(screen[order[position]], view.height_px);
            let first = max(rows.first, view.first_tile_row);
            let end = min(rows.last + 1u, view.end_tile_row);
            wide[atomicAdd(&n_wide, 1u)] = Wide(order[position], at, first, end);
        } else if n_tiles > 0u {
            write_tiles(order[position], at);
        }
        workgroupBarrier();
        if thread == 0u {
            n_wide_shared = atomicLoad(&n_wide);
        }
        let n_found = workgroupUniformLoad(&n_wide_shared);
        for (var i = 0u; i < n_found; i++) {
            if thread == 0u {
                wide_shared = wide[i];
            }
            let found = workgroupUniformLoad(&wide_shared);
            let g = screen[found.member];
            let extent = extent_px(g);
            var start = found.start;
            for (var first = found.first_row; first < found.end_row; first += WORKGROUP_SIZE) {
                let row = first + thread;
                var columns = PixelSpan(0u, 0u, false);
                if row < found.end_row {
                    columns = tile_columns(g, extent, row, view.width_px, view.height_px);
                }
                let before = block_scan(width_of(columns), thread);
                if columns.is_some {
                    write_row(found.member, row, columns, start + before);
                }
                if thread == WORKGROUP_SIZE - 1u {
                    n_of_rows = before + width_of(columns);
                }
                start += workgroupUniformLoad(&n_of_rows);
            }
        }
    }
}

@group(0) @binding(7) var<storage, read> sorted_pairs: array<Pair>;
@group(0) @binding(8) var<storage, read_write> ranges: array<Range>;
@group(0) @binding(9) var<storage, read_write> members: array<u32>;

// Writes the members of all tiles contiguously, and the range of each tile; empty tiles keep the range 0..0.
@compute @workgroup_size(WORKGROUP_SIZE)
fn find_ranges(
    @builtin(global_invocation_id) id: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
) {
    let n = min(counters[COUNTER_PAIRS], view.capacity_pairs);
    for (var i = id.x; i < n; i += groups.x * WORKGROUP_SIZE) {
        let pair = sorted_pairs[order[i]];
        members[i] = pair.member;
        if i == 0u || sorted_pairs[order[max(i, 1u) - 1u]].tile != pair.tile {
            ranges[pair.tile].start = i;
        }
        if i == n - 1u || sorted_pairs[order[min(i + 1u, n - 1u)]].tile != pair.tile {
            ranges[pair.tile].end = i + 1u;
        }
    }
}

@group(0) @binding(10) var<storage, read> tile_ranges: array<Range>;
@group(0) @binding(11) var<storage, read_write> tile_order: array<u32>;

// Classes of tiles by their number of pairs, four for each power of two.
const N_CLASSES = 128u;
var<workgroup> class_counts: array<atomic<u32>, N_CLASSES>;

// Returns the class of a tile; fuller tiles have lower ones.
fn class_of(tile: u32) -> u32 {
    let n = tile_ranges[tile].end - tile_ranges[tile].start;
    if n < 4u {
        return N_CLASSES - 1u - n;
    }
    let exponent = firstLeadingBit(n);
    return N_CLASSES - 1u - (exponent * 4u + ((n >> (exponent - 2u)) & 3u) - 4u);
}

// Orders the tiles by their number of pairs, the fullest first: the last ones to be blended are then soon done.
// One workgroup orders all tiles.
@compute @workgroup_size(WORKGROUP_SIZE)
fn order_tiles(@builtin(local_invocation_index) thread: u32) {
    let n_tiles = view.tile_columns * (view.end_tile_row - view.first_tile_row);
    if thread < N_CLASSES {
        atomicStore(&class_counts[thread], 0u);
    }
    workgroupBarrier();
    for (var tile = thread; tile < n_tiles; tile += WORKGROUP_SIZE) {
        atomicAdd(&class_counts[class_of(tile)], 1u);
    }
    workgroupBarrier();
    var n = 0u;
    if thread < N_CLASSES {
        n = atomicLoad(&class_counts[thread]);
    }
    let before = block_scan(n, thread);
    if thread < N_CLASSES {
        atomicStore(&class_counts[thread], before);
    }
    workgroupBarrier();
    for (var tile = thread; tile < n_tiles; tile += WORKGROUP_SIZE) {
        tile_order[atomicAdd(&class_counts[class_of(tile)], 1u)] = tile;
    }
}
