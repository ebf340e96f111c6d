//! Paths in pose files, and photos that are not where the poses say.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::io;
use std::path::{Component, Path, PathBuf};

use unicode_normalization::UnicodeNormalization;

use crate::camera::View;

/// Returns the parent folder of `path`, also for paths such as `.` that do not name it.
pub(super) fn parent(path: &Path) -> io::Result<PathBuf> {
    match path.parent() {
        Some(parent) if path.file_name().is_some() && parent != Path::new("") => Ok(parent.to_owned()),
        _ => Ok(fs_err::canonicalize(path)?.parent().map_or_else(|| PathBuf::from("/"), Path::to_owned)),
    }
}

/// In lower case.
const PHOTO_ENDINGS: [&str; 4] = ["jpg", "jpeg", "png", "webp"];

/// Finds photos whose path or extension differs from the one in the poses.
pub(super) struct PhotoFinder {
    dir: PathBuf,
    /// Per folder: files by lower-case name without extension; `None` where two are equal.
    listed: HashMap<PathBuf, BTreeMap<String, Option<PathBuf>>>,
}

impl PhotoFinder {
    pub(super) fn new(dir: PathBuf) -> Self {
        Self { dir, listed: HashMap::new() }
    }

    /// Returns the photo at the longest suffix of `path` that exists in the folder, and that suffix. The file name
    /// may differ in case or photo extension, or have `%20` for a space as in URLs.
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

    /// Finds the photos of views whose file does not exist. Views with `foreign` names (paths of another machine) are
    /// renamed to the suffix that exists. Returns sentences on what was found.
    pub(super) fn find_missing(&mut self, views: &mut [View], foreign: &BTreeSet<String>) -> Vec<String> {
        let mut elsewhere: Vec<Option<Stated>> = Vec::with_capacity(views.len());
        for view in views.iter_mut() {
            let found = if view.image_path.is_file() { None } else { self.find(&view.name) };
            elsewhere.push(found.map(|(path, ending)| {
                let name = if foreign.contains(&view.name) { ending } else { view.name.clone() };
                let image_path = std::mem::replace(&mut view.image_path, path);
                let name = std::mem::replace(&mut view.name, name);
                Stated { image_path, said: name.clone(), name }
            }));
        }
        settle(views, elsewhere, |n, first| {
            format!("{n} photos have other names than the poses say, such as {first}")
        })
    }
}

/// Returns the components of a path, without root and dots.
pub(super) fn parts_of(path: &str) -> Vec<&str> {
    let part = |part| match part {
        Component::Normal(part) => part.to_str(),
        _ => None,
    };
    Path::new(path).components().filter_map(part).collect()
}

/// What the poses say about a photo that was found elsewhere.
pub(super) struct Stated {
    pub(super) image_path: PathBuf,
    pub(super) name: String,
    pub(super) said: String,
}

/// Restores the stated paths of views that found the same photo as another view; `elsewhere`: one per view. Returns
/// sentences on them, and on the photos `moved`: their number, and the first.
pub(super) fn settle(
    views: &mut [View],
    elsewhere: Vec<Option<Stated>>,
    moved: impl Fn(usize, &str) -> String,
) -> Vec<String> {
    let mut n_views_of: HashMap<PathBuf, usize> = HashMap::new();
    views.iter().for_each(|view| *n_views_of.entry(view.image_path.clone()).or_default() += 1);
    let (mut shared, mut single) = (Vec::new(), Vec::new());
    for (view, stated) in views.iter_mut().zip(elsewhere) {
        let Some(Stated { image_path, name, said }) = stated else { continue };
        let found = format!("{} for {said}", view.image_path.display());
        if n_views_of[&view.image_path] > 1 {
            shared.push(found);
            (view.image_path, view.name) = (image_path, name);
        } else {
            single.push(found);
        }
    }
    let shared = shared.first().map(|first| {
        let n = shared.len();
        let advice = "put the photos into the folders that the poses name";
        format!(
            "{n} photos are ambiguous and left out, such as {first}, which another view names, too; {advice}"
        )
    });
    shared.into_iter().chain(single.first().map(|first| moved(single.len(), first))).collect()
}

/// Decodes `%20` and other percent escapes; `None` without any.
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

/// Returns a file's lower-case name without extension, in NFC: archives of macOS decompose letters.
fn stem_of(path: &Path) -> Option<String> {
    Some(path.file_stem()?.to_str()?.nfc().collect::<String>().to_lowercase())
}
