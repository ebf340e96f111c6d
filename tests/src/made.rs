//! Scenes and stores shared by tests: made once; tests read them, or write to a copy.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::time::UNIX_EPOCH;

use slag_common::Hash32;

use crate::{copy_dir, encode_quickly, lab, program, run};

/// Generated scene: `scene.ply`, `transforms.json`, photos, labels; read-only. `flags`: `slag-lab generate scene`'s.
pub fn generated(flags: &[&str]) -> PathBuf {
    made("scene", flags, |out| drop(run(lab(&["generate", "scene", "--out"]).arg(out).args(flags))))
}

/// Store of a generated scene; read-only. `flags`: `slag-encoder encode`'s, besides those of [`encode_quickly`].
pub fn encoded(scene: &[&str], flags: &[&str]) -> PathBuf {
    let key = [scene, &["encode"], flags].concat();
    made("store", &key, |out| drop(run(encode_quickly(&generated(scene), out).args(flags))))
}

/// Copies the store of [`encoded`] to a folder, which a test may serve and change.
pub fn encoded_into(store: &Path, scene: &[&str], flags: &[&str]) {
    copy_dir(&encoded(scene, flags), store);
}

/// Returns the folder that `make` fills, once per kind, key and build of the programs, for all test programs. It lies
/// beside the programs; folders of other builds are removed.
pub fn made(kind: &str, key: &[&str], make: impl FnOnce(&Path)) -> PathBuf {
    static MADE: OnceLock<PathBuf> = OnceLock::new();
    let folder = MADE.get_or_init(|| {
        let programs = ["slag-encoder", "slag-lab"].map(|name| {
            let bytes = fs_err::read(program(name)).expect("the programs are built");
            Hash32::of(&bytes).to_string()
        });
        // Signatures of stores expire after some days.
        let day = UNIX_EPOCH.elapsed().expect("a clock").as_secs() / 86_400;
        let all = program("slag-lab").with_file_name("made");
        let folder = all.join(short_hash(&[&programs[0], &programs[1], &day.to_string()]));
        fs_err::create_dir_all(&folder).expect("made");
        for entry in fs_err::read_dir(&all).expect("there") {
            let other = entry.expect("readable").path();
            if other != folder {
                // Another test program may remove it too.
                let _ = std::fs::remove_dir_all(other);
            }
        }
        folder
    });
    let name = format!("{kind}-{}", short_hash(key));
    let lock = fs_err::File::create(folder.join(format!("{name}.lock"))).expect("created");
    lock.file().lock().expect("locked");
    let (wanted, part) = (folder.join(&name), folder.join(format!("{name}.part")));
    if !wanted.exists() {
        if part.exists() {
            fs_err::remove_dir_all(&part).expect("removed");
        }
        make(&part);
        fs_err::rename(&part, &wanted).expect("renamed");
    }
    wanted
}

fn short_hash(words: &[&str]) -> String {
    Hash32::of(words.join("\0").as_bytes()).to_string()[..16].to_owned()
}
