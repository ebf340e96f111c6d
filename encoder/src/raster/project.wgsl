// Twin of project.rs: projects Gaussians to ellipses on the screen.

// Four vectors each: high part of the mean and opacity, low part of the mean and squared reach, rotation wxyz,
// scales and padding. An opacity of 0 marks Gaussians that cannot be drawn.
struct SceneGaussian {
    mean_high: vec3<f32>,
    opacity: f32,
    mean_low: vec3<f32>,
    reach2: f32,
    rotation_wxyz: vec4<f32>,
    scales: vec3<f32>,
    padding: u32,
}

struct Chunk {
    first_gaussian: u32,
    n_gaussians: u32,
}

@group(0) @binding(0) var<storage, read> view: View;
@group(0) @binding(1) var<storage, read_write> counters: array<atomic<u32>, N_COUNTERS>;
@group(0) @binding(2) var<storage, read> chunk: Chunk;
@group(0) @binding(3) var<storage, read> gaussians: array<SceneGaussian>;
@group(0) @binding(4) var<storage, read_write> block_counts: array<u32>;
@group(0) @binding(5) var<storage, read_write> screen: array<Screen>;
@group(0) @binding(6) var<storage, read_write> tile_counts: array<u32>;

const CULLED = 0u;
const VISIBLE = 1u;
const UNREPRESENTABLE = 2u;

struct Projected {
    status: u32,
    first_tile_row: u32,
    on_screen: Screen,
}

fn dot3(a: real3, b: real3) -> real {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

fn is_coordinate(value: real) -> bool {
    return abs(value) <= real(MAX_COORDINATE_PX);
}

fn limited(tangent: real, focal: real, centre: real, size: real) -> real {
    let margin = real(FOV_MARGIN) * HALF * size / focal;
    return min(max(tangent, -centre / focal - margin), (size - centre) / focal + margin);
}

fn project(index: u32) -> Projected {
    var result: Projected;
    result.status = CULLED;
    let g = gaussians[index];
    if g.opacity < MIN_ALPHA {
        return result;
    }
    // Subtracts high parts first. Their difference is exact near the camera, so scenes far from the origin
    // keep their accuracy in f32 as well.
    let from_camera = real3(
        (real(g.mean_high.x) - view.position_high[0]) + (real(g.mean_low.x) - view.position_low[0]),
        (real(g.mean_high.y) - view.position_high[1]) + (real(g.mean_low.y) - view.position_low[1]),
        (real(g.mean_high.z) - view.position_high[2]) + (real(g.mean_low.z) - view.position_low[2]),
    );
    let r_x = real3(view.rotation[0], view.rotation[1], view.rotation[2]);
    let r_y = real3(view.rotation[3], view.rotation[4], view.rotation[5]);
    let r_z = real3(view.rotation[6], view.rotation[7], view.rotation[8]);
    let z = dot3(r_z, from_camera);
    if !(z >= real(NEAR_Z) && z <= real(FAR_Z)) {
        return result;
    }
    let ratio_x = dot3(r_x, from_camera) / z;
    let ratio_y = dot3(r_y, from_camera) / z;
    let mean_x = view.focal_x_px * ratio_x + view.centre_x_px;
    let mean_y = view.focal_y_px * ratio_y + view.centre_y_px;
    let width = real(view.width_px);
    let height = real(view.height_px);
    let tan_x = limited(ratio_x, view.focal_x_px, view.centre_x_px, width);
    let tan_y = limited(ratio_y, view.focal_y_px, view.centre_y_px, height);
    let scale_x = view.focal_x_px / z;
    let scale_y = view.focal_y_px / z;
    let blur = real(COVARIANCE_BLUR_PX2);

    // A standard deviation on the screen is at most the largest scale times the norm of the Jacobian's row.
    // Footprints outside the image by this bound need no covariance. The bound is widened by half, so rounding
    // does not matter.
    let size = real(max(max(g.scales.x, g.scales.y), g.scales.z));
    let spread = real(g.reach2) * real(2.25);
    let most_x = scale_x * scale_x * (ONE + tan_x * tan_x) * size * size + blur;
    let most_y = scale_y * scale_y * (ONE + tan_y * tan_y) * size * size + blur;
    let beyond_x = max(max(-mean_x, mean_x - width), ZERO);
    let beyond_y = max(max(-mean_y, mean_y - height), ZERO);
    let is_far_out = beyond_x * beyond_x > most_x * spread || beyond_y * beyond_y > most_y * spread;
    let limit = real(MAX_VARIANCE_PX2);
    // Gaussians out of range are counted even outside the image.
    if is_far_out && most_x < limit && most_y < limit && is_coordinate(mean_x) && is_coordinate(mean_y) {
        return result;
    }

    // Rows of the axes of the Gaussian in the camera frame, times scales; then their products with the
    // Jacobian's rows.
    let q = real4(
        real(g.rotation_wxyz.x),
        real(g.rotation_wxyz.y),
        real(g.rotation_wxyz.z),
        real(g.rotation_wxyz.w),
    );
    let unit = TWO / (q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w);
    let xx = q.y * q.y * unit;
    let yy = q.z * q.z * unit;
    let zz = q.w * q.w * unit;
    let xy = q.y * q.z * unit;
    let xz = q.y * q.w * unit;
    let yz = q.z * q.w * unit;
    let wx = q.x * q.y * unit;
    let wy = q.x * q.z * unit;
    let wz = q.x * q.w * unit;
    let j_x = (r_x - r_z * tan_x) * scale_x;
    let j_y = (r_y - r_z * tan_y) * scale_y;
    let axis_0 = real3(ONE - yy - zz, xy + wz, xz - wy) * real(g.scales.x);
    let axis_1 = real3(xy - wz, ONE - xx - zz, yz + wx) * real(g.scales.y);
    let axis_2 = real3(xz + wy, yz - wx, ONE - xx - yy) * real(g.scales.z);
    let m_x = real3(dot3(j_x, axis_0), dot3(j_x, axis_1), dot3(j_x, axis_2));
    let m_y = real3(dot3(j_y, axis_0), dot3(j_y, axis_1), dot3(j_y, axis_2));
    let cov_xx = dot3(m_x, m_x) + blur;
    let cov_yy = dot3(m_y, m_y) + blur;
    let cov_xy = dot3(m_x, m_y);
    if !(cov_xx <= limit && cov_yy <= limit && is_coordinate(mean_x) && is_coordinate(mean_y)) {
        result.status = UNREPRESENTABLE;
        return result;
    }
    // Lagrange's identity is accurate for needles, and positive.
    let c = real3(
        m_x.y * m_y.z - m_x.z * m_y.y,
        m_x.z * m_y.x - m_x.x * m_y.z,
        m_x.x * m_y.y - m_x.y * m_y.x,
    );
    let det = dot3(c, c) + blur * (cov_xx + cov_yy) - blur * blur;
    var s: Screen;
    s.mean_x_px = mean_x;
    s.mean_y_px = mean_y;
    s.inv_width = sqrt(cov_yy / det);
    s.slope = cov_xy / cov_yy;
    s.inv_height = ONE / sqrt(cov_yy);
    s.depth = bitcast<u32>(f32(z));
    s.opacity = g.opacity;
    s.reach2 = g.reach2;
    s.gaussian = chunk.first_gaussian + index;
    let extent = extent_px(s);
    let columns = pixels_within(mean_x - extent[0], mean_x + extent[0], view.width_px);
    let rows = tile_rows(s, view.height_px);
    if columns.is_some && rows.is_some && rows.first < view.end_tile_row && rows.last >= view.first_tile_row {
        result.status = VISIBLE;
        result.first_tile_row = rows.first;
    }
    result.on_screen = s;
    return result;
}

// Counts the visible Gaussians of each block of the chunk, and the Gaussians out of range.
@compute @workgroup_size(WORKGROUP_SIZE)
fn count_visible(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let index = group.x * WORKGROUP_SIZE + thread;
    // Bands are processed one after another; each Gaussian is counted in its first band.
    let is_first_band = view.first_tile_row == 0u;
    var is_visible = 0u;
    var is_new = 0u;
    if index < chunk.n_gaussians {
        let p = project(index);
        is_visible = u32(p.status == VISIBLE);
        is_new = u32(p.status == VISIBLE && (is_first_band || p.first_tile_row >= view.first_tile_row));
        // Rare, so each thread increments the counter itself.
        if p.status == UNREPRESENTABLE && is_first_band {
            atomicAdd(&counters[COUNTER_UNREPRESENTABLE], 1u);
        }
    }
    // Packs two sums in one word: each is at most the size of the workgroup.
    let packed = is_visible | (is_new << 16u);
    let sums = block_scan(packed, thread) + packed;
    if thread == WORKGROUP_SIZE - 1u {
        block_counts[group.x] = sums & 0xffffu;
        atomicAdd(&counters[COUNTER_FIRST_VISIBLE], sums >> 16u);
    }
}

// Writes the visible Gaussians in scene order, and the number of tiles that each touches.
@compute @workgroup_size(WORKGROUP_SIZE)
fn write_visible(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let index = group.x * WORKGROUP_SIZE + thread;
    var p: Projected;
    if index < chunk.n_gaussians {
        p = project(index);
    }
    let is_visible = u32(p.status == VISIBLE);
    let at = block_counts[group.x] + block_scan(is_visible, thread);
    if is_visible == 0u || at >= view.capacity_visible {
        return;
    }
    let extent = extent_px(p.on_screen);
    let rows = tile_rows(p.on_screen, view.height_px);
    let end = min(rows.last + 1u, view.end_tile_row);
    var n_tiles = 0u;
    for (var row = max(rows.first, view.first_tile_row); row < end; row++) {
        let columns = tile_columns(p.on_screen, extent, row, view.width_px, view.height_px);
        n_tiles += select(0u, columns.last - columns.first + 1u, columns.is_some);
    }
    screen[at] = p.on_screen;
    tile_counts[at] = n_tiles;
}
