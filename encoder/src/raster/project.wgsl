// Twin of project.rs: Gaussians to ellipses on the screen.

// Four vectors each: mean high part and opacity, mean low part and squared reach, rotation wxyz,
// scales and padding. An opacity of 0 marks what cannot be drawn.
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
    // High parts first: their difference is exact where it matters, so a scene far from its origin
    // keeps its accuracy in f32 too.
    var d: array<real, 3>;
    for (var c = 0u; c < 3u; c++) {
        d[c] = (real(g.mean_high[c]) - view.position_high[c]) + (real(g.mean_low[c]) - view.position_low[c]);
    }
    let r = view.rotation;
    let x = r[0] * d[0] + r[1] * d[1] + r[2] * d[2];
    let y = r[3] * d[0] + r[4] * d[1] + r[5] * d[2];
    let z = r[6] * d[0] + r[7] * d[1] + r[8] * d[2];
    if !(z >= real(NEAR_Z) && z <= real(FAR_Z)) {
        return result;
    }
    let mean_x = view.focal_x_px * x / z + view.centre_x_px;
    let mean_y = view.focal_y_px * y / z + view.centre_y_px;
    let tan_x = limited(x / z, view.focal_x_px, view.centre_x_px, real(view.width_px));
    let tan_y = limited(y / z, view.focal_y_px, view.centre_y_px, real(view.height_px));
    let scale_x = view.focal_x_px / z;
    let scale_y = view.focal_y_px / z;

    // Columns of camera-from-Gaussian's axes, times scales; then the Jacobian's two rows on them.
    var qw = real(g.rotation_wxyz[0]);
    var qx = real(g.rotation_wxyz[1]);
    var qy = real(g.rotation_wxyz[2]);
    var qz = real(g.rotation_wxyz[3]);
    let norm = sqrt(qw * qw + qx * qx + qy * qy + qz * qz);
    qw /= norm;
    qx /= norm;
    qy /= norm;
    qz /= norm;
    let m = array<real, 9>(
        ONE - TWO * (qy * qy + qz * qz), TWO * (qx * qy - qw * qz), TWO * (qx * qz + qw * qy),
        TWO * (qx * qy + qw * qz), ONE - TWO * (qx * qx + qz * qz), TWO * (qy * qz - qw * qx),
        TWO * (qx * qz - qw * qy), TWO * (qy * qz + qw * qx), ONE - TWO * (qx * qx + qy * qy),
    );
    var m_x: array<real, 3>;
    var m_y: array<real, 3>;
    for (var c = 0u; c < 3u; c++) {
        let s = real(g.scales[c]);
        let a_x = (r[0] * m[c] + r[1] * m[c + 3u] + r[2] * m[c + 6u]) * s;
        let a_y = (r[3] * m[c] + r[4] * m[c + 3u] + r[5] * m[c + 6u]) * s;
        let a_z = (r[6] * m[c] + r[7] * m[c + 3u] + r[8] * m[c + 6u]) * s;
        m_x[c] = scale_x * (a_x - tan_x * a_z);
        m_y[c] = scale_y * (a_y - tan_y * a_z);
    }
    let blur = real(COVARIANCE_BLUR_PX2);
    let cov_xx = m_x[0] * m_x[0] + m_x[1] * m_x[1] + m_x[2] * m_x[2] + blur;
    let cov_yy = m_y[0] * m_y[0] + m_y[1] * m_y[1] + m_y[2] * m_y[2] + blur;
    let cov_xy = m_x[0] * m_y[0] + m_x[1] * m_y[1] + m_x[2] * m_y[2];
    let limit = real(MAX_VARIANCE_PX2);
    if !(cov_xx <= limit && cov_yy <= limit && abs(mean_x) <= real(MAX_COORDINATE_PX) && abs(mean_y) <= real(MAX_COORDINATE_PX)) {
        result.status = UNREPRESENTABLE;
        return result;
    }
    // Lagrange's identity: exact for needles, and above 0.
    let c_x = m_x[1] * m_y[2] - m_x[2] * m_y[1];
    let c_y = m_x[2] * m_y[0] - m_x[0] * m_y[2];
    let c_z = m_x[0] * m_y[1] - m_x[1] * m_y[0];
    let det = c_x * c_x + c_y * c_y + c_z * c_z + blur * (cov_xx + cov_yy) - blur * blur;
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

// Counts the visible Gaussians of each block of the chunk, and what cannot be represented.
@compute @workgroup_size(WORKGROUP_SIZE)
fn count_visible(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let index = group.x * WORKGROUP_SIZE + thread;
    var is_visible = 0u;
    if index < chunk.n_gaussians {
        let p = project(index);
        is_visible = u32(p.status == VISIBLE);
        // Bands of tile rows work one after another: each Gaussian is counted in the first that it is in.
        if p.status == VISIBLE && (p.first_tile_row >= view.first_tile_row || view.first_tile_row == 0u) {
            atomicAdd(&counters[COUNTER_FIRST_VISIBLE], 1u);
        }
        if p.status == UNREPRESENTABLE && view.first_tile_row == 0u {
            atomicAdd(&counters[COUNTER_UNREPRESENTABLE], 1u);
        }
    }
    let before = block_scan(is_visible, thread);
    if thread == WORKGROUP_SIZE - 1u {
        block_counts[group.x] = before + is_visible;
    }
}

// Writes the visible Gaussians in the scene's order, and how many tiles each touches.
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
