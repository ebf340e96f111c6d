//! One function for each decoder of foreign bytes: whatever the bytes are, it returns.
//!
//! `cargo fuzz` runs them with coverage (`fuzz_targets/`), the workspace's tests with seeded mutations
//! (`tests/fuzz.rs`). Where a format has checksums or signatures, they are made right first: otherwise
//! no mutation would get past them.

#[path = "formats.rs"]
mod formats;
#[path = "seeds.rs"]
pub mod seeds;

/// A decoder to fuzz.
pub struct Target {
    /// What `cargo fuzz` calls it.
    pub name: &'static str,
    /// Decodes, and says whether the bytes were accepted; must neither panic nor take more memory than
    /// they justify.
    pub run: fn(&[u8]) -> bool,
}

macro_rules! targets {
    ($($name:ident),+ $(,)?) => {
        /// All decoders.
        pub const TARGETS: &[Target] =
            &[$(Target { name: stringify!($name), run: formats::$name }),+];
    };
}

targets! {
    container, shard, manifest, current, ply, splat, spz, sog, sog_meta, colmap_text, colmap_bin, transforms,
    rle, coco, model_toml, tensors, phrases, sums, region_table, cell_field, npz, geo, query, position,
}

/// Runs a target by name.
///
/// # Panics
/// If there is none of that name.
pub fn run(name: &str, data: &[u8]) -> bool {
    let target = TARGETS.iter().find(|target| target.name == name).expect("a target of that name");
    (target.run)(data)
}
