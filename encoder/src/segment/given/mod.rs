//! Masks from files: id images, SAM's lists of run-length masks, COCO data sets.

mod coco;
mod id_image;
mod limits;
mod undistort;

use std::path::{Path, PathBuf};

use slag_common::{Hash32, View};

use super::error::SegmentError;
use super::segmenter::{MAX_MASK_BYTES, SegmentInput, Segmenter};
use crate::masks::rle::Rle;
use crate::masks::{Mask, NO_REGION, masks_of_labels};
use limits::too_large;

/// Masks from files.
///
/// A folder has one file per photo: for `left/a.jpg`, one of `left/a.png`, `left/a.jpg.png`, `left/a.json` and
/// `left/a.jpg.json`. A PNG (gray of up to 16 bits, or with a palette) contains ids: 0 is background, each other id a
/// mask. A JSON file is a list of `{"segmentation": {"size": [height, width], "counts": ..}}`, as SAM's automatic
/// generator writes it, or an object with such a list as `annotations`; its masks may overlap. A JSON file in place of
/// the folder is a COCO data set of all photos.
///
/// Masks belong to the photos as taken and are undistorted with them.
#[derive(Debug)]
pub struct GivenMasks {
    source: Source,
    ignore_ids: Vec<u32>,
}

#[derive(Debug)]
enum Source {
    Folder(PathBuf),
    DataSet { path: PathBuf, masks_of_image: coco::MasksOfImage },
}

impl GivenMasks {
    /// Opens a folder of masks or reads a COCO data set. `ignore_ids` are further background ids of id images.
    ///
    /// # Errors
    /// [`SegmentError`] if the path does not exist or the data set is malformed.
    pub fn open(path: &Path, ignore_ids: Vec<u32>) -> Result<Self, SegmentError> {
        let source = if fs_err::metadata(path)?.is_dir() {
            Source::Folder(path.to_owned())
        } else {
            let masks_of_image = coco::read_data_set(path)?;
            Source::DataSet { path: path.to_owned(), masks_of_image }
        };
        Ok(Self { source, ignore_ids })
    }

    /// Returns whether a view has masks: a file, or an entry in the data set.
    pub fn covers(&self, view: &View) -> bool {
        match &self.source {
            Source::Folder(dir) => file_of(dir, view).is_some(),
            Source::DataSet { masks_of_image, .. } => masks_of_image.contains_key(&view.name),
        }
    }

    /// Returns the masks of a view; `None` if it has no file or entry.
    ///
    /// # Errors
    /// [`SegmentError`] if the file is malformed or does not have the photo's size.
    pub fn load(&self, input: &SegmentInput<'_>) -> Result<Option<Vec<Mask>>, SegmentError> {
        match &self.source {
            Source::DataSet { path, masks_of_image, .. } => match masks_of_image.get(&input.view.name) {
                Some(rles) => coco::masks_of_rles(path, rles, input).map(Some),
                None => Ok(None),
            },
            Source::Folder(dir) => match file_of(dir, input.view) {
                Some(path) if path.extension().is_some_and(|e| e == "png") => {
                    self.masks_of_png(&path, input).map(Some)
                }
                Some(path) => coco::masks_of_rles(&path, &coco::read_list(&path)?, input).map(Some),
                None => Ok(None),
            },
        }
    }

    fn masks_of_png(&self, path: &Path, input: &SegmentInput<'_>) -> Result<Vec<Mask>, SegmentError> {
        let mut labels = id_image::read_ids(path, input)?;
        for label in &mut labels {
            if *label == 0 || self.ignore_ids.contains(label) {
                *label = NO_REGION;
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

    fn identity_of_view(&self, view: &View) -> Result<Option<Hash32>, SegmentError> {
        match &self.source {
            Source::Folder(dir) => file_of(dir, view).map(|path| hash_of_file(&path)).transpose(),
            Source::DataSet { masks_of_image, .. } => {
                let hash = |rles: &Vec<(usize, Rle)>| -> Result<Hash32, SegmentError> {
                    // Their places in the file name them in errors only.
                    let rles: Vec<&Rle> = rles.iter().map(|(_, rle)| rle).collect();
                    Ok(Hash32::of(&serde_json::to_vec(&rles).map_err(std::io::Error::from)?))
                };
                masks_of_image.get(&view.name).map(hash).transpose()
            }
        }
    }

    fn segment(&self, input: &SegmentInput<'_>) -> Result<Vec<Mask>, SegmentError> {
        Ok(self.load(input)?.unwrap_or_default())
    }
}

/// Returns the file with a view's masks in a folder of masks, if there is one.
pub fn file_of(dir: &Path, view: &View) -> Option<PathBuf> {
    let image = dir.join(&view.name);
    let appended = |ending| dir.join(format!("{}.{ending}", view.name));
    [image.with_extension("png"), appended("png"), image.with_extension("json"), appended("json")]
        .into_iter()
        .find(|path| path.is_file())
}

/// Returns the hash of a mask file: its ending, which says how it is read, and its content.
fn hash_of_file(path: &Path) -> Result<Hash32, SegmentError> {
    let (content, _) = Hash32::of_reader(fs_err::File::open(path)?)?;
    let ending = path.extension().unwrap_or_default().as_encoded_bytes();
    Ok(Hash32::of(&[ending, &content.0].concat()))
}
