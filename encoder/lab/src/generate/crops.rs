//! Labelled crops of generated things: training data of the embedded encoder.

use std::path::{Path, PathBuf};

use anyhow::Result;
use glam::DVec3;
use image::RgbImage;
use rayon::prelude::*;
use serde::Serialize;
use slag_common::{View, npy};
use slag_models::Crop;
use slag_models::preprocess::{Filter, Preprocess, Resize};

use super::compose::{Layout, looking, pinhole};
use super::grammar::{NOUNS, Noun};
use super::paint::{Colour, Material, word};
use super::render::{NOTHING, Photo, Solids};
use slag_encoder::embed;
use slag_encoder::masks::{BoxPx, Mask, NO_REGION, masks_of_labels};
use slag_encoder::progress::Progress;
use slag_encoder::raster::RasterView;
use slag_encoder::segment::{GraphSegmenter, SegmentInput, Segmenter};
use slag_math::random::Xorshift;

const PHOTO_PX: u32 = 208;
const N_PHOTOS: usize = 14;
/// Masks with fewer pixels are ignored, as in `encode`.
const MIN_MASK_PX: u32 = 200;
const MIN_SHOWN: f64 = 0.3;
/// Smallest share of a segment's pixels that show its thing.
const MIN_PURITY: f64 = 0.8;
/// Smallest share of a thing's pixels in its segment.
const MIN_COVERED: f64 = 0.2;
/// One in this many pairs of noun and colour is held out for testing.
const HELD_OUT_OF: u64 = 7;

/// Crops for training or for testing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Split {
    /// For training.
    Train,
    /// For testing: all pairs of noun and colour, including those held out from training.
    Test,
}

#[derive(Clone, Debug, Serialize)]
pub struct Label {
    pub noun: usize,
    pub colour: Colour,
    pub material: Material,
    pub held_out: bool,
    /// Height divided by the larger horizontal edge.
    pub slenderness: f64,
    pub area_px: u32,
    /// Visible share of the thing.
    pub shown: f64,
    pub cut: bool,
    /// Whether the mask is the segmenter's instead of the true one.
    pub segmented: bool,
}

/// A hash of the words decides, so new nouns do not affect other pairs.
pub fn is_held_out(noun: &Noun, colour: Colour) -> bool {
    // FNV-1a (Fowler, Noll, Vo).
    let words = noun.name.bytes().chain(word(colour).into_bytes());
    let hash =
        words.fold(0xcbf2_9ce4_8422_2325, |h: u64, b| (h ^ u64::from(b)).wrapping_mul(0x100_0000_01b3));
    // A noun with few colours cannot spare any.
    noun.colours().len() > 3 && (hash >> 32) % HELD_OUT_OF == 0
}

/// Writes crops of the scenes of some seeds: `crops.npy` (u8 `[n][edge][edge][3]`, the encoder's input, white
/// outside the mask), `labels.json` (a [`Label`] per crop) and `nouns.json` (their words). Returns the number of
/// crops.
pub fn write(
    folder: &Path,
    split: Split,
    seeds: std::ops::Range<u64>,
    edge_px: u32,
    progress: &dyn Progress,
) -> Result<usize> {
    fs_err::create_dir_all(folder)?;
    let preprocess = Preprocess::new(edge_px, Resize::Pad, Filter::Bicubic, [0.0; 3], [1.0; 3]);
    progress.begin("scenes", "scene", seeds.end - seeds.start, 0);
    let of_seed = |seed: u64| {
        let crops: Vec<(RgbImage, Label)> = crops(split, seed)
            .into_iter()
            .map(|(crop, label)| (preprocess.square(crop.image()), label))
            .collect();
        progress.advance(1);
        crops
    };
    let crops: Vec<(RgbImage, Label)> = seeds.into_par_iter().flat_map_iter(of_seed).collect();
    progress.end();
    let pixels: Vec<u8> = crops.iter().flat_map(|(image, _)| image.as_raw().iter().copied()).collect();
    let edge = edge_px as usize;
    npy::write_file(&folder.join("crops.npy"), &[crops.len(), edge, edge, 3], &pixels)?;
    let labels: Vec<&Label> = crops.iter().map(|(_, label)| label).collect();
    fs_err::write(folder.join("labels.json"), serde_json::to_vec(&labels)?)?;
    let words: Vec<_> = NOUNS
        .iter()
        .map(|noun| {
            serde_json::json!({
                "name": noun.name, "words": noun.words, "kinds": noun.kinds,
                "colours": noun.colours(), "materials": noun.materials(),
            })
        })
        .collect();
    fs_err::write(folder.join("nouns.json"), serde_json::to_vec_pretty(&words)?)?;
    Ok(crops.len())
}

pub(crate) fn crops(split: Split, seed: u64) -> Vec<(Crop, Label)> {
    let allowed = |noun: &Noun, colour| split == Split::Test || !is_held_out(noun, colour);
    let layout = Layout::of_any_kind(seed, &allowed);
    let solids = layout.solids();
    let mut random = Xorshift::new(seed ^ 0xc405);
    let mut out = Vec::new();
    for _ in 0..N_PHOTOS {
        let Some(view) = look_at_something(&layout, &solids, &mut random) else { continue };
        let photo = solids.photo(&view);
        let things = masks_of(&photo);
        // For a third of the photos, the masks come from the segmenter that needs no model.
        let segmented = random.below(3) == 0;
        let masks = if segmented { segments_of(&photo, &view, &things) } else { things.clone() };
        for (thing, mask) in masks {
            let (thing, placed) = (thing as usize, &layout.placed[thing as usize]);
            let shown = f64::from(mask.area_px) / f64::from(photo.unhidden_px[thing].max(1));
            if mask.area_px < MIN_MASK_PX || (shown < MIN_SHOWN && !placed.shell && !segmented) {
                continue;
            }
            // Every photo shows floor and walls, so most of them are skipped.
            if placed.shell && random.below(4) != 0 {
                continue;
            }
            let cut = !segmented && random.below(4) == 0;
            let mask = if cut { cut_mask(&mask, &mut random) } else { mask };
            let Some(crop) = embed::crop(&photo.image, &mask) else { continue };
            let size = placed.bounds.size();
            let label = Label {
                noun: placed.noun,
                colour: placed.object.colours[0],
                material: placed.object.paint.material,
                held_out: is_held_out(&NOUNS[placed.noun], placed.object.colours[0]),
                slenderness: size.z / size.x.max(size.y),
                area_px: mask.area_px,
                shown,
                cut,
                segmented,
            };
            out.push((crop, label));
        }
    }
    out
}

fn look_at_something(layout: &Layout, solids: &Solids, random: &mut Xorshift) -> Option<RasterView> {
    let things: Vec<usize> = (0..layout.placed.len()).filter(|i| !layout.placed[*i].shell).collect();
    if things.is_empty() {
        return None;
    }
    for _ in 0..20 {
        let thing = &solids.things[*random.pick(&things)];
        let field_of_view_rad = random.between(40.0, 75.0).to_radians();
        // The thing fills between a third of the picture's width and all of it.
        let fills = random.between(0.35, 1.1);
        let distance_m = thing.radius_m / (field_of_view_rad / 2.0 * fills).sin();
        let azimuth = random.between(0.0, std::f64::consts::TAU);
        let elevation = random.between(-5.0, 50.0).to_radians();
        let away =
            DVec3::new(azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin());
        let position = thing.centre + away * distance_m;
        if position.z > 0.15 && layout.is_walkable(position) {
            let aside = DVec3::from([0; 3].map(|_| random.signed())) * 0.25 * thing.radius_m;
            let camera_from_world = looking(position, thing.centre + aside - position);
            return Some(RasterView {
                camera_from_world,
                intrinsics: pinhole([PHOTO_PX; 2], field_of_view_rad),
            });
        }
    }
    None
}

fn masks_of(photo: &Photo) -> Vec<(u32, Mask)> {
    let label = |thing: &u16| if *thing == NOTHING { NO_REGION } else { u32::from(*thing) };
    let labels: Vec<u32> = photo.thing_of_pixel.iter().map(label).collect();
    masks_of_labels(&labels, photo.image.width(), photo.unhidden_px.len(), u64::MAX).unwrap_or_default()
}

/// Returns the segments that mostly show one thing, with that thing.
fn segments_of(photo: &Photo, raster_view: &RasterView, things: &[(u32, Mask)]) -> Vec<(u32, Mask)> {
    let view = View {
        name: String::new(),
        image_path: PathBuf::new(),
        intrinsics: raster_view.intrinsics,
        camera_from_world: raster_view.camera_from_world,
    };
    let input = SegmentInput {
        view: &view,
        image: &photo.image,
        valid: None,
        undistorter: None,
        depth: None,
        pool: None,
    };
    let segments = GraphSegmenter::default().segment(&input).unwrap_or_default();
    let width = photo.image.width();
    let thing_of = |mask: &Mask| {
        let mut n_px = vec![0_u32; photo.unhidden_px.len()];
        let BoxPx { x0, y0, x1, y1 } = mask.box_px;
        let pixels = (y0..y1).flat_map(|y| (x0..x1).map(move |x| (x, y)));
        for ((x, y), _) in pixels.zip(mask.inside.iter()).filter(|(_, inside)| *inside) {
            let thing = photo.thing_of_pixel[(y * width + x) as usize];
            n_px.get_mut(usize::from(thing)).into_iter().for_each(|n| *n += 1);
        }
        let (n, thing) = things.iter().map(|(thing, _)| (n_px[*thing as usize], *thing)).max()?;
        let whole = things.iter().find(|(of, _)| *of == thing)?.1.area_px;
        let pure = f64::from(n) >= MIN_PURITY * f64::from(mask.area_px);
        (pure && f64::from(n) >= MIN_COVERED * f64::from(whole)).then_some(thing)
    };
    segments.into_iter().filter_map(|mask| Some((thing_of(&mask)?, mask))).collect()
}

fn cut_mask(mask: &Mask, random: &mut Xorshift) -> Mask {
    let (width, height) = (mask.box_px.width_px(), mask.box_px.height_px());
    let angle = random.between(0.0, std::f64::consts::TAU);
    let (nx, ny) = (angle.cos(), angle.sin());
    let along = |x: u32, y: u32| {
        (f64::from(x) / f64::from(width) - 0.5) * nx + (f64::from(y) / f64::from(height) - 0.5) * ny
    };
    let limit = random.between(0.0, 0.35);
    let kept = |x: u32, y: u32| mask.inside.get((y * width + x) as usize) && along(x, y) < limit;
    let places = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    let labels: Vec<u32> = places.map(|(x, y)| if kept(x, y) { 0 } else { NO_REGION }).collect();
    let piece = masks_of_labels(&labels, width, 1, u64::MAX).and_then(|mut masks| masks.pop());
    let Some((_, piece)) = piece.filter(|(_, piece)| piece.area_px >= MIN_MASK_PX) else {
        return mask.clone();
    };
    let (left, top) = (mask.box_px.x0, mask.box_px.y0);
    let BoxPx { x0, y0, x1, y1 } = piece.box_px;
    let box_px = BoxPx { x0: left + x0, y0: top + y0, x1: left + x1, y1: top + y1 };
    Mask { box_px, level: mask.level, ..piece }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn held_out_pairs_are_never_in_the_training_split() {
        let held_out = |split| {
            let of_seed = |seed| crops(split, seed);
            let labels = (0..9).flat_map(of_seed).map(|(_, label)| label);
            labels.filter(|label| is_held_out(&NOUNS[label.noun], label.colour)).count()
        };
        assert_eq!(held_out(Split::Train), 0);
        assert!(held_out(Split::Test) > 20);
    }

    /// A crop has its label's number of pixels inside its mask, and is white outside.
    #[test]
    fn crops_are_what_their_labels_say() {
        let of_seed = |seed| crops(Split::Test, seed);
        let made: Vec<(Crop, Label)> = (0..6).flat_map(of_seed).collect();
        let n_segmented = made.iter().filter(|(_, label)| label.segmented).count();
        assert!(n_segmented > 20 && made.len() - n_segmented > 20, "{n_segmented} of {}", made.len());
        for (crop, label) in &made {
            assert_eq!(crop.inside().iter().filter(|inside| **inside).count(), label.area_px as usize);
            let outside = crop.image().pixels().zip(crop.inside()).filter(|(_, inside)| !**inside);
            assert!(outside.into_iter().all(|(pixel, _)| pixel.0 == [255; 3]));
            // A segment may include surroundings of the thing.
            assert!(label.shown > 0.0 && (label.shown <= 1.0 || label.segmented));
            assert!(NOUNS[label.noun].colours().contains(&label.colour));
        }
        let again: Vec<(Crop, Label)> = (0..6).flat_map(of_seed).collect();
        assert!(made.iter().zip(&again).all(|(a, b)| a.0 == b.0));
    }
}
