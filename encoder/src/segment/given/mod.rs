//! Masks from files: id images, SAM's lists of run-length masks, COCO data sets.

mod coco;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use slag_common::{Hash32, View, files};

use super::{MAX_MASK_BYTES, SegmentError, SegmentInput, Segmenter};
use crate::masks::rle::Rle;
use crate::masks::{Mask, NO_REGION, masks_of_labels};
use coco::too_large;

/// Masks from files.
///
/// A folder has one file per photo: for `left/a.jpg`, one of `left/a.png`, `left/a.jpg.png`, `left/a.json` and
/// `left/a.jpg.json`. A PNG (gray of up to 16 bits, or with a palette) contains ids: 0 is background, each other id a
/// mask. A JSON file is a list of `{"segmentation": {"size": [height, width], "counts": ..}}`, as SAM's automatic
/// generator writes it, or an object with such a list as `annotations`; its masks may overlap. A folder `left/a/` has a
/// black and white PNG per mask, as SAM's `amg.py` writes it. A JSON file in place of the folder is a COCO data set of
/// all photos, whose `file_name` may lack folders of the photo's name or have further ones.
///
/// Masks belong to the photos as taken and are undistorted with them.
#[derive(Debug)]
pub struct GivenMasks {
    source: Source,
    ignore_ids: Vec<u32>,
    /// Masks without pixels are told once.
    told_empty: AtomicBool,
}

#[derive(Debug)]
enum Source {
    Folder(PathBuf),
    DataSet { path: PathBuf, masks_of_image: coco::MasksOfImage },
}

impl GivenMasks {
    /// `ignore_ids` are further background ids of id images.
    pub fn open(path: &Path, ignore_ids: Vec<u32>) -> Result<Self, SegmentError> {
        let source = if files::metadata(path)?.is_dir() {
            Source::Folder(path.to_owned())
        } else if path.extension().is_some_and(|ending| ending == "png") {
            let expected = "expected a folder with a file for each photo, or a COCO data set in JSON";
            return Err(SegmentError::of_file(path, expected));
        } else {
            let masks_of_image = coco::read_data_set(path)?;
            if let Some(told) = coco::without_pixels(path, masks_of_image.values().flatten()) {
                tracing::warn!("{told}");
            }
            Source::DataSet { path: path.to_owned(), masks_of_image }
        };
        Ok(Self { source, ignore_ids, told_empty: AtomicBool::new(false) })
    }

    /// Whether a view has a file, or an entry in the data set.
    pub fn covers(&self, view: &View) -> bool {
        match &self.source {
            Source::Folder(dir) => file_of(dir, view).is_some(),
            Source::DataSet { masks_of_image, .. } => coco::entry(masks_of_image, &view.name).is_some(),
        }
    }

    /// `None` if the view has no file or entry.
    pub fn load(&self, input: &SegmentInput<'_>) -> Result<Option<Vec<Mask>>, SegmentError> {
        let path = match &self.source {
            Source::DataSet { path, masks_of_image } => {
                let rles = coco::entry(masks_of_image, &input.view.name);
                return rles.map(|(_, rles)| coco::masks_of_rles(path, rles, input)).transpose();
            }
            Source::Folder(dir) => file_of(dir, input.view),
        };
        let Some(path) = path else { return Ok(None) };
        if path.is_dir() {
            let mut masks = Vec::new();
            for path in binary_masks(&path)? {
                masks.extend(self.masks_of_png(&path, input, true)?);
            }
            return Ok(Some(masks));
        }
        match path.extension().is_some_and(|e| e == "png") {
            true => self.masks_of_png(&path, input, false).map(Some),
            false => {
                let rles = coco::read_list(&path)?;
                if let Some(told) = coco::without_pixels(&path, &rles)
                    && !self.told_empty.swap(true, Ordering::Relaxed)
                {
                    tracing::warn!("{told}; files of other photos may have such masks, too");
                }
                coco::masks_of_rles(&path, &rles, input).map(Some)
            }
        }
    }

    /// Refuses a file, or an entry of a data set, that matches several views: it is ambiguous.
    fn check_entries(&self, views: &[View]) -> Result<(), SegmentError> {
        let (path, masks_of_image) = match &self.source {
            Source::Folder(dir) => return check_files(dir, views),
            Source::DataSet { path, masks_of_image } => (path, masks_of_image),
        };
        let mut view_of_entry: BTreeMap<&str, &str> = BTreeMap::new();
        for view in views {
            let Some((entry, _)) = coco::entry(masks_of_image, &view.name) else { continue };
            if let Some(other) = view_of_entry.insert(entry, &view.name) {
                let what = format!(
                    "file_name {entry:?} is ambiguous: it may be {other:?} or {:?}; write the photo's folder into it",
                    view.name
                );
                return Err(coco::inconsistent(path, &what));
            }
        }
        Ok(())
    }

    /// Names an unused file of a view that has another.
    fn second_file(&self, views: &[View]) -> Option<String> {
        let Source::Folder(dir) = &self.source else { return None };
        let [read, not] = views.iter().find_map(|view| {
            let mut files = files_of(dir, view);
            Some([files.next()?, files.next()?])
        })?;
        Some(format!("{} is read for masks, and {} beside it is not", read.display(), not.display()))
    }

    /// Names of files, folders or entries from which no view has masks.
    fn unmatched(&self, views: &[View]) -> Vec<String> {
        let mut names: BTreeSet<String> = match &self.source {
            Source::DataSet { masks_of_image, .. } => masks_of_image.keys().cloned().collect(),
            Source::Folder(dir) => {
                let entries = fs_err::read_dir(dir).into_iter().flatten();
                entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok()).collect()
            }
        };
        for view in views {
            let name = match &self.source {
                Source::DataSet { masks_of_image, .. } => {
                    coco::entry(masks_of_image, &view.name).map(|(entry, _)| entry.clone())
                }
                Source::Folder(dir) => file_of(dir, view).and_then(|path| {
                    let first = path.strip_prefix(dir).ok()?.components().next()?;
                    Some(first.as_os_str().to_str()?.to_owned())
                }),
            };
            if let Some(name) = name {
                names.remove(&name);
            }
        }
        names.into_iter().collect()
    }

    /// Masks of an id image; `is_binary`: the one mask of a black and white image.
    fn masks_of_png(
        &self,
        path: &Path,
        input: &SegmentInput<'_>,
        is_binary: bool,
    ) -> Result<Vec<Mask>, SegmentError> {
        let mut labels = coco::read_ids(path, input)?;
        if let (false, Some(n)) = (is_binary, coco::n_soft(&labels, input.image.width() as usize)) {
            let problem = format!(
                "soft edges: {n} values lie between others in seams of one or two pixels, expected an id for each mask; draw \
                 masks without antialiasing, and enlarge them by the nearest pixel (cv2.INTER_NEAREST)"
            );
            return Err(SegmentError::of_file(path, problem));
        }
        // Soft edges are cut at half.
        let darkest = labels.iter().max().filter(|_| is_binary).map_or(1, |white| white / 2 + 1);
        for label in &mut labels {
            if *label < darkest || !is_binary && self.ignore_ids.contains(label) {
                *label = NO_REGION;
            } else if is_binary {
                *label = 0;
            }
        }
        if let Some(undistorter) = input.undistorter {
            labels = undistorter.labels(&labels, NO_REGION);
        }
        let largest = labels.iter().filter(|label| **label != NO_REGION).max();
        let n_labels = largest.map_or(0, |id| *id as usize + 1);
        let masks = masks_of_labels(&labels, input.image.width(), n_labels, MAX_MASK_BYTES)
            .ok_or_else(|| too_large(path))?;
        Ok(masks.into_iter().map(|(_, mask)| mask).collect())
    }
}

impl Segmenter for GivenMasks {
    fn identity(&self) -> String {
        format!("given masks, ignored ids {:?}", self.ignore_ids)
    }

    fn check_views(&self, views: &[View], strict: bool) -> Result<Option<String>, SegmentError> {
        self.check_entries(views)?;
        let without: Vec<&View> = views.iter().filter(|view| !self.covers(view)).collect();
        let Some(first) = without.first() else { return Ok(self.second_file(views)) };
        let path = match &self.source {
            Source::Folder(path) | Source::DataSet { path, .. } => path,
        };
        let (view, n, of) = (&first.name, without.len(), views.len());
        let found = self.unmatched(views);
        if n == of {
            let is_langsplat = found.iter().any(|name| name.ends_with("_s.npy") || name.ends_with("_f.npy"));
            let hint = match is_langsplat {
                true => {
                    "; these are LangSplat's maps: write each level of NAME_s.npy as ids into NAME.png, 0 for -1"
                }
                false => "",
            };
            let found = if found.is_empty() { "nothing".into() } else { first_of(&found) };
            let problem = format!(
                "no masks of any photo: for {view:?} expected a file of that name with the ending .png or .json (or a folder \
                 with 0.png, 1.png ...), or a COCO file_name like it; found {found}{hint}"
            );
            return Err(SegmentError::of_file(path, problem));
        }
        // Counted from 1 in place of 0, or of another flight: those that match have the masks of another photo.
        if 2 * n > of && found.len() >= n {
            let problem = format!(
                "{n} of {of} photos have no masks, the first is {view:?}, and {} names match no photo ({}); name masks \
                 after their photos, or take the others away",
                found.len(),
                first_of(&found)
            );
            return Err(SegmentError::of_file(path, problem));
        }
        if strict {
            let advice = "make them, or leave out --strict";
            let problem = format!("{n} of {of} photos have no masks, the first is {view:?}; {advice}");
            return Err(SegmentError::of_file(path, problem));
        }
        let missing = format!("{n} of {of} views have no masks in {}, the first is {view}", path.display());
        Ok(Some(
            [Some(missing), self.second_file(views)].into_iter().flatten().collect::<Vec<_>>().join("; "),
        ))
    }

    fn identity_of_view(&self, view: &View) -> Result<Option<Hash32>, SegmentError> {
        match &self.source {
            Source::Folder(dir) => file_of(dir, view).map(|path| hash_of_masks(&path)).transpose(),
            Source::DataSet { masks_of_image, .. } => {
                let hash = |(_, rles): (&String, &Vec<(usize, Rle)>)| -> Result<Hash32, SegmentError> {
                    // Only errors need their indices in the file.
                    let rles: Vec<&Rle> = rles.iter().map(|(_, rle)| rle).collect();
                    Ok(Hash32::of(&serde_json::to_vec(&rles).map_err(std::io::Error::from)?))
                };
                coco::entry(masks_of_image, &view.name).map(hash).transpose()
            }
        }
    }

    fn segment(&self, input: &SegmentInput<'_>) -> Result<Vec<Mask>, SegmentError> {
        Ok(self.load(input)?.unwrap_or_default())
    }
}

/// Up to three names.
fn first_of(names: &[String]) -> String {
    names[..names.len().min(3)].join(", ")
}

/// A view's mask file in a folder of masks, or the folder with one file per mask.
pub fn file_of(dir: &Path, view: &View) -> Option<PathBuf> {
    let folder = || Some(dir.join(&view.name).with_extension("")).filter(|of| of.join("0.png").is_file());
    files_of(dir, view).next().or_else(folder)
}

fn check_files(dir: &Path, views: &[View]) -> Result<(), SegmentError> {
    let mut view_of_file: BTreeMap<PathBuf, &str> = BTreeMap::new();
    for view in views {
        let Some(path) = file_of(dir, view) else { continue };
        if let Some(first) = view_of_file.insert(path.clone(), &view.name) {
            let problem = format!(
                "it may have the masks of {first:?} or of {:?}; name each file of masks after all of its photo's name, such as \
                 {first}.png",
                view.name
            );
            return Err(SegmentError::File { path, problem });
        }
    }
    Ok(())
}

fn files_of(dir: &Path, view: &View) -> impl Iterator<Item = PathBuf> + use<> {
    let image = dir.join(&view.name);
    let appended = |ending| dir.join(format!("{}.{ending}", view.name));
    let files =
        [image.with_extension("png"), appended("png"), image.with_extension("json"), appended("json")];
    files.into_iter().filter(|path| path.is_file())
}

/// The images of a folder with a black and white PNG per mask, by number.
fn binary_masks(folder: &Path) -> Result<Vec<PathBuf>, SegmentError> {
    let mut numbered = Vec::new();
    for entry in fs_err::read_dir(folder)? {
        let path = entry?.path();
        let number = path.file_stem().and_then(|stem| stem.to_str()?.parse::<u32>().ok());
        if let (Some(number), true) = (number, path.extension().is_some_and(|ending| ending == "png")) {
            numbered.push((number, path));
        }
    }
    numbered.sort();
    Ok(numbered.into_iter().map(|(_, path)| path).collect())
}

/// Hash of a view's masks: the file's extension, which decides how it is read, and its content.
fn hash_of_masks(path: &Path) -> Result<Hash32, SegmentError> {
    if path.is_dir() {
        let hashes =
            binary_masks(path)?.iter().map(|path| hash_of_masks(path)).collect::<Result<Vec<_>, _>>()?;
        return Ok(Hash32::of(&hashes.iter().flat_map(|hash| hash.0).collect::<Vec<u8>>()));
    }
    let (content, _) = Hash32::of_reader(fs_err::File::open(path)?)?;
    let ending = path.extension().unwrap_or_default().as_encoded_bytes();
    Ok(Hash32::of(&[ending, &content.0].concat()))
}
