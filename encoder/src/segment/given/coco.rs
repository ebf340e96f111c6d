//! Run-length masks of JSON files: SAM's lists and COCO data sets.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead, BufReader};
use std::path::Path;

use serde::Deserialize;
use slag_common::files;

use crate::ingest::Undistorter;
use crate::masks::regions::partition;
use crate::masks::rle::{Rle, RleError};
use crate::masks::{Bits, BoxPx, Mask, NO_REGION, masks_of_labels};
use crate::segment::{MAX_MASK_BYTES, SegmentError, SegmentInput};

/// By file name, with indices in the file.
pub(super) type MasksOfImage = BTreeMap<String, Vec<(usize, Rle)>>;

#[derive(Deserialize)]
struct Annotation {
    segmentation: Segmentation,
    /// Present in data sets only.
    image_id: Option<u64>,
}

#[derive(Deserialize)]
#[serde(
    untagged,
    expecting = "a segmentation is {size: [height, width], counts}, counts a text or numbers from 0, or polygons"
)]
enum Segmentation {
    Runs {
        size: [u32; 2],
        counts: Counts,
    },
    /// Each `x0, y0, x1, y1, ...`, pixels.
    Polygons(Vec<Vec<f64>>),
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Counts {
    Text(String),
    Runs(Vec<u32>),
}

#[derive(Deserialize)]
struct MaskFile {
    #[serde(default)]
    images: Vec<DataSetImage>,
    annotations: Vec<Annotation>,
}

#[derive(Deserialize)]
struct DataSetImage {
    id: u64,
    file_name: String,
    width: Option<u32>,
    height: Option<u32>,
}

/// The masks of one photo, with their indices in the file.
pub(super) fn read_list(path: &Path) -> Result<Vec<(usize, Rle)>, SegmentError> {
    rles_of(path, parse(path)?)
}

/// A list of masks, or an object with a list as `annotations`.
fn parse(path: &Path) -> Result<MaskFile, SegmentError> {
    let bytes = files::read(path)?;
    let text = files::text_of(&bytes).map_err(|error| SegmentError::of_file(path, error))?;
    let parsed = if text.trim_start().starts_with('[') {
        serde_json::from_str(text).map(|annotations| MaskFile { images: Vec::new(), annotations })
    } else {
        serde_json::from_str(text)
    };
    let expected = "expected SAM's list of masks, each with segmentation {size, counts}, or a COCO data set";
    parsed.map_err(|error| SegmentError::of_file(path, format!("{error}; {expected}")))
}

fn rles_of(path: &Path, file: MaskFile) -> Result<Vec<(usize, Rle)>, SegmentError> {
    let sizes_px: BTreeMap<u64, [u32; 2]> =
        file.images.iter().filter_map(|image| Some((image.id, [image.width?, image.height?]))).collect();
    let rle = |(index, annotation): (usize, Annotation)| {
        let size_px = annotation.image_id.and_then(|id| sizes_px.get(&id).copied());
        match rle_of(annotation.segmentation, size_px) {
            Ok(rle) => Ok((index, rle)),
            Err(error) => Err(SegmentError::of_file(path, format!("mask {index}: {error}"))),
        }
    };
    file.annotations.into_iter().enumerate().map(rle).collect()
}

fn rle_of(segmentation: Segmentation, size_px: Option<[u32; 2]>) -> Result<Rle, RleError> {
    match segmentation {
        Segmentation::Runs { size: [height, width], counts: Counts::Text(text) } => {
            Rle::from_text(width, height, &text)
        }
        Segmentation::Runs { size: [height, width], counts: Counts::Runs(runs) } => {
            Rle::from_counts(width, height, runs)
        }
        Segmentation::Polygons(list) => match size_px {
            Some([width, height]) => Rle::from_polygons(width, height, &list),
            None => Err(RleError::Polygons { n_polygons: list.len() }),
        },
    }
}

pub(super) fn inconsistent(path: &Path, what: &str) -> SegmentError {
    SegmentError::of_file(path, format!("{what}; correct it, or export the data set again"))
}

pub(super) fn read_data_set(path: &Path) -> Result<MasksOfImage, SegmentError> {
    let file = parse(path)?;
    let image_ids: Vec<Option<u64>> = file.annotations.iter().map(|annotation| annotation.image_id).collect();
    let inconsistent = |what: String| inconsistent(path, &what);
    let mut rles_of_id: BTreeMap<u64, Vec<(usize, Rle)>> = BTreeMap::new();
    let names: Vec<_> =
        file.images.iter().map(|image| (image.id, image.file_name.replace('\\', "/"))).collect();
    for image in &file.images {
        if rles_of_id.insert(image.id, Vec::new()).is_some() {
            return Err(inconsistent(format!("two images have the id {}", image.id)));
        }
    }
    for (index, rle) in rles_of(path, file)? {
        match image_ids[index].and_then(|id| rles_of_id.get_mut(&id)) {
            Some(rles) => rles.push((index, rle)),
            None => {
                let id = image_ids[index].map_or("none".into(), |id| id.to_string());
                return Err(inconsistent(format!("mask {index} has image_id {id}, which no image has")));
            }
        }
    }
    let mut named = MasksOfImage::new();
    for (id, file_name) in names {
        if named.insert(file_name.clone(), rles_of_id.remove(&id).unwrap_or_default()).is_some() {
            return Err(inconsistent(format!("two images have the file_name {file_name:?}")));
        }
    }
    Ok(named)
}

/// Entry of a photo: the one of its name; or else the one whose name is an ending of it, or the other way round, at a
/// folder; or else the one with Roboflow's name for it, `NAME_jpg.rf.HASH.jpg`.
pub(super) fn entry<'a>(
    masks_of_image: &'a MasksOfImage,
    name: &str,
) -> Option<(&'a String, &'a Vec<(usize, Rle)>)> {
    let is_ending =
        |long: &str, short: &str| long.strip_suffix(short).is_some_and(|rest| rest.ends_with('/'));
    let file = name.rsplit('/').next().unwrap_or(name);
    let exported = format!("{}.rf.", file.replace('.', "_"));
    let one = |is: &dyn Fn(&str) -> bool| {
        let mut found = masks_of_image.iter().filter(|(entry, _)| is(entry));
        found.next().filter(|_| found.next().is_none())
    };
    masks_of_image
        .get_key_value(name)
        .or_else(|| one(&|entry| is_ending(entry, name) || is_ending(name, entry)))
        .or_else(|| one(&|entry| entry.rsplit('/').next().is_some_and(|entry| entry.starts_with(&exported))))
}

/// Tells of masks without a pixel, such as the annotations of data sets that have boxes alone.
pub(super) fn without_pixels<'a>(
    path: &Path,
    rles: impl IntoIterator<Item = &'a (usize, Rle)>,
) -> Option<String> {
    let (mut n, mut empty) = (0, Vec::new());
    for (index, rle) in rles {
        n += 1;
        empty.extend(rle.box_px().is_none().then_some(*index));
    }
    let (first, n_empty) = (empty.iter().min()?, empty.len());
    let path = path.display();
    Some(format!(
        "{path}: {n_empty} of {n} masks have no pixels, the first is mask {first}: a box alone is no mask"
    ))
}

pub(super) fn masks_of_rles(
    path: &Path,
    rles: &[(usize, Rle)],
    input: &SegmentInput<'_>,
) -> Result<Vec<Mask>, SegmentError> {
    let mut left_bytes = MAX_MASK_BYTES;
    let mut masks = Vec::new();
    for (_, rle) in rles {
        check_size(path, rle.size_px(), input)?;
        let Some(box_px) = rle.box_px() else { continue };
        left_bytes = left_bytes.checked_sub(box_px.area_px()).ok_or_else(|| too_large(path))?;
        masks.extend(rle.to_mask());
    }
    Ok(match input.undistorter {
        None => masks,
        Some(undistorter) => undistorted(&masks, undistorter, input.image.width(), input.image.height()),
    })
}

/// Maps masks to the undistorted photo; masks outside it are dropped. Each pixel is looked up once for all masks: their
/// partition is mapped as one label image, and each mask is reassembled from its regions.
pub(super) fn undistorted(
    masks: &[Mask],
    undistorter: &Undistorter,
    width_px: u32,
    height_px: u32,
) -> Vec<Mask> {
    let (map, masks_of_region) = partition(masks, width_px, height_px, width_px, height_px, None);
    let labels = undistorter.labels(&map.region_of_pixel, NO_REGION);
    let regions = masks_of_labels(&labels, width_px, map.n_regions as usize, u64::MAX).unwrap_or_default();
    let mut parts_of_mask: Vec<Vec<&Mask>> = vec![Vec::new(); masks.len()];
    for (region, part) in &regions {
        masks_of_region[*region as usize].iter().for_each(|mask| parts_of_mask[*mask as usize].push(part));
    }
    let joined = |(mask, parts): (&Mask, Vec<&Mask>)| {
        let box_px = parts.iter().map(|part| part.box_px).reduce(BoxPx::join)?;
        let mut inside = Bits::of(false, box_px.area_px() as usize);
        for part in &parts {
            let BoxPx { x0, y0, x1, y1 } = part.box_px;
            let pixels = (y0..y1).flat_map(|y| (x0..x1).map(move |x| (x, y))).zip(part.inside.iter());
            pixels.filter(|(_, is)| *is).for_each(|((x, y), _)| inside.set(box_px.place_of(x, y), true));
        }
        let area_px = parts.iter().map(|part| part.area_px).sum();
        Some(Mask { box_px, inside, area_px, level: mask.level })
    };
    masks.iter().zip(parts_of_mask).filter_map(joined).collect()
}

pub(super) fn too_large(path: &Path) -> SegmentError {
    let advice = "remove stray pixels or give fewer masks";
    let problem = format!("the bounding boxes of the masks exceed {MAX_MASK_BYTES} px in total; {advice}");
    SegmentError::of_file(path, problem)
}

pub(super) fn check_size(
    path: &Path,
    [width, height]: [u32; 2],
    input: &SegmentInput<'_>,
) -> Result<(), SegmentError> {
    let expected_px = [input.image.width(), input.image.height()];
    if [width, height] == expected_px {
        return Ok(());
    }
    let view = input.view.name.clone();
    Err(SegmentError::Size { path: path.to_owned(), view, found_px: [width, height], expected_px })
}

/// Memory for the PNG decoder beside the pixels.
const PNG_OVERHEAD_BYTES: usize = 1 << 20;

/// Least number of values in the seams of a blurred image.
const MIN_SOFT: usize = 8;
/// Longest run of pixels in a seam.
const MAX_SEAM_PX: usize = 2;

/// Number of values in the seams of a mask image that was blurred, drawn with antialiasing or enlarged smoothly;
/// `None` for one of ids. In seams, short runs have values between those beside them.
pub(super) fn n_soft(ids: &[u32], width: usize) -> Option<usize> {
    let mut values = BTreeSet::new();
    let (mut n_between, mut n_runs) = (0, 0);
    for row in ids.chunks_exact(width.max(1)) {
        let runs: Vec<&[u32]> = row.chunk_by(u32::eq).collect();
        for sides in runs.windows(3) {
            let [low, value, high] = [sides[0][0], sides[1][0], sides[2][0]];
            n_runs += 1;
            if sides[1].len() <= MAX_SEAM_PX && (low.min(high) < value && value < low.max(high)) {
                n_between += 1;
                values.insert(value);
            }
        }
    }
    (values.len() >= MIN_SOFT && 4 * n_between > n_runs).then_some(values.len())
}

/// Ids of a PNG of the photo's size, row-major; of a palette, the indices.
pub(super) fn read_ids(path: &Path, input: &SegmentInput<'_>) -> Result<Vec<u32>, SegmentError> {
    let failed = |error| SegmentError::of_file(path, format!("{error}; write the mask image again"));
    let n_pixels = input.image.width() as usize * input.image.height() as usize;
    let limits = png::Limits { bytes: 2 * n_pixels + PNG_OVERHEAD_BYTES };
    let mut file = BufReader::new(files::open(path)?);
    if let Some(stranger) = files::stand_in(file.fill_buf()?) {
        return Err(SegmentError::of_file(path, stranger));
    }
    let mut decoder = png::Decoder::new_with_limits(file, limits);
    decoder.set_transformations(png::Transformations::IDENTITY);
    let (width_px, height_px) = decoder.read_header_info().map_err(failed)?.size();
    check_size(path, [width_px, height_px], input)?;
    let mut reader = decoder.read_info().map_err(failed)?;
    let (color, depth) = reader.output_color_type();
    let other = match color {
        png::ColorType::Grayscale | png::ColorType::Indexed => None,
        png::ColorType::Rgb => Some("RGB"),
        png::ColorType::GrayscaleAlpha => Some("gray and alpha"),
        png::ColorType::Rgba => Some("RGBA"),
    };
    if let Some(other) = other {
        let advice = "write a PNG with up to 16 bits of gray, or with a palette";
        return Err(SegmentError::of_file(path, format!("found {other} pixels, expected ids; {advice}")));
    }
    // Bounded: at most 16 bits per pixel of the photo's size.
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
            // Several pixels per byte, the leftmost in the highest bits; each row starts at a byte.
            _ => ids.extend((0..width_px as usize).map(|x| {
                let shift = 8 - bits - x * bits % 8;
                u32::from(row[x * bits / 8] >> shift) & ((1 << bits) - 1)
            })),
        }
    }
    Ok(ids)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Annotations of boxes alone, and SAM's runs of nothing.
    #[test]
    fn masks_without_pixels_are_counted() {
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("masks.json");
        let of = |outlines: &str| {
            let image = r#"{"id": 1, "file_name": "a.png", "width": 8, "height": 8}"#;
            let annotations: Vec<String> = (outlines.split(';'))
                .map(|outline| format!(r#"{{"image_id": 1, "segmentation": {outline}}}"#))
                .collect();
            let text = format!(r#"{{"images": [{image}], "annotations": [{}]}}"#, annotations.join(","));
            fs_err::write(&path, text).expect("writes");
            let masks = read_data_set(&path).expect("masks");
            without_pixels(&path, masks.values().flatten())
        };
        let whole = "[[1,1,5,1,5,5]]";
        assert_eq!(of(whole), None);
        let told = of(&format!(r#"{whole};[];{{"size": [8, 8], "counts": [64]}}"#)).expect("told");
        assert!(told.contains("2 of 3 masks have no pixels, the first is mask 1"), "{told}");
    }
}
