//! libFuzzer's program. `SLAG_FUZZ_TARGET` names the target; `SLAG_FUZZ_SEEDS` instead writes the seeds of all
//! targets to that folder; `SLAG_SHARED` is the folder of shared test data.

#![no_main]

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

fn write_seeds(out: &Path, shared: Option<&Path>) -> std::io::Result<()> {
    for target in slag_fuzz::TARGETS {
        let folder = out.join(target.name);
        fs_err::create_dir_all(&folder)?;
        for (number, seed) in slag_fuzz::seeds::of(target.name, shared).iter().enumerate() {
            fs_err::write(folder.join(format!("seed{number}")), seed)?;
        }
    }
    Ok(())
}

libfuzzer_sys::fuzz_target!(
    init: {
        if let Some(out) = std::env::var_os("SLAG_FUZZ_SEEDS") {
            let shared = std::env::var_os("SLAG_SHARED").map(PathBuf::from);
            write_seeds(Path::new(&out), shared.as_deref()).expect("the seeds are written");
            std::process::exit(0);
        }
    },
    |data: &[u8]| {
        static NAME: OnceLock<String> = OnceLock::new();
        let name = NAME.get_or_init(|| std::env::var("SLAG_FUZZ_TARGET").expect("SLAG_FUZZ_TARGET names a target"));
        slag_fuzz::run(name, data);
    }
);
