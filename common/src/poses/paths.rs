//! Paths of pose files, and of photos that are not where the poses say.

use std::collections::{BTreeMap, HashMap};
use std::io;
use std::path::{Component, Path, PathBuf};

use crate::camera::View;

/// Returns the parent folder of `path`, also for paths such as `.` that do not name it.
pub(super) fn parent(path: &Path) -> io::Result<PathBuf> {
    match path.parent() {
        Some(parent) if path.file_name().is_some() && parent != Path::new("") => Ok(parent.to_owned()),
        _ => Ok(fs_err::canonicalize(path)?.parent().map_or_else(|| PathBuf::from("/"), Path::to_owned)),
    }
}

/// Endings of photos, in small letters.
const PHOTO_ENDINGS: [&str; 4] = ["jpg", "jpeg", "png", "webp"];

/// Finds photos whose path or ending differs from what the poses say.
pub(super) struct PhotoFinder {
    dir: PathBuf,
    /// By folder: files by their name in small letters without its ending; `None` where two have the same.
    listed: HashMap<PathBuf, BTreeMap<String, Option<PathBuf>>>,
}

impl PhotoFinder {
    pub(super) fn new(dir: PathBuf) -> Self {
        Self { dir, listed: HashMap::new() }
    }

    /// Returns the photo at the longest ending of `path` that exists in the folder, with the stated file name or
    /// else in other letters or with the ending of another photo format, or with `%20` for a space as in addresses;
    /// and that ending.
    pub(super) fn find(&mut self, path: &str) -> Option<(PathBuf, String)> {
        self.find_as_written(path).or_else(|| self.find_as_written(&without_escapes(path)?))
    }

    fn find_as_written(&mut self, path: &str) -> Option<(PathBuf, String)> {
        let parts = parts_of(path);
        let endings = || (0..parts.len()).map(|start| parts[start..].join("/"));
        let exact = endings().find(|ending| self.dir.join(ending).is_file());
        let found = exact.map(|ending| (self.dir.join(&ending), ending));
        found.or_else(|| endings().find_map(|ending| Some((self.similar(&self.dir.join(&ending))?, ending))))
    }

    fn similar(&mut self, path: &Path) -> Option<PathBuf> {
        let folder = path.parent()?;
        let files = self.listed.entry(folder.to_owned()).or_insert_with(|| {
            let mut files = BTreeMap::new();
            let entries = fs_err::read_dir(folder).into_iter().flatten().filter_map(Result::ok);
            for file in entries.map(|entry| entry.path()).filter(|path| path.is_file()) {
                let ending = file.extension().and_then(|ending| ending.to_str()).map(str::to_lowercase);
                if let (Some(stem), true) =
                    (stem_of(&file), ending.is_some_and(|ending| PHOTO_ENDINGS.contains(&&*ending)))
                {
                    files.entry(stem).and_modify(|one| *one = None).or_insert(Some(file));
                }
            }
            files
        });
        files.get(&stem_of(path)?)?.clone()
    }

    /// Finds the photos of the views whose file does not exist; returns a sentence on them, if there are any.
    pub(super) fn find_missing(&mut self, views: &mut [View]) -> Option<String> {
        let mut moved = Vec::new();
        for view in views.iter_mut().filter(|view| !view.image_path.is_file()) {
            if let Some((path, _)) = self.find(&view.name) {
                moved.push(format!("{} for {}", path.display(), view.name));
                view.image_path = path;
            }
        }
        let first = moved.first()?;
        Some(format!("{} photos have other names than the poses say, such as {first}", moved.len()))
    }
}

/// Returns the folders and the name of a path, without its root and its dots.
pub(super) fn parts_of(path: &str) -> Vec<&str> {
    let part = |part| match part {
        Component::Normal(part) => part.to_str(),
        _ => None,
    };
    Path::new(path).components().filter_map(part).collect()
}

/// Returns the text with `%20` and the like as the characters that they stand for; `None` without any.
fn without_escapes(text: &str) -> Option<String> {
    let (mut bytes, mut rest) = (Vec::new(), text.as_bytes());
    while let [byte, after @ ..] = rest {
        let code = after.get(..2).filter(|_| *byte == b'%').and_then(|code| std::str::from_utf8(code).ok());
        let code = code.and_then(|code| u8::from_str_radix(code, 16).ok());
        bytes.push(code.unwrap_or(*byte));
        rest = if code.is_some() { &after[2..] } else { after };
    }
    String::from_utf8(bytes).ok().filter(|found| found != text)
}

fn stem_of(path: &Path) -> Option<String> {
    Some(path.file_stem()?.to_str()?.to_lowercase())
}
