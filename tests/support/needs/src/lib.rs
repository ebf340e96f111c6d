//! Attributes that ignore a test where the machine lacks what it needs.
//!
//! A macro of its own rather than a `cfg` from build scripts: a build script that watches a folder that does not exist
//! runs at every build, and each crate's library would be compiled again with it.

use std::path::{Path, PathBuf};

use proc_macro::TokenStream;

/// Ignores a test where `../shared` is absent, except in CI. Stands above `#[test]`.
///
/// The data is looked for when the test is compiled. Where it has arrived since, `cargo test -- --ignored` runs the
/// test.
#[proc_macro_attribute]
pub fn needs_shared(_: TokenStream, test: TokenStream) -> TokenStream {
    if !test.to_string().contains("#[test]") {
        return parsed("compile_error!(\"`needs_shared` stands above `#[test]`\");");
    }
    // Tells the compiler that the result depends on these variables.
    let mut marked = parsed(
        "const _: (Option<&str>, Option<&str>) = (option_env!(\"CI\"), option_env!(\"SLAG_SHARED\"));",
    );
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../..");
    let folder = std::env::var_os("SLAG_SHARED").map_or_else(|| root.join("../shared"), PathBuf::from);
    if !folder.is_dir() && std::env::var_os("CI").is_none() {
        marked.extend(parsed("#[ignore = \"needs the test data in ../shared\"]"));
    }
    marked.extend(test);
    marked
}

/// Ignores a test where no file system can be mounted through a loop device. Stands above `#[test]`.
#[proc_macro_attribute]
pub fn needs_loop_disk(_: TokenStream, test: TokenStream) -> TokenStream {
    let is_root =
        std::fs::read_to_string("/proc/self/status").is_ok_and(|status| status.contains("Uid:\t0\t"));
    let has = |name: &str| ["/sbin", "/usr/sbin"].iter().any(|dir| Path::new(dir).join(name).exists());
    let is_possible =
        is_root && has("mkfs.ext2") && has("debugfs") && Path::new("/dev/loop-control").exists();
    let mut marked = match is_possible {
        true => TokenStream::new(),
        false => parsed("#[ignore = \"needs root, loop devices and e2fsprogs\"]"),
    };
    marked.extend(test);
    marked
}

fn parsed(code: &str) -> TokenStream {
    code.parse().expect("valid Rust")
}
