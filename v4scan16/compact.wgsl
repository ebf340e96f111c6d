// Sums the sorted entries of each (Gaussian, region). They are integers, so the order does not affect the result.

// Contribution of a Gaussian to a region over all tiles, in units of 2^-SUM_FRACTION_BITS.
struct RegionSum {
    gaussian: u32,
    region: u32,
    low: atomic<u32>,
    high: atomic<u32>,
}

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> counters: array<u32, N_COUNTERS>;
@group(0) @binding(2) var<storage, read> screen: array<Screen>;
@group(0) @binding(3) var<storage, read> entries: array<Entry>;
@group(0) @binding(4) var<storage, read> order: array<u32>;
@group(0) @binding(5) var<storage, read_write> block_counts: array<u32>;
@group(0) @binding(6) var<storage, read_write> region_sums: array<RegionSum>;

fn n_entries() -> u32 {
    return min(counters[COUNTER_ENTRIES], view.capacity_entries);
}

// Returns 1 if the sorted entry is the first of its (Gaussian, region), else 0.
fn is_head(at: u32, n: u32) -> u32 {
    if at >= n {
        return 0u;
    }
    if at == 0u {
        return 1u;
    }
    let own = entries[order[at]];
    let before = entries[order[at - 1u]];
    return u32(own.member != before.member || own.region != before.region);
}

@compute @workgroup_size(WORKGROUP_SIZE)
fn count_heads(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let n = n_entries();
    let n_blocks = (n + WORKGROUP_SIZE - 1u) / WORKGROUP_SIZE;
    for (var block = group.x; block < n_blocks; block += groups.x) {
        let head = is_head(block * WORKGROUP_SIZE + thread, n);
        let before = block_scan(head, thread);
        // Clears the sums for `add_up`; they are at most as many as the entries.
        let at = block * WORKGROUP_SIZE + thread;
        if at < n {
            atomicStore(&region_sums[at].low, 0u);
            atomicStore(&region_sums[at].high, 0u);
        }
        if thread == WORKGROUP_SIZE - 1u {
            block_counts[block] = before + head;
        }
    }
}

@compute @workgroup_size(WORKGROUP_SIZE)
fn add_up(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let n = n_entries();
    let n_blocks = (n + WORKGROUP_SIZE - 1u) / WORKGROUP_SIZE;
    for (var block = group.x; block < n_blocks; block += groups.x) {
        let position = block * WORKGROUP_SIZE + thread;
        let head = is_head(position, n);
        let index = block_counts[block] + block_scan(head, thread) + head - 1u;
        if position < n {
            let entry = entries[order[position]];
            if head == 1u {
                region_sums[index].gaussian = screen[entry.member].gaussian;
                region_sums[index].region = entry.region;
            }
            // The lower word wraps at most once per addition.
            let before = atomicAdd(&region_sums[index].low, entry.low);
            let carried = entry.high + u32(before + entry.low < before);
            if carried > 0u {
                atomicAdd(&region_sums[index].high, carried);
            }
        }
    }
}
