//! Attributes of tests that are ignored where the machine lacks their requirements, or outside the nightly checks.
//! They stand in the place of `#[test]`.
//!
//! Macros instead of a `cfg` from build scripts: a build script that watches a missing folder runs at every build,
//! and recompiles each crate's library.

use std::path::{Path, PathBuf};

use proc_macro::{TokenStream, TokenTree};

/// A test that is ignored where `../shared` is absent, except in CI.
///
/// Decided when the test is compiled; if the data has arrived since, `cargo test -- --ignored` runs the test.
#[proc_macro_attribute]
pub fn needs_shared(_: TokenStream, test: TokenStream) -> TokenStream {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../..");
    let folder = std::env::var_os("SLAG_SHARED").map_or_else(|| root.join("../shared"), PathBuf::from);
    let is_ignored = !folder.is_dir() && std::env::var_os("CI").is_none();
    marked(test, &["CI", "SLAG_SHARED"], is_ignored.then_some("needs the test data in ../shared"))
}

/// A test that runs only where `SLAG_NIGHTLY` is set, as in `.ci/nightly`; the argument is the reason.
#[proc_macro_attribute]
pub fn nightly(why: TokenStream, test: TokenStream) -> TokenStream {
    let reason = format!("nightly: {}", why.to_string().trim_matches('"'));
    marked(test, &["SLAG_NIGHTLY"], std::env::var_os("SLAG_NIGHTLY").is_none().then_some(&reason))
}

/// `variables`: recompile the test when one changes.
fn marked(test: TokenStream, variables: &[&str], reason: Option<&str>) -> TokenStream {
    let mut tokens = test.clone().into_iter();
    let mut attributes = Vec::new();
    while matches!(tokens.next(), Some(TokenTree::Punct(hash)) if hash.as_char() == '#') {
        attributes.extend(tokens.next().map(|attribute| attribute.to_string()));
    }
    let has = |name: &str| attributes.iter().any(|attribute| attribute.contains(name));
    let looked_at = variables.iter().map(|name| format!("option_env!({name:?}),")).collect::<String>();
    let mut marked = parsed(&format!("const _: &[Option<&str>] = &[{looked_at}];"));
    // Another of these attributes may have marked it.
    if let Some(reason) = reason.filter(|_| !has("[ignore")) {
        marked.extend(parsed(&format!("#[ignore = {reason:?}]")));
    }
    // Where a test has several of these attributes, the last one adds `#[test]`.
    if !["needs_shared]", "needs_loop_disk]", "nightly("].map(has).contains(&true) {
        marked.extend(parsed("#[test]"));
    }
    marked.extend(test);
    marked
}

/// A test that is ignored where no file system can be mounted through a loop device.
#[proc_macro_attribute]
pub fn needs_loop_disk(_: TokenStream, test: TokenStream) -> TokenStream {
    let is_root =
        std::fs::read_to_string("/proc/self/status").is_ok_and(|status| status.contains("Uid:\t0\t"));
    let has = |name: &str| ["/sbin", "/usr/sbin"].iter().any(|dir| Path::new(dir).join(name).exists());
    let is_possible =
        is_root && has("mkfs.ext2") && has("debugfs") && Path::new("/dev/loop-control").exists();
    marked(test, &[], (!is_possible).then_some("needs root, loop devices and e2fsprogs"))
}

fn parsed(code: &str) -> TokenStream {
    code.parse().expect("valid Rust")
}
