// Stable radix sort of indices by a key of one word or two, a digit below RADIX per pass: count, scan, scatter.
//
// Every thread owns a run of consecutive items, so ranks follow the order of the input without subgroups or
// atomics, and the result is the same on every device.

struct SortPass {
    // Counter with the number of items.
    items: u32,
    // The upper word of item i is `keys[i * stride + offset] - least`; the lower word, the next one, has
    // `low_bits` bits.
    stride: u32,
    offset: u32,
    least: u32,
    low_bits: u32,
    // Position of the digit in the key. The first pass, at 0, takes the items in their original order.
    shift: u32,
    capacity: u32,
}

@group(0) @binding(0) var<storage, read> job: SortPass;
@group(0) @binding(1) var<storage, read> counters: array<u32, N_COUNTERS>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read> order_in: array<u32>;
@group(0) @binding(4) var<storage, read_write> histogram: array<u32>;
@group(0) @binding(5) var<storage, read_write> order_out: array<u32>;

const PER_THREAD = SORT_BLOCK / WORKGROUP_SIZE;
// A word counts two digits, in its halves: a digit and that `ROWS` above it. Counts within a block fit.
const ROWS = RADIX / 2u;
const HALF_WORD_BITS = 16u;

fn n_items() -> u32 {
    return min(counters[job.items], job.capacity);
}

fn item(at: u32) -> u32 {
    if job.shift == 0u {
        return at;
    }
    return order_in[at];
}

fn digit(item: u32) -> u32 {
    let word = item * job.stride + job.offset;
    if job.shift >= job.low_bits {
        return ((keys[word] - job.least) >> (job.shift - job.low_bits)) % RADIX;
    }
    return ((keys[word + 1u] >> job.shift) | (keys[word] << (job.low_bits - job.shift))) % RADIX;
}

var<workgroup> block_histogram: array<atomic<u32>, RADIX>;

@compute @workgroup_size(WORKGROUP_SIZE)
fn count_digits(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let n = n_items();
    let n_blocks = (n + SORT_BLOCK - 1u) / SORT_BLOCK;
    for (var block = group.x; block < n_blocks; block += groups.x) {
        if thread < RADIX {
            atomicStore(&block_histogram[thread], 0u);
        }
        workgroupBarrier();
        for (var i = 0u; i < PER_THREAD; i++) {
            let at = block * SORT_BLOCK + i * WORKGROUP_SIZE + thread;
            if at < n {
                atomicAdd(&block_histogram[digit(item(at))], 1u);
            }
        }
        workgroupBarrier();
        if thread < RADIX {
            histogram[thread * n_blocks + block] = atomicLoad(&block_histogram[thread]);
        }
        workgroupBarrier();
    }
}

// Counts per (digit, thread), then the ranks of the thread's items within the digit.
var<workgroup> counts: array<u32, ROWS * WORKGROUP_SIZE>;
// Ranks of the first items of the digits within the block, and their places in the output.
var<workgroup> first_ranks: array<u32, ROWS>;
var<workgroup> digit_starts: array<u32, RADIX>;

@compute @workgroup_size(WORKGROUP_SIZE)
fn scatter(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let n = n_items();
    let n_blocks = (n + SORT_BLOCK - 1u) / SORT_BLOCK;
    for (var block = group.x; block < n_blocks; block += groups.x) {
        for (var d = 0u; d < ROWS; d++) {
            counts[d * WORKGROUP_SIZE + thread] = 0u;
        }
        if thread < RADIX {
            digit_starts[thread] = histogram[thread * n_blocks + block];
        }
        var items: array<u32, PER_THREAD>;
        var digits: array<u32, PER_THREAD>;
        let first = block * SORT_BLOCK + thread * PER_THREAD;
        for (var i = 0u; i < PER_THREAD; i++) {
            digits[i] = RADIX;
            if first + i < n {
                items[i] = item(first + i);
                digits[i] = digit(items[i]);
                counts[digits[i] % ROWS * WORKGROUP_SIZE + thread] += 1u << (digits[i] / ROWS * HALF_WORD_BITS);
            }
        }
        workgroupBarrier();
        // A thread scans as many consecutive counts as there are digits in a half, all of one digit.
        var sum = 0u;
        var own: array<u32, ROWS>;
        for (var i = 0u; i < ROWS; i++) {
            own[i] = sum;
            sum += counts[thread * ROWS + i];
        }
        let before = block_scan(sum, thread);
        let of_digit = thread * ROWS / WORKGROUP_SIZE;
        if thread * ROWS % WORKGROUP_SIZE == 0u {
            first_ranks[of_digit] = before;
        }
        workgroupBarrier();
        let rank = before - first_ranks[of_digit];
        for (var i = 0u; i < ROWS; i++) {
            counts[thread * ROWS + i] = rank + own[i];
        }
        workgroupBarrier();
        for (var i = 0u; i < PER_THREAD; i++) {
            if digits[i] < RADIX {
                let slot = digits[i] % ROWS * WORKGROUP_SIZE + thread;
                let shift = digits[i] / ROWS * HALF_WORD_BITS;
                let in_digit = (counts[slot] >> shift) & ((1u << HALF_WORD_BITS) - 1u);
                order_out[digit_starts[digits[i]] + in_digit] = items[i];
                counts[slot] += 1u << shift;
            }
        }
        workgroupBarrier();
    }
}
