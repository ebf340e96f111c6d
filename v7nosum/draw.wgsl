// Twin of draw.rs: draws colour, depth and coverage. A workgroup processes a tile, a thread a pixel.

struct Background {
    rgb: vec3<f32>,
    padding: u32,
}

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read> background: Background;
@group(0) @binding(2) var<storage, read> screen: array<Screen>;
@group(0) @binding(3) var<storage, read> members: array<u32>;
@group(0) @binding(4) var<storage, read> ranges: array<Range>;
// Three values per Gaussian of the scene.
@group(0) @binding(5) var<storage, read> colours: array<f32>;
// Red, green, blue, depth, coverage; row-major, within the band.
@group(0) @binding(6) var<storage, read_write> pixels: array<f32>;

const LOAD = 64u;

struct Painted {
    shape: InTile,
    rgb: vec3<f32>,
    depth: f32,
}

var<workgroup> gaussians: array<Painted, LOAD>;
var<workgroup> range_shared: vec2<u32>;
var<workgroup> n_live: atomic<u32>;
var<workgroup> n_live_shared: u32;

@compute @workgroup_size(WORKGROUP_SIZE)
fn draw(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let x_px = group.x * TILE_SIZE_PX;
    let y_px = (view.first_tile_row + group.y) * TILE_SIZE_PX;
    let local_x = thread % TILE_SIZE_PX;
    let local_y = thread / TILE_SIZE_PX;
    let is_inside = x_px + local_x < view.width_px && y_px + local_y < view.height_px;
    if thread == 0u {
        let range = ranges[group.y * view.tile_columns + group.x];
        range_shared = vec2<u32>(range.start, min(range.end, view.capacity_pairs));
        atomicStore(&n_live, 0u);
    }
    let range = workgroupUniformLoad(&range_shared);
    var is_live = is_inside;
    if is_live {
        atomicAdd(&n_live, 1u);
    }
    var transmittance = 1.0;
    var rgb = vec3<f32>(0.0);
    var depth = 0.0;
    var total = 0.0;
    for (var start = range.x; start < range.y; start += LOAD) {
        // All threads have finished the previous batch.
        workgroupBarrier();
        if thread < LOAD && start + thread < range.y {
            let member = members[start + thread];
            let g = screen[member];
            let at = g.gaussian * 3u;
            gaussians[thread] = Painted(
                in_tile(g, member, x_px, y_px),
                vec3<f32>(colours[at], colours[at + 1u], colours[at + 2u]),
                bitcast<f32>(g.depth),
            );
        }
        if thread == 0u {
            n_live_shared = atomicLoad(&n_live);
        }
        if workgroupUniformLoad(&n_live_shared) == 0u {
            break;
        }
        let n_loaded = min(LOAD, range.y - start);
        for (var i = 0u; i < n_loaded && is_live; i++) {
            let g = gaussians[i].shape;
            let u = g.u0 + g.u_y * f32(local_y) + g.u_x * f32(local_x);
            let v = g.v0 + g.v_y * f32(local_y);
            if u * u + v * v <= g.reach2 {
                let alpha = min(g.opacity * exp_of_minus(0.5 * u * u + 0.5 * v * v), MAX_ALPHA);
                let next = transmittance * (1.0 - alpha);
                if alpha < MIN_ALPHA {
                    // The alpha is too small.
                } else if next > MIN_TRANSMITTANCE {
                    let weight = alpha * transmittance;
                    rgb += weight * gaussians[i].rgb;
                    depth += weight * gaussians[i].depth;
                    total += weight;
                    transmittance = next;
                } else {
                    is_live = false;
                    atomicSub(&n_live, 1u);
                }
            }
        }
    }
    if is_inside {
        rgb += transmittance * background.rgb;
        let at = ((group.y * TILE_SIZE_PX + local_y) * view.width_px + x_px + local_x) * 5u;
        pixels[at] = rgb.x;
        pixels[at + 1u] = rgb.y;
        pixels[at + 2u] = rgb.z;
        pixels[at + 3u] = select(0.0, depth / max(total, 1e-30), total > 0.0);
        pixels[at + 4u] = 1.0 - transmittance;
    }
}
