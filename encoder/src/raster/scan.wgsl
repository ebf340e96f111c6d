// Prefix sums over an array, which give every stage the positions of its output.

struct ScanJob {
    // The array has `ceil(n / block) * columns` values, where n is counters[items], at most n_most.
    items: u32,
    n_most: u32,
    block: u32,
    columns: u32,
    // Counter that the scan starts from and adds the total to, if there is one.
    total: u32,
}

@group(0) @binding(0) var<storage, read> job: ScanJob;
@group(0) @binding(1) var<storage, read_write> counters: array<u32, N_COUNTERS>;
@group(0) @binding(2) var<storage, read_write> values: array<u32>;
@group(0) @binding(3) var<storage, read_write> dispatches: array<u32>;

const PER_THREAD = 8u;
var<workgroup> length: u32;

// Replaces each value by the sum of all values before it. One workgroup processes the array.
@compute @workgroup_size(WORKGROUP_SIZE)
fn scan(@builtin(local_invocation_index) thread: u32) {
    if thread == 0u {
        // A counter may exceed the capacity; values beyond the capacity were never written.
        var n = job.n_most;
        if job.items != NONE {
            n = min(n, counters[job.items]);
        }
        length = min((n + job.block - 1u) / job.block * job.columns, arrayLength(&values));
    }
    let n = workgroupUniformLoad(&length);
    var carry = 0u;
    if job.total != NONE {
        carry = counters[job.total];
    }
    for (var start = 0u; start < n; start += WORKGROUP_SIZE * PER_THREAD) {
        var own: array<u32, PER_THREAD>;
        var sum = 0u;
        for (var i = 0u; i < PER_THREAD; i++) {
            let at = start + thread * PER_THREAD + i;
            own[i] = sum;
            if at < n {
                sum = saturating_sum(sum, values[at]);
            }
        }
        let before = saturating_sum(carry, block_scan(sum, thread));
        for (var i = 0u; i < PER_THREAD; i++) {
            let at = start + thread * PER_THREAD + i;
            if at < n {
                values[at] = saturating_sum(before, own[i]);
            }
        }
        if thread == WORKGROUP_SIZE - 1u {
            length = saturating_sum(before, sum);
        }
        carry = workgroupUniformLoad(&length);
    }
    // All threads have read the old total before it is replaced.
    workgroupBarrier();
    if thread == 0u && job.total != NONE {
        counters[job.total] = carry;
        for (var kind = 0u; kind < 2u; kind++) {
            let block = select(WORKGROUP_SIZE, SORT_BLOCK, kind == 1u);
            let at = (job.total * 2u + kind) * 4u;
            // Kernels use a stride for items beyond the largest dispatch.
            dispatches[at] = min(carry / block + u32(carry % block > 0u), MAX_DISPATCH);
            dispatches[at + 1u] = 1u;
            dispatches[at + 2u] = 1u;
        }
    }
}
