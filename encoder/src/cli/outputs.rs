//! What a user names as output: it is none of the inputs, and not in the store.

use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};

/// Endings of files that are read from a folder of poses, photos or masks.
const ENDINGS: [&str; 6] = ["bin", "txt", "jpg", "jpeg", "png", "webp"];

/// Refuses outputs that would replace what a command reads; files are compared by device and inode. Of a folder of
/// inputs, new files and files of other kinds may be written.
pub(super) fn check<'a>(
    outputs: impl IntoIterator<Item = &'a Path>,
    inputs: &[&Path],
    store: Option<&Path>,
) -> Result<()> {
    for output in outputs {
        let path = std::path::absolute(output)?;
        // Links count as what they lead to.
        let path = path.canonicalize().or_else(|_| Ok::<PathBuf, std::io::Error>(with_real_folder(&path)))?;
        let shown = output.display();
        let is_in = |folder: &Path| {
            identity(folder).is_some_and(|id| path.ancestors().any(|at| identity(at) == Some(id)))
        };
        if let Some(store) = store.filter(|store| is_in(store)) {
            bail!("{shown}: the output would lie in the store {}; name a path elsewhere", store.display());
        }
        let Some(id) = identity(&path) else { continue };
        let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default().to_lowercase();
        let is_kept =
            |input: &Path| input.is_dir() && path.is_file() && is_in(input) && ENDINGS.contains(&&*ending);
        if let Some(input) = inputs.iter().find(|input| identity(input) == Some(id) || is_kept(input)) {
            bail!(
                "{shown}: the output would replace what is read from {}; name another path",
                input.display()
            );
        }
    }
    Ok(())
}

/// The folder that a file lies in.
pub(super) fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if folder.as_os_str().is_empty() => Path::new("."),
        Some(folder) => folder,
        None => path,
    }
}

fn with_real_folder(path: &Path) -> PathBuf {
    let real = path.ancestors().skip(1).find_map(|at| Some((at, at.canonicalize().ok()?)));
    let Some((at, real)) = real else { return path.to_owned() };
    path.strip_prefix(at).map_or_else(|_| path.to_owned(), |rest| real.join(rest))
}

/// Device and inode of a file or folder; `None` of others, such as pipes.
fn identity(path: &Path) -> Option<(u64, u64)> {
    let about = std::fs::metadata(path).ok()?;
    (about.is_file() || about.is_dir()).then(|| (about.dev(), about.ino()))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By every name of a file: through links, and from a folder that it lies in.
    #[test]
    fn outputs_replace_no_inputs() {
        let dir = tempfile::tempdir().expect("a folder");
        let at = |name: &str| dir.path().join(name);
        for folder in ["store/keys", "photos"] {
            fs_err::create_dir_all(at(folder)).expect("made");
        }
        for file in ["in.ply", "photos/a.JPG", "photos/report.html"] {
            fs_err::write(at(file), "kept").expect("written");
        }
        fs_err::hard_link(at("in.ply"), at("hard.ply")).expect("linked");
        std::os::unix::fs::symlink(at("store"), at("link")).expect("linked");
        let (scene, photos, store) = (at("in.ply"), at("photos"), at("store"));
        let check = |output: &str| check([&*at(output)], &[&scene, &photos], Some(&store));
        for output in ["in.ply", "hard.ply", "photos", "photos/a.JPG", "photos/../in.ply"] {
            let error = check(output).expect_err(output).to_string();
            assert!(error.contains("would replace what is read"), "{error}");
        }
        for output in ["store", "store/manifest", "link/new/deep.html"] {
            let error = check(output).expect_err(output).to_string();
            assert!(error.contains("would lie in the store"), "{error}");
        }
        for output in ["new.ply", "photos/new.png", "photos/report.html", "photos/drawn"] {
            check(output).expect(output);
        }
        super::check([Path::new("/dev/null")], &[Path::new("/dev/null")], None).expect("a device");
    }
}
