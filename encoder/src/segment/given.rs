//! Masks that a user gives: id images, SAM's lists of run-length masks, COCO data sets.

use std::collections::BTreeMap;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use slag_common::View;

use super::{MAX_MASK_BYTES, SegmentError, SegmentInput, Segmenter};
use crate::ingest::Undistorter;
use crate::masks::regions::partition;
use crate::masks::rle::{Rle, RleError};
use crate::masks::{BoxPx, Mask, NO_REGION, masks_of_labels};

/// What a PNG decoder may allocate beyond the pixels themselves.
const PNG_OVERHEAD_BYTES: usize = 1 << 20;

/// Masks from files.
///
/// A folder holds, for image `left/a.jpg`, one of `left/a.png`, `left/a.jpg.png`, `left/a.json` or
/// `left/a.jpg.json`. A PNG (gray of up to 16 bits, or with a codebook) holds ids: 0 is no mask, each
/// other id one. A JSON file is a list of `{"segmentation": {"size": [height, width], "counts": ..}}`
/// as SAM's automatic generator writes it, or an object with such a list as `annotations`; masks
/// may overlap. A single JSON file in place of the folder is a whole COCO data set.
///
/// Masks are those of the photos as taken; they are freed of lens distortion like the photos.
#[derive(Debug)]
pub struct GivenMasks {
    source: Source,
    ignore_ids: Vec<u32>,
    name: String,
}

#[derive(Debug)]
enum Source {
    Folder(PathBuf),
    DataSet { path: PathBuf, masks_of_image: BTreeMap<String, Vec<(usize, Rle)>> },
}

#[derive(Deserialize)]
struct Annotation {
    segmentation: Segmentation,
    /// Of a data set only.
    image_id: Option<u64>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Segmentation {
    Runs { size: [u32; 2], counts: Counts },
    Polygons(Vec<serde::de::IgnoredAny>),
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Counts {
    Text(String),
    Runs(Vec<u32>),
}

#[derive(Deserialize)]
struct MaskObject {
    #[serde(default)]
    images: Vec<DataSetImage>,
    annotations: Vec<Annotation>,
}

#[derive(Deserialize)]
struct DataSetImage {
    id: u64,
    file_name: String,
}

impl GivenMasks {
    /// Opens a folder of masks, or reads a COCO data set; `ignore_ids` are ids of id images that are
    /// no masks, beside 0.
    ///
    /// # Errors
    /// [`SegmentError`] if the path is absent, or the data set damaged.
    pub fn open(path: &Path, ignore_ids: Vec<u32>) -> Result<Self, SegmentError> {
        let source = if fs_err::metadata(path)?.is_dir() {
            Source::Folder(path.to_owned())
        } else {
            Source::DataSet { path: path.to_owned(), masks_of_image: read_data_set(path)? }
        };
        let name = format!("given masks, ignored ids {ignore_ids:?}");
        Ok(Self { source, ignore_ids, name })
    }

    /// Returns whether there are masks for a view: a file, or an entry of the data set.
    pub fn covers(&self, view: &View) -> bool {
        match &self.source {
            Source::Folder(dir) => file_of(dir, view).is_some(),
            Source::DataSet { masks_of_image, .. } => masks_of_image.contains_key(&view.name),
        }
    }

    /// Returns the masks of a view; `None` if nothing was given for it.
    ///
    /// # Errors
    /// [`SegmentError`] if the file is damaged or of another size than the image.
    pub fn load(&self, input: &SegmentInput<'_>) -> Result<Option<Vec<Mask>>, SegmentError> {
        match &self.source {
            Source::DataSet { path, masks_of_image } => match masks_of_image.get(&input.view.name) {
                Some(rles) => masks_of_rles(path, rles, input).map(Some),
                None => Ok(None),
            },
            Source::Folder(dir) => match file_of(dir, input.view) {
                Some(path) if path.extension().is_some_and(|e| e == "png") => {
                    self.masks_of_png(&path, input).map(Some)
                }
                Some(path) => {
                    let rles = rles_of(&path, read_mask_file(&path)?.annotations)?;
                    masks_of_rles(&path, &rles, input).map(Some)
                }
                None => Ok(None),
            },
        }
    }

    fn masks_of_png(&self, path: &Path, input: &SegmentInput<'_>) -> Result<Vec<Mask>, SegmentError> {
        let mut labels = read_id_png(path, input)?;
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
    fn name(&self) -> &str {
        &self.name
    }

    fn segment(&self, input: &SegmentInput<'_>) -> Result<Vec<Mask>, SegmentError> {
        Ok(self.load(input)?.unwrap_or_default())
    }
}

fn too_large(path: &Path) -> SegmentError {
    SegmentError::TooLarge { path: path.to_owned(), limit_bytes: MAX_MASK_BYTES }
}

/// Returns the file that holds a view's masks, where there is one.
fn file_of(dir: &Path, view: &View) -> Option<PathBuf> {
    let image = dir.join(&view.name);
    let appended = |ending| dir.join(format!("{}.{ending}", view.name));
    [image.with_extension("png"), appended("png"), image.with_extension("json"), appended("json")]
        .into_iter()
        .find(|path| path.is_file())
}

fn check_size(path: &Path, [width, height]: [u32; 2], input: &SegmentInput<'_>) -> Result<(), SegmentError> {
    let expected_px = [input.image.width(), input.image.height()];
    if [width, height] == expected_px {
        return Ok(());
    }
    let view = input.view.name.clone();
    Err(SegmentError::Size { path: path.to_owned(), view, found_px: [width, height], expected_px })
}

/// Reads the ids of a PNG of the image's size, row-major; a codebook's are its indices.
fn read_id_png(path: &Path, input: &SegmentInput<'_>) -> Result<Vec<u32>, SegmentError> {
    let failed = |source| SegmentError::Png { path: path.to_owned(), source };
    let n_pixels = input.image.width() as usize * input.image.height() as usize;
    let limits = png::Limits { bytes: 2 * n_pixels + PNG_OVERHEAD_BYTES };
    let mut decoder = png::Decoder::new_with_limits(BufReader::new(fs_err::File::open(path)?), limits);
    decoder.set_transformations(png::Transformations::IDENTITY);
    let (width_px, height_px) = decoder.read_header_info().map_err(failed)?.size();
    check_size(path, [width_px, height_px], input)?;
    let mut reader = decoder.read_info().map_err(failed)?;
    let (color, depth) = reader.output_color_type();
    let found = match color {
        png::ColorType::Grayscale | png::ColorType::Indexed => None,
        png::ColorType::Rgb => Some("RGB"),
        png::ColorType::GrayscaleAlpha => Some("gray and alpha"),
        png::ColorType::Rgba => Some("RGBA"),
    };
    if let Some(found) = found {
        return Err(SegmentError::NotIds { path: path.to_owned(), found });
    }
    // At most 16 bits a pixel, of a size that is the image's.
    let mut bytes = vec![0; reader.output_buffer_size().unwrap_or(0)];
    let frame = reader.next_frame(&mut bytes).map_err(failed)?;
    check_size(path, [frame.width, frame.height], input)?;

    let mut ids = Vec::with_capacity(n_pixels);
    let bits = depth as usize;
    for row in bytes.chunks_exact(frame.line_size.max(1)).take(height_px as usize) {
        match bits {
            16 => {
                ids.extend(row.chunks_exact(2).map(|pair| u32::from(u16::from_be_bytes([pair[0], pair[1]]))))
            }
            8 => ids.extend(row.iter().map(|byte| u32::from(*byte))),
            // Several pixels a byte, the leftmost in the highest bits; a centroid starts on a new byte.
            _ => ids.extend((0..width_px as usize).map(|x| {
                let shift = 8 - bits - x * bits % 8;
                u32::from(row[x * bits / 8] >> shift) & ((1 << bits) - 1)
            })),
        }
    }
    Ok(ids)
}

/// Reads a list of masks, or an object that holds one.
fn read_mask_file(path: &Path) -> Result<MaskObject, SegmentError> {
    let bytes = fs_err::read(path)?;
    let is_list = bytes.iter().find(|byte| !byte.is_ascii_whitespace()) == Some(&b'[');
    let parsed = if is_list {
        serde_json::from_slice(&bytes).map(|annotations| MaskObject { images: Vec::new(), annotations })
    } else {
        serde_json::from_slice(&bytes)
    };
    parsed.map_err(|source| SegmentError::Json { path: path.to_owned(), source })
}

fn rles_of(path: &Path, annotations: Vec<Annotation>) -> Result<Vec<(usize, Rle)>, SegmentError> {
    let rle = |(index, annotation): (usize, Annotation)| match rle_of(annotation.segmentation) {
        Ok(rle) => Ok((index, rle)),
        Err(source) => Err(SegmentError::Rle { path: path.to_owned(), index, source }),
    };
    annotations.into_iter().enumerate().map(rle).collect()
}

fn rle_of(segmentation: Segmentation) -> Result<Rle, RleError> {
    match segmentation {
        Segmentation::Runs { size: [height, width], counts: Counts::Text(text) } => {
            Rle::from_text(width, height, &text)
        }
        Segmentation::Runs { size: [height, width], counts: Counts::Runs(runs) } => {
            Rle::from_counts(width, height, runs)
        }
        Segmentation::Polygons(list) => Err(RleError::Polygons { n_polygons: list.len() }),
    }
}

fn read_data_set(path: &Path) -> Result<BTreeMap<String, Vec<(usize, Rle)>>, SegmentError> {
    let MaskObject { images, annotations } = read_mask_file(path)?;
    let image_ids: Vec<Option<u64>> = annotations.iter().map(|annotation| annotation.image_id).collect();
    let mut rles_of_id: BTreeMap<u64, Vec<(usize, Rle)>> = BTreeMap::new();
    for (index, rle) in rles_of(path, annotations)? {
        if let Some(id) = image_ids[index] {
            rles_of_id.entry(id).or_default().push((index, rle));
        }
    }
    let named =
        images.into_iter().map(|image| (image.file_name, rles_of_id.remove(&image.id).unwrap_or_default()));
    Ok(named.collect())
}

/// Decodes run-length masks and frees them of the photo's distortion.
fn masks_of_rles(
    path: &Path,
    rles: &[(usize, Rle)],
    input: &SegmentInput<'_>,
) -> Result<Vec<Mask>, SegmentError> {
    let mut left_bytes = MAX_MASK_BYTES;
    let mut masks = Vec::new();
    for (_, rle) in rles {
        check_size(path, rle.size_px(), input)?;
        let Some(box_px) = rle.box_px() else { continue };
        let bytes = u64::from(box_px.width_px()) * u64::from(box_px.height_px());
        left_bytes = left_bytes.checked_sub(bytes).ok_or_else(|| too_large(path))?;
        masks.extend(rle.to_mask());
    }
    Ok(match input.undistorter {
        None => masks,
        Some(undistorter) => undistorted(&masks, undistorter, input.image.width(), input.image.height()),
    })
}

/// Maps masks to the ideal image; those that leave it are dropped.
///
/// Pixels look up their source once for all masks: the masks' partition is mapped as one label
/// image, and each mask put together again from its regions.
fn undistorted(masks: &[Mask], undistorter: &Undistorter, width_px: u32, height_px: u32) -> Vec<Mask> {
    let (map, masks_of_region) = partition(masks, width_px, height_px, width_px, height_px, None);
    let labels = undistorter.labels(&map.region_of_pixel, NO_REGION);
    let covered = || {
        let with_position = labels.iter().zip(0_u32..).filter(|(region, _)| **region != NO_REGION);
        with_position.map(|(region, at)| (*region as usize, at % width_px, at / width_px))
    };

    let empty = BoxPx { x0: u32::MAX, y0: u32::MAX, x1: 0, y1: 0 };
    let join = |a: BoxPx, b: BoxPx| BoxPx {
        x0: a.x0.min(b.x0),
        y0: a.y0.min(b.y0),
        x1: a.x1.max(b.x1),
        y1: a.y1.max(b.y1),
    };
    let mut boxes = vec![(empty, 0); map.n_regions as usize];
    for (region, x, y) in covered() {
        let (box_px, area_px) = &mut boxes[region];
        *box_px = join(*box_px, BoxPx { x0: x, y0: y, x1: x + 1, y1: y + 1 });
        *area_px += 1;
    }
    let mut ideal: Vec<Mask> = masks
        .iter()
        .map(|mask| Mask { box_px: empty, inside: Vec::new(), area_px: 0, level: mask.level })
        .collect();
    for ((box_px, area_px), members) in boxes.iter().zip(&masks_of_region).filter(|((_, area), _)| *area > 0)
    {
        for member in members {
            let mask = &mut ideal[*member as usize];
            mask.box_px = join(mask.box_px, *box_px);
            mask.area_px += area_px;
        }
    }
    for mask in ideal.iter_mut().filter(|mask| mask.area_px > 0) {
        mask.inside = vec![false; mask.box_px.width_px() as usize * mask.box_px.height_px() as usize];
    }
    for (region, x, y) in covered() {
        for member in &masks_of_region[region] {
            let mask = &mut ideal[*member as usize];
            let row = (y - mask.box_px.y0) as usize * mask.box_px.width_px() as usize;
            mask.inside[row + (x - mask.box_px.x0) as usize] = true;
        }
    }
    ideal.retain(|mask| mask.area_px > 0);
    ideal
}
