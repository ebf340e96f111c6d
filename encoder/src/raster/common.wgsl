// Definitions shared by all stages. `real` is f64 if the device supports it, else f32.

struct View {
    // Rotation from world to camera, row-major.
    rotation: array<real, 9>,
    // Camera position relative to the origin of the scene, split into high and low parts.
    position_high: array<real, 3>,
    position_low: array<real, 3>,
    focal_x_px: real,
    focal_y_px: real,
    centre_x_px: real,
    centre_y_px: real,
    width_px: u32,
    height_px: u32,
    // Rows of tiles of the band: `first_tile_row..end_tile_row`.
    first_tile_row: u32,
    end_tile_row: u32,
    // Tiles per row.
    tile_columns: u32,
    capacity_visible: u32,
    capacity_pairs: u32,
    capacity_entries: u32,
}

// Twin of ScreenGaussian.
struct Screen {
    mean_x_px: real,
    mean_y_px: real,
    inv_width: real,
    slope: real,
    inv_height: real,
    // Bits of the camera z as f32; z is positive, so they have the same order.
    depth: u32,
    opacity: f32,
    reach2: f32,
    gaussian: u32,
}

struct PixelSpan {
    first: u32,
    last: u32,
    is_some: bool,
}

fn pixels_within(low: real, high: real, size_px: u32) -> PixelSpan {
    let first = max(ceil(low - HALF), ZERO);
    let last = min(floor(high - HALF), real(size_px) - ONE);
    if !(first <= last) {
        return PixelSpan(0u, 0u, false);
    }
    return PixelSpan(u32(first), u32(last), true);
}

fn extent_px(g: Screen) -> array<real, 2> {
    let cov_yy = ONE / (g.inv_height * g.inv_height);
    let cov_xx = ONE / (g.inv_width * g.inv_width) + g.slope * g.slope * cov_yy;
    let reach2 = real(g.reach2);
    return array<real, 2>(sqrt(reach2 * cov_xx), sqrt(reach2 * cov_yy));
}

// Returns the rows of tiles that the footprint touches in the whole image.
fn tile_rows(g: Screen, height_px: u32) -> PixelSpan {
    let extent = sqrt(real(g.reach2)) / g.inv_height;
    let rows = pixels_within(g.mean_y_px - extent, g.mean_y_px + extent, height_px);
    return PixelSpan(rows.first / TILE_SIZE_PX, rows.last / TILE_SIZE_PX, rows.is_some);
}

// Twin of `Footprint::columns` in bin.rs: returns the columns of tiles that the footprint touches in a row of tiles.
fn tile_columns(g: Screen, extent: array<real, 2>, row: u32, width_px: u32, height_px: u32) -> PixelSpan {
    let reach2 = real(g.reach2);
    let top_px = row * TILE_SIZE_PX;
    let bottom_px = min(top_px + TILE_SIZE_PX, height_px) - 1u;
    let first = max(real(top_px) + HALF - g.mean_y_px, -extent[1]);
    let last = min(real(bottom_px) + HALF - g.mean_y_px, extent[1]);
    let y_of_rightmost = g.slope / (g.inv_height * g.inv_height) * reach2 / extent[0];
    let y_right = min(max(y_of_rightmost, first), last);
    let y_left = min(max(-y_of_rightmost, first), last);
    let v_right = y_right * g.inv_height;
    let v_left = y_left * g.inv_height;
    let half_right = sqrt(max(reach2 - v_right * v_right, ZERO)) / g.inv_width;
    let half_left = sqrt(max(reach2 - v_left * v_left, ZERO)) / g.inv_width;
    let low = g.mean_x_px + g.slope * y_left - half_left;
    let high = g.mean_x_px + g.slope * y_right + half_right;
    let columns = pixels_within(low, high, width_px);
    return PixelSpan(columns.first / TILE_SIZE_PX, columns.last / TILE_SIZE_PX, columns.is_some);
}

// A Gaussian relative to a tile.
struct InTile {
    u0: f32,
    u_x: f32,
    u_y: f32,
    v0: f32,
    v_y: f32,
    opacity: f32,
    reach2: f32,
    member: u32,
}

fn in_tile(g: Screen, member: u32, x_px: u32, y_px: u32) -> InTile {
    let dx = real(x_px) + HALF - g.mean_x_px;
    let dy = real(y_px) + HALF - g.mean_y_px;
    return InTile(
        f32(g.inv_width * (dx - g.slope * dy)),
        f32(g.inv_width),
        f32(-g.inv_width * g.slope),
        f32(g.inv_height * dy),
        f32(g.inv_height),
        g.opacity,
        g.reach2,
        member,
    );
}

struct Pair {
    // Row-major index within the band.
    tile: u32,
    // Index into the visible Gaussians.
    member: u32,
}

struct Range {
    start: u32,
    end: u32,
}

// Contribution of a Gaussian to a region within one tile, in units of 2^-SUM_FRACTION_BITS.
struct Entry {
    member: u32,
    region: u32,
    low: u32,
    high: u32,
}

// Prefix sum within a workgroup, which gives every stage the positions of its output.
var<workgroup> block_values: array<u32, WORKGROUP_SIZE>;

// Adds counts. Beyond the largest number they stay there: no buffer holds so many, and a count that wraps would look as if it
// fitted.
fn saturating_sum(a: u32, b: u32) -> u32 {
    return select(a + b, 0xffffffffu, b > 0xffffffffu - a);
}

// Returns the sum of the values of all lower threads (Hillis and Steele 1986).
fn block_scan(value: u32, thread: u32) -> u32 {
    block_values[thread] = value;
    workgroupBarrier();
    for (var step = 1u; step < WORKGROUP_SIZE; step *= 2u) {
        var sum = block_values[thread];
        if thread >= step {
            sum = saturating_sum(sum, block_values[thread - step]);
        }
        workgroupBarrier();
        block_values[thread] = sum;
        workgroupBarrier();
    }
    let before = select(0u, block_values[max(thread, 1u) - 1u], thread > 0u);
    workgroupBarrier();
    return before;
}
