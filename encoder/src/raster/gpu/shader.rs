//! The shaders: their source with a prelude of constants and precision, and their pipelines.

use std::borrow::Cow;
use std::fmt::Write;

use slag_raster::constants::{
    COVARIANCE_BLUR_PX2, FAR_Z, FOV_MARGIN, MAX_ALPHA, MAX_VARIANCE_PX2, MIN_ALPHA, MIN_TRANSMITTANCE,
    NEAR_Z, TILE_SIZE_PX,
};
use slag_raster::{EXP_OF_MINUS_C, MAX_POWER};

use crate::raster::Precision;

/// Equal to the pixels of a tile.
pub(crate) const WORKGROUP_SIZE: u32 = (TILE_SIZE_PX * TILE_SIZE_PX) as u32;
/// Items that a workgroup sorts at once.
pub(crate) const SORT_BLOCK: u32 = 2048;
/// Digits of a sort pass.
pub(crate) const RADIX: u32 = 32;
/// Most workgroups of a dispatch that every device supports.
pub(crate) const MAX_DISPATCH: u32 = 65_535;
/// Of fixed-point weights; with the 2^28 pixels of the largest image, sums need 63 bits.
pub const SUM_FRACTION_BITS: u32 = 35;
/// Bits of a region number: two share a word, and so do a region and a pixel of its tile.
pub(crate) const REGION_BITS: u32 = 16;
/// Most items of a buffer: larger counts do not fit, and stay far below 2^32.
pub(crate) const MAX_CAPACITY: u32 = 1 << 31;
pub const NONE: u32 = u32::MAX;

/// Incremented by shaders; the host reads them after each band.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub(crate) enum Counter {
    Visible,
    /// Visible Gaussians that no earlier band has shown.
    FirstVisible,
    /// Gaussians with a projection out of range.
    Unrepresentable,
    Pairs,
    /// Per tile, Gaussian and region.
    Entries,
    /// Per Gaussian and region.
    RegionSums,
}

impl Counter {
    /// All counters by value, with their names in the shaders.
    pub const ALL: [(Self, &'static str); 6] = [
        (Self::Visible, "VISIBLE"),
        (Self::FirstVisible, "FIRST_VISIBLE"),
        (Self::Unrepresentable, "UNREPRESENTABLE"),
        (Self::Pairs, "PAIRS"),
        (Self::Entries, "ENTRIES"),
        (Self::RegionSums, "REGION_SUMS"),
    ];
}

pub(crate) type Counts = [u32; Counter::ALL.len()];

/// Without the common part.
pub(crate) const STAGES: [(&str, &str); 7] = [
    ("project", include_str!("../project.wgsl")),
    ("scan", include_str!("../scan.wgsl")),
    ("sort", include_str!("../sort.wgsl")),
    ("bin", include_str!("../bin.wgsl")),
    ("blend", include_str!("../blend.wgsl")),
    ("compact", include_str!("../compact.wgsl")),
    ("draw", include_str!("../draw.wgsl")),
];
const COMMON: &str = include_str!("../common.wgsl");

pub(crate) fn module_text(stage: &str, precision: Precision) -> String {
    let mut text = String::new();
    let real = match precision {
        Precision::F64 => "f64",
        Precision::F32 => "f32",
    };
    // Beyond these limits, squares overflow in f32.
    let (max_variance, max_coordinate) = match precision {
        Precision::F64 => (MAX_VARIANCE_PX2, f64::MAX),
        Precision::F32 => (1e18, 1e18),
    };
    let _ = writeln!(text, "alias real = {real};\nalias real3 = vec3<{real}>;\nalias real4 = vec4<{real}>;");
    for (name, value) in [("ZERO", 0.0), ("HALF", 0.5), ("ONE", 1.0), ("TWO", 2.0)] {
        let _ = writeln!(text, "const {name}: real = real({value:?});");
    }
    for (name, value) in [
        ("NEAR_Z", NEAR_Z),
        ("FAR_Z", FAR_Z),
        ("FOV_MARGIN", FOV_MARGIN),
        ("COVARIANCE_BLUR_PX2", COVARIANCE_BLUR_PX2),
        ("MAX_VARIANCE_PX2", max_variance),
        ("MAX_COORDINATE_PX", max_coordinate),
    ] {
        let _ = writeln!(text, "const {name}: real = real({value:e});");
    }
    for (name, value) in [
        ("MIN_ALPHA", MIN_ALPHA),
        ("MAX_ALPHA", MAX_ALPHA),
        ("MIN_TRANSMITTANCE", MIN_TRANSMITTANCE),
        ("MAX_POWER", MAX_POWER),
        ("UPPER_SCALE", (1u32 << (SUM_FRACTION_BITS - 32)) as f32),
    ] {
        let _ = writeln!(text, "const {name}: f32 = {value:e}f;");
    }
    for (name, value) in [
        ("TILE_SIZE_PX", TILE_SIZE_PX as u32),
        ("WORKGROUP_SIZE", WORKGROUP_SIZE),
        ("SORT_BLOCK", SORT_BLOCK),
        ("RADIX", RADIX),
        ("MAX_DISPATCH", MAX_DISPATCH),
        ("MAX_CAPACITY", MAX_CAPACITY),
        ("N_COUNTERS", Counter::ALL.len() as u32),
        ("NONE", NONE),
        ("REGION_BITS", REGION_BITS),
    ] {
        let _ = writeln!(text, "const {name}: u32 = {value}u;");
    }
    for (counter, name) in Counter::ALL {
        let _ = writeln!(text, "const COUNTER_{name}: u32 = {}u;", counter as u32);
    }
    text.push_str(&exp_of_minus());
    text.push_str(COMMON);
    text.push_str(STAGES.iter().find(|s| s.0 == stage).map_or("", |s| s.1));
    text
}

/// Horner's scheme unrolled, because an array of constants would be indexed in memory.
fn exp_of_minus() -> String {
    let mut text = String::new();
    let [first @ .., last] = EXP_OF_MINUS_C;
    let _ = writeln!(text, "fn exp_of_minus(power: f32) -> f32 {{");
    let _ = writeln!(text, "    let t = MAX_POWER / 8.0 - min(power, MAX_POWER) * 0.25;");
    let _ = writeln!(text, "    var root = {last:e}f;");
    for c in first.iter().rev() {
        let _ = writeln!(text, "    root = root * t + {c:e}f;");
    }
    let _ = writeln!(text, "    let square = root * root;\n    return square * square;\n}}");
    text
}

pub(crate) struct Kernels {
    pub(crate) count_visible: wgpu::ComputePipeline,
    pub(crate) write_visible: wgpu::ComputePipeline,
    pub scan: wgpu::ComputePipeline,
    pub(crate) count_digits: wgpu::ComputePipeline,
    pub(crate) scatter: wgpu::ComputePipeline,
    pub(crate) count_pairs: wgpu::ComputePipeline,
    pub(crate) write_pairs: wgpu::ComputePipeline,
    pub(crate) find_ranges: wgpu::ComputePipeline,
    pub(crate) order_tiles: wgpu::ComputePipeline,
    pub(crate) sum_regions: wgpu::ComputePipeline,
    pub(crate) count_heads: wgpu::ComputePipeline,
    pub(crate) add_up: wgpu::ComputePipeline,
    pub draw: wgpu::ComputePipeline,
}

impl Kernels {
    pub fn new(device: &wgpu::Device, precision: Precision) -> Self {
        let kernel = |stage: &str, entry: &str| {
            let descriptor = wgpu::ShaderModuleDescriptor {
                label: Some(stage),
                source: wgpu::ShaderSource::Wgsl(Cow::Owned(module_text(stage, precision))),
            };
            let mut checks = wgpu::ShaderRuntimeChecks::checked();
            checks.force_loop_bounding = false;
            #[expect(
                unsafe_code,
                reason = "wgpu counts the turns of every loop, which takes a seventh of the time"
            )]
            // SAFETY: the caller must pass no loop without an end. The sources are constants of this program, and
            // their loops count up to bounds that they read once (`loops_count_up`). All accesses are still
            // checked.
            let module = unsafe { device.create_shader_module_trusted(descriptor, checks) };
            device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(entry),
                layout: None,
                module: &module,
                entry_point: Some(entry),
                compilation_options: wgpu::PipelineCompilationOptions {
                    constants: &[],
                    // All shaders write workgroup memory before they read it.
                    zero_initialize_workgroup_memory: false,
                },
                cache: None,
            })
        };
        Self {
            count_visible: kernel("project", "count_visible"),
            write_visible: kernel("project", "write_visible"),
            scan: kernel("scan", "scan"),
            count_digits: kernel("sort", "count_digits"),
            scatter: kernel("sort", "scatter"),
            count_pairs: kernel("bin", "count_pairs"),
            write_pairs: kernel("bin", "write_pairs"),
            find_ranges: kernel("bin", "find_ranges"),
            order_tiles: kernel("bin", "order_tiles"),
            sum_regions: kernel("blend", "sum_regions"),
            count_heads: kernel("compact", "count_heads"),
            add_up: kernel("compact", "add_up"),
            draw: kernel("draw", "draw"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every loop runs over a variable that grows by a constant, or by a number that cannot be zero.
    #[test]
    fn loops_count_up() {
        let steps = ["++", "+= 1u", "*= 2u", "/= 2u", "+= STEP", "+= LOAD", "+= WORKGROUP_SIZE"];
        // At least one workgroup runs; rounds hold at least a step.
        let counted =
            ["+= groups.x", "+= groups.x * WORKGROUP_SIZE", "+= WORKGROUP_SIZE * PER_THREAD", "+= per_round"];
        for (stage, text) in STAGES.into_iter().chain([("common", COMMON)]) {
            for line in text.lines().map(str::trim).filter(|line| !line.starts_with("//")) {
                assert!(!line.contains("while") && !line.starts_with("loop"), "{stage}: {line}");
                let Some(rest) = line.strip_prefix("for (var ") else { continue };
                let clauses: Vec<&str> = rest.trim_end_matches(") {").split("; ").collect();
                let [start, _, step] = clauses[..] else { panic!("{stage}: {line}") };
                let variable = start.split(' ').next().expect("a name");
                let step = step.strip_prefix(variable).expect("the same variable").trim();
                assert!(steps.contains(&step) || counted.contains(&step), "{stage}: {line}");
            }
        }
    }

    #[test]
    fn shaders_are_valid_in_both_precisions() {
        for precision in [Precision::F64, Precision::F32] {
            for (stage, _) in STAGES {
                let text = module_text(stage, precision);
                let module = naga::front::wgsl::parse_str(&text)
                    .unwrap_or_else(|e| panic!("{stage}: {}", e.emit_to_string(&text)));
                let mut validator = naga::valid::Validator::new(
                    naga::valid::ValidationFlags::all(),
                    naga::valid::Capabilities::FLOAT64,
                );
                if let Err(error) = validator.validate(&module) {
                    panic!("{stage} {precision:?}: {}", error.emit_to_string(&text));
                }
            }
        }
    }
}
