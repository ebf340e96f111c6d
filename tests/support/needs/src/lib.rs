//! The attribute that ignores a test where the shared test data is absent.
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

fn parsed(code: &str) -> TokenStream {
    code.parse().expect("valid Rust")
}
