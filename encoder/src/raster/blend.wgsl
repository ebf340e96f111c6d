// Twin of blend.rs: blends the Gaussians of a tile front to back and sums their weights over regions.
//
// A workgroup processes a tile, a thread a pixel. Pixels are assigned to threads in the order of their
// regions, so that the pixels of a region are contiguous. The second half of each step then sums runs of
// pixels with 32 threads per Gaussian, independently of the number of regions.

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read_write> counters: array<atomic<u32>, N_COUNTERS>;
@group(0) @binding(2) var<storage, read> screen: array<Screen>;
@group(0) @binding(3) var<storage, read> members: array<u32>;
@group(0) @binding(4) var<storage, read> ranges: array<Range>;
// Row-major, within the band, two a word.
@group(0) @binding(5) var<storage, read> regions_of_pixels: array<u32>;
@group(0) @binding(6) var<storage, read_write> entries: array<Entry>;
// The order in which tiles are blended.
@group(0) @binding(7) var<storage, read> tile_order: array<u32>;

// Gaussians with weights summed in one step.
const STEP = 8u;
// Gaussians loaded at once.
const LOAD = 64u;
// Consecutive pixels that a thread sums.
const RUN = 8u;
// A word of padding per run and per Gaussian keeps neighbouring threads in different memory banks.
const WEIGHTS_STRIDE = WORKGROUP_SIZE + WORKGROUP_SIZE / RUN + 1u;
const N_SUMS = 2048u;
const NO_SLOT = 0xffffu;
const PIXEL_BITS = 8u;
const NO_REGION_KEY = (1u << REGION_BITS) - 1u;

var<workgroup> pixel_keys: array<u32, WORKGROUP_SIZE>;
var<workgroup> slots: array<u32, WORKGROUP_SIZE>;
var<workgroup> region_of_slot: array<u32, WORKGROUP_SIZE>;
var<workgroup> gaussians: array<InTile, LOAD>;
var<workgroup> weights: array<f32, STEP * WEIGHTS_STRIDE>;
var<workgroup> sums: array<atomic<u32>, N_SUMS>;
var<workgroup> upper_sums: array<atomic<u32>, N_SUMS>;
var<workgroup> n_slots_shared: u32;
var<workgroup> range_shared: vec2<u32>;
var<workgroup> n_live: atomic<u32>;
var<workgroup> n_live_shared: u32;
var<workgroup> n_found: atomic<u32>;
var<workgroup> first_entry: u32;

// Sorts the pixels of the tile by region (Batcher 1968).
fn sort_pixels(thread: u32) {
    for (var size = 2u; size <= WORKGROUP_SIZE; size *= 2u) {
        for (var distance = size / 2u; distance > 0u; distance /= 2u) {
            workgroupBarrier();
            let partner = thread ^ distance;
            let own = pixel_keys[thread];
            let other = pixel_keys[partner];
            let wants_lower = (thread < partner) == ((thread & size) == 0u);
            workgroupBarrier();
            pixel_keys[thread] = select(max(own, other), min(own, other), wants_lower);
        }
    }
    workgroupBarrier();
}

@compute @workgroup_size(WORKGROUP_SIZE)
fn sum_regions(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = tile_order[group.y * view.tile_columns + group.x];
    let x_px = tile % view.tile_columns * TILE_SIZE_PX;
    let y_px = (view.first_tile_row + tile / view.tile_columns) * TILE_SIZE_PX;
    {
        let x = x_px + thread % TILE_SIZE_PX;
        let y = y_px + thread / TILE_SIZE_PX;
        var region = NO_REGION_KEY;
        if x < view.width_px && y < view.height_px {
            let at = (y - view.first_tile_row * TILE_SIZE_PX) * view.width_px + x;
            region = (regions_of_pixels[at / 2u] >> (at % 2u * REGION_BITS)) & NO_REGION_KEY;
        }
        pixel_keys[thread] = (region << PIXEL_BITS) | thread;
    }
    sort_pixels(thread);
    let key = pixel_keys[thread];
    let region = key >> PIXEL_BITS;
    let pixel = key & (WORKGROUP_SIZE - 1u);
    var is_head = 0u;
    if thread == 0u || pixel_keys[max(thread, 1u) - 1u] >> PIXEL_BITS != region {
        is_head = 1u;
    }
    let slot = block_scan(is_head, thread) + is_head - 1u;
    // Pixels without a region are last.
    let has_region = region != NO_REGION_KEY;
    slots[thread] = select(NO_SLOT, slot, has_region);
    if is_head == 1u {
        region_of_slot[slot] = region;
    }
    if thread == WORKGROUP_SIZE - 1u {
        n_slots_shared = slot + u32(has_region);
        let range = ranges[tile];
        range_shared = vec2<u32>(range.start, min(range.end, view.capacity_pairs));
        atomicStore(&n_live, 0u);
        atomicStore(&n_found, 0u);
    }
    for (var i = thread; i < N_SUMS; i += WORKGROUP_SIZE) {
        atomicStore(&sums[i], 0u);
        atomicStore(&upper_sums[i], 0u);
    }
    let n_slots = workgroupUniformLoad(&n_slots_shared);
    let range = workgroupUniformLoad(&range_shared);
    if n_slots == 0u || range.x >= range.y {
        return;
    }

    let local_x = pixel % TILE_SIZE_PX;
    let local_y = pixel / TILE_SIZE_PX;
    var is_live = x_px + local_x < view.width_px && y_px + local_y < view.height_px;
    var transmittance = 1.0;
    if is_live {
        atomicAdd(&n_live, 1u);
    }
    // The run of pixels that this thread sums, for one Gaussian of a step: neighbours sum for different Gaussians, so that
    // few of them add to one sum at a time.
    let of_step = thread % STEP;
    let run = thread / STEP;
    // Most runs lie in one region; pixels are in the order of their regions.
    let is_of_one = slots[run * RUN] == slots[run * RUN + RUN - 1u];
    // Number of Gaussians with sums in workgroup memory before they are written out.
    let per_round = min(N_SUMS / n_slots / STEP * STEP, LOAD);

    for (var start = range.x; start < range.y; start += per_round) {
        if thread < per_round {
            if start + thread < range.y {
                let member = members[start + thread];
                gaussians[thread] = in_tile(screen[member], member, x_px, y_px);
            } else {
                gaussians[thread] = InTile(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0u);
            }
        }
        if thread == 0u {
            n_live_shared = atomicLoad(&n_live);
        }
        // Also a barrier: the Gaussians are loaded.
        if workgroupUniformLoad(&n_live_shared) == 0u {
            break;
        }
        let n_loaded = min(per_round, range.y - start);
        for (var step = 0u; step < n_loaded; step += STEP) {
            // Without branches, so that all threads go the same way. No alpha counts beyond the reach.
            let was_live = is_live;
            for (var i = 0u; i < STEP; i++) {
                let g = gaussians[step + i];
                let u = g.u0 + g.u_y * f32(local_y) + g.u_x * f32(local_x);
                let v = g.v0 + g.v_y * f32(local_y);
                let falloff = exp_of_minus(0.5 * u * u + 0.5 * v * v);
                let alpha = min(g.opacity * falloff, MAX_ALPHA);
                let counts = is_live && u * u + v * v <= g.reach2 && alpha >= MIN_ALPHA;
                let next = transmittance * (1.0 - alpha);
                let is_summed = counts && next > MIN_TRANSMITTANCE;
                weights[i * WEIGHTS_STRIDE + thread + thread / RUN] = select(0.0, alpha * transmittance, is_summed);
                transmittance = select(transmittance, next, is_summed);
                is_live = is_live && (is_summed || !counts);
            }
            if was_live && !is_live {
                atomicSub(&n_live, 1u);
            }
            workgroupBarrier();
            let first_weight = of_step * WEIGHTS_STRIDE + run * (RUN + 1u);
            let first_sum = (step + of_step) * n_slots;
            var sum = 0.0;
            var slot_of_run = slots[run * RUN];
            if is_of_one {
                for (var i = 0u; i < RUN; i++) {
                    sum += weights[first_weight + i];
                }
            } else {
                for (var i = 0u; i < RUN; i++) {
                    let slot_of_pixel = slots[run * RUN + i];
                    if slot_of_pixel != slot_of_run {
                        add(first_sum, slot_of_run, sum);
                        sum = 0.0;
                        slot_of_run = slot_of_pixel;
                    }
                    sum += weights[first_weight + i];
                }
            }
            add(first_sum, slot_of_run, sum);
            workgroupBarrier();
        }
        write_entries(n_loaded, n_slots, thread);
    }
}

// Adds the sum of a run, at most 8, as an integer in units of 2^-SUM_FRACTION_BITS. The upper word has units
// of 2^(32 - SUM_FRACTION_BITS); both parts of the split are exact.
fn add(first_sum: u32, slot: u32, sum: f32) {
    if slot != NO_SLOT && sum > 0.0 {
        var high = u32(sum * UPPER_SCALE);
        let low = u32((sum - f32(high) / UPPER_SCALE) * UPPER_SCALE * 4294967296.0);
        let at = first_sum + slot;
        let before = atomicAdd(&sums[at], low);
        high += u32(before + low < before);
        if high > 0u {
            atomicAdd(&upper_sums[at], high);
        }
    }
}

// Appends the sums to the entries and clears them. The order in which tiles append does not matter, because
// entries are sorted and added as integers before they are read.
fn write_entries(n_loaded: u32, n_slots: u32, thread: u32) {
    var n_own = 0u;
    for (var i = thread; i < n_loaded * n_slots; i += WORKGROUP_SIZE) {
        n_own += u32((atomicLoad(&sums[i]) | atomicLoad(&upper_sums[i])) > 0u);
    }
    var at = 0u;
    if n_own > 0u {
        at = atomicAdd(&n_found, n_own);
    }
    workgroupBarrier();
    if thread == 0u {
        // Counts stop far above every capacity, so that they cannot wrap: the groups that run at once add less than the rest.
        first_entry = MAX_CAPACITY;
        if atomicLoad(&counters[COUNTER_ENTRIES]) <= MAX_CAPACITY {
            first_entry = atomicAdd(&counters[COUNTER_ENTRIES], atomicLoad(&n_found));
        }
        atomicStore(&n_found, 0u);
    }
    at += workgroupUniformLoad(&first_entry);
    if n_own > 0u {
        for (var i = thread; i < n_loaded * n_slots; i += WORKGROUP_SIZE) {
            let low = atomicExchange(&sums[i], 0u);
            let high = atomicExchange(&upper_sums[i], 0u);
            if (low | high) > 0u {
                if at < view.capacity_entries {
                    entries[at] = Entry(gaussians[i / n_slots].member, region_of_slot[i % n_slots], low, high);
                }
                at += 1u;
            }
        }
    }
    workgroupBarrier();
}
