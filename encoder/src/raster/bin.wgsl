// Twin of bin.rs: lists (tile, Gaussian) pairs near to far, and where each tile's begin.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> counters: array<u32, N_COUNTERS>;
@group(0) @binding(2) var<storage, read> screen: array<Screen>;
@group(0) @binding(3) var<storage, read> tile_counts: array<u32>;
// Visible Gaussians by depth; in `find_ranges` pairs by tile.
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

// Writes the pairs of a visible Gaussian from `start` on.
fn write_tiles(member: u32, start: u32) {
    var at = start;
    let g = screen[member];
    let extent = extent_px(g);
    let rows = tile_rows(g, view.height_px);
    let end = min(rows.last + 1u, view.end_tile_row);
    for (var row = max(rows.first, view.first_tile_row); row < end; row++) {
        let columns = tile_columns(g, extent, row, view.width_px, view.height_px);
        if columns.is_some {
            let first = (row - view.first_tile_row) * view.tile_columns;
            for (var column = columns.first; column <= columns.last; column++) {
                if at < view.capacity_pairs {
                    pairs[at] = Pair(first + column, member);
                }
                at += 1u;
            }
        }
    }
}

@compute @workgroup_size(WORKGROUP_SIZE)
fn write_pairs(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let n = min(counters[COUNTER_VISIBLE], view.capacity_visible);
    let n_blocks = (n + WORKGROUP_SIZE - 1u) / WORKGROUP_SIZE;
    for (var block = group.x; block < n_blocks; block += groups.x) {
        let position = block * WORKGROUP_SIZE + thread;
        let n_tiles = tiles_of(position, n);
        let at = block_counts[block] + block_scan(n_tiles, thread);
        if n_tiles > 0u {
            write_tiles(order[position], at);
        }
    }
}

@group(0) @binding(7) var<storage, read> sorted_pairs: array<Pair>;
@group(0) @binding(8) var<storage, read_write> ranges: array<Range>;
@group(0) @binding(9) var<storage, read_write> members: array<u32>;

// Writes the members of all tiles one after another, and each tile's range; tiles without stay 0..0.
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
