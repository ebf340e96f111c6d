//! One function for each decoder of foreign bytes, which must return for any bytes.
//!
//! `scripts/fuzz.sh` runs them guided by coverage (`fuzz_targets/`), the workspace's tests with seeded mutations
//! (`tests/fuzz.rs`). Checksums and signatures are corrected first, because no mutation would pass them.

#[path = "formats.rs"]
mod formats;
#[path = "repository.rs"]
mod repository;
#[path = "seeds.rs"]
pub mod seeds;
#[path = "services.rs"]
mod services;

pub struct Target {
    pub name: &'static str,
    /// Decodes the bytes and returns whether they were accepted, without panics or memory out of proportion.
    pub run: fn(&[u8]) -> bool,
}

macro_rules! targets {
    ($($module:ident: $($name:ident),+;)+) => {
        pub const TARGETS: &[Target] =
            &[$($(Target { name: stringify!($name), run: $module::$name }),+),+];
    };
}

targets! {
    formats: container, shard, manifest, current, ply, splat, spz, sog, sog_folder, colmap_text, colmap_bin, transforms,
    scannet, splat_frame, rle, coco, id_image, model_toml, tensors, phrases, contributions, region_table, cell_field, geo, query, position,
    grammar;
    services: http_request, v1, tuf;
}

pub fn run(name: &str, data: &[u8]) -> bool {
    let target = TARGETS.iter().find(|target| target.name == name).expect("a target of that name");
    (target.run)(data)
}
