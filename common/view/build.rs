//! Compresses the built page (`dist/`) and lists its files for `src/lib.rs`; without the page, the list is empty.

use std::fmt::Write as _;
use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use flate2::{Compression, write::GzEncoder};

fn files_under(folder: &Path, found: &mut Vec<PathBuf>) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    for entry in entries.flatten() {
        let path = entry.path();
        if path.is_dir() { files_under(&path, found) } else { found.push(path) }
    }
}

fn main() {
    let dist = Path::new(&std::env::var("CARGO_MANIFEST_DIR").expect("set by cargo")).join("dist");
    let out = PathBuf::from(std::env::var("OUT_DIR").expect("set by cargo"));
    // Cargo treats a missing folder as changed; `scripts/build-page.sh` touches this file instead.
    println!("cargo::rerun-if-changed=build.rs");
    let mut paths = Vec::new();
    if std::env::var_os("CARGO_FEATURE_PAGE").is_some() && dist.is_dir() {
        println!("cargo::rerun-if-changed=dist");
        files_under(&dist, &mut paths);
    }
    paths.sort();
    let mut table = String::from("&[\n");
    for (i, path) in paths.iter().enumerate() {
        let bytes = fs::read(path).expect("a readable file of dist/");
        // Level and header are fixed, so the same page gives the same program.
        let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
        encoder.write_all(&bytes).expect("memory");
        let compressed = out.join(format!("{i}.gz"));
        fs::write(&compressed, encoder.finish().expect("memory")).expect("a writable OUT_DIR");
        let name = path.strip_prefix(&dist).expect("under dist").to_str().expect("UTF-8").replace('\\', "/");
        writeln!(
            table,
            "File {{ path: {name:?}, etag: \"\\\"{:08x}-{}\\\"\", gzip: include_bytes!({compressed:?}) }},",
            crc32fast::hash(&bytes),
            bytes.len()
        )
        .expect("memory");
    }
    table.push(']');
    fs::write(out.join("files.rs"), table).expect("a writable OUT_DIR");
}
