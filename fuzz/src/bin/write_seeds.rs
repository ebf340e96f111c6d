//! Writes the seeds of every target to `corpus/TARGET/`; the argument is the folder of shared test data.

use std::path::{Path, PathBuf};

fn main() -> std::io::Result<()> {
    let shared = std::env::args_os().nth(1).map(PathBuf::from);
    for target in slag_fuzz::TARGETS {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus").join(target.name);
        fs_err::create_dir_all(&folder)?;
        for (number, seed) in slag_fuzz::seeds::of(target.name, shared.as_deref()).iter().enumerate() {
            fs_err::write(folder.join(format!("seed{number}")), seed)?;
        }
    }
    Ok(())
}
