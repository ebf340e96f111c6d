//! Evaluates an encoder on crops of generated things: classification by noun, colour and material.
//!
//! Crops of [`Split::Test`] show shapes from other seeds than the training data, in all pairs of noun and colour, including
//! those held out from training.

use std::fmt;
use std::path::Path;
use std::time::Instant;

use rayon::prelude::*;
use serde::Serialize;
use slag_models::{Crop, InferenceError, ModelDir, ModelError, SessionOptions};

use super::settings::ABSENT;
use crate::generate::crops::{self, Label, Split};
use crate::generate::grammar::Noun;
use crate::generate::paint::{Colour, Material};
use slag_encoder::progress::Progress;
use slag_math::dot;
use slag_math::stats::{Rank, quantile};

/// A crop shows a whole thing if its mask is the true one and more than this share of the thing is visible.
const WHOLE: f64 = 0.6;
/// Scenes with crops in memory at a time.
const SCENES_AT_A_TIME: u64 = 16;
/// Timed crops and texts.
const N_TIMED: usize = 64;

/// Error of the evaluation.
#[derive(Debug, thiserror::Error)]
pub enum EncoderEvalError {
    /// A model cannot be opened.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The encoder failed.
    #[error(transparent)]
    Encode(#[from] InferenceError),
    /// The picture cannot be written.
    #[error("{}: {source}", path.display())]
    Picture {
        /// The picture.
        path: std::path::PathBuf,
        /// The reason.
        source: image::ImageError,
    },
    /// The scenes gave no crops.
    #[error("the scenes gave no crops; generate more with --n-scenes")]
    NoCrops,
}

/// Correct answers over a set of crops.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Tally {
    /// Crops.
    pub n_crops: usize,
    /// Crops with the correct noun.
    pub noun: usize,
    /// Crops with the correct main colour.
    pub colour: usize,
    /// Crops with the correct main material.
    pub material: usize,
}

/// Correct answers for a noun, over whole things.
#[derive(Clone, Debug, Serialize)]
pub struct NounReport {
    /// The noun.
    pub noun: String,
    /// Its crops.
    pub n_crops: usize,
    /// Crops with this noun as answer.
    pub n_right: usize,
    /// Most frequent wrong answers, with their counts.
    pub taken_for: Vec<(String, usize)>,
}

/// Figures of an encoder.
#[derive(Clone, Debug, Serialize)]
pub struct EncoderReport {
    /// Its name.
    pub encoder: String,
    /// Number of scenes.
    pub n_scenes: u64,
    /// Seed of the first scene; the others follow.
    pub first_seed: u64,
    /// Tallies of several sets of crops, with their names.
    pub tallies: Vec<(String, Tally)>,
    /// Each noun.
    pub nouns: Vec<NounReport>,
    /// Lowest cosine of a match.
    pub threshold: Option<f32>,
    /// Share of the crops that match their own noun.
    pub found: Option<f64>,
    /// Share of the pairs of crop and another noun that match.
    pub found_others: Option<f64>,
    /// Share of the pairs of crop and absent category that match.
    pub found_absent: Option<f64>,
    /// Median milliseconds per crop with one thread.
    pub ms_per_crop: f64,
    /// Median milliseconds per text with one thread.
    pub ms_per_text: f64,
}

/// Evaluates an encoder on the crops of scenes.
///
/// # Errors
/// [`EncoderEvalError`].
pub fn evaluate(
    models: &ModelDir,
    options: &SessionOptions,
    nouns: &[Noun],
    seeds: std::ops::Range<u64>,
    confusion: Option<&Path>,
    progress: &dyn Progress,
) -> Result<EncoderReport, EncoderEvalError> {
    let mut text = models.text_encoder(options)?;
    let mut encode = |texts: Vec<String>| -> Result<Vec<Vec<f32>>, EncoderEvalError> {
        Ok(texts.iter().map(|content| text.encode(content)).collect::<Result<_, _>>()?)
    };
    let of_nouns = encode(nouns.iter().map(|noun| format!("a {}", noun.name)).collect())?;
    let of_colours = encode(Colour::ALL.iter().map(|c| format!("something {}", c.word())).collect())?;
    let of_materials =
        encode(Material::ALL.iter().map(|m| format!("something made of {}", m.word())).collect())?;
    let of_absent = encode(ABSENT.iter().map(|thing| format!("a {thing}")).collect())?;
    let ms_per_text = timed(|i| text.encode(&nouns[i % nouns.len()].name).map(|_| ()))?;

    let mut image = models.image_encoder(options)?;
    let mut seen: Vec<Seen> = Vec::new();
    let mut found = [0_u64; 3];
    let mut timing = Vec::new();
    let threshold = models.threshold();
    progress.begin("scenes", "scene", seeds.end - seeds.start, 0);
    for first in seeds.clone().step_by(SCENES_AT_A_TIME as usize) {
        let seeds = first..(first + SCENES_AT_A_TIME).min(seeds.end);
        let n_scenes = seeds.end - seeds.start;
        let (crops, labels): (Vec<Crop>, Vec<Label>) =
            seeds.into_par_iter().flat_map_iter(|seed| crops::crops(Split::Test, nouns, seed)).unzip();
        if timing.is_empty() {
            timing = crops.iter().take(N_TIMED).cloned().collect();
        }
        let vectors = image.encode(&crops)?;
        for (vector, label) in vectors.chunks_exact(models.dim()).zip(labels) {
            let scores: Vec<f32> = of_nouns.iter().map(|of| dot(of, vector)).collect();
            let threshold = threshold.unwrap_or(f32::INFINITY);
            let n_found = scores.iter().filter(|score| **score >= threshold).count() as u64;
            let own = u64::from(scores[label.noun] >= threshold);
            let absent = of_absent.iter().filter(|of| dot(of, vector) >= threshold).count() as u64;
            found.iter_mut().zip([own, n_found - own, absent]).for_each(|(sum, n)| *sum += n);
            let best = |of: &[Vec<f32>]| argmax(of.iter().map(|of| dot(of, vector)));
            seen.push((label, argmax(scores.into_iter()), best(&of_colours), best(&of_materials)));
        }
        progress.advance(n_scenes);
    }
    progress.end();
    if seen.is_empty() {
        return Err(EncoderEvalError::NoCrops);
    }
    let ms_per_crop = timed(|i| image.encode(&timing[i % timing.len()..][..1]).map(|_| ()))?;
    let n = seen.len() as f64;
    let share = |count: u64, of: usize| threshold.map(|_| count as f64 / (n * of as f64));
    let report = EncoderReport {
        encoder: models.encoder_id().name.clone(),
        n_scenes: seeds.end - seeds.start,
        first_seed: seeds.start,
        tallies: tallies(&seen),
        nouns: of_each_noun(&seen, nouns),
        threshold,
        found: share(found[0], 1),
        found_others: share(found[1], nouns.len() - 1),
        found_absent: share(found[2], ABSENT.len()),
        ms_per_crop,
        ms_per_text,
    };
    if let Some(path) = confusion {
        let picture = picture(&seen, nouns.len());
        picture.save(path).map_err(|source| EncoderEvalError::Picture { path: path.to_owned(), source })?;
    }
    Ok(report)
}

/// A crop's label, and its best noun, colour and material.
type Seen = (Label, usize, usize, usize);
/// Whether a crop belongs to a set.
type IsIn = fn(&Label) -> bool;

fn is_whole(label: &Label) -> bool {
    !label.cut && !label.segmented && label.shown > WHOLE
}

fn argmax(scores: impl Iterator<Item = f32>) -> usize {
    scores.enumerate().fold((0, f32::NEG_INFINITY), |best, at| if at.1 > best.1 { at } else { best }).0
}

fn tallies(seen: &[Seen]) -> Vec<(String, Tally)> {
    let sets: [(&str, IsIn); 6] = [
        ("whole things", is_whole),
        ("whole things, in held-out pairs of noun and colour", |l| is_whole(l) && l.held_out),
        ("cut or half hidden", |l| !l.segmented && !is_whole(l)),
        ("the graph segmenter's segments", |l| l.segmented),
        ("all, in held-out pairs", |l| l.held_out),
        ("all", |_| true),
    ];
    let tally = |is_in: IsIn| {
        let mut tally = Tally::default();
        for (label, noun, colour, material) in seen.iter().filter(|s| is_in(&s.0)) {
            tally.n_crops += 1;
            tally.noun += usize::from(*noun == label.noun);
            tally.colour += usize::from(Colour::ALL[*colour] == label.colour);
            tally.material += usize::from(Material::ALL[*material] == label.material);
        }
        tally
    };
    sets.map(|(name, is_in)| (name.to_owned(), tally(is_in))).to_vec()
}

/// Returns the confusion matrix over whole things: answers by true noun.
fn confusion(seen: &[Seen], n_nouns: usize) -> Vec<Vec<usize>> {
    let mut counts = vec![vec![0; n_nouns]; n_nouns];
    seen.iter().filter(|s| is_whole(&s.0)).for_each(|(label, noun, ..)| counts[label.noun][*noun] += 1);
    counts
}

fn of_each_noun(seen: &[Seen], nouns: &[Noun]) -> Vec<NounReport> {
    let counts = confusion(seen, nouns.len());
    let report = |(i, counts): (usize, &Vec<usize>)| {
        let mut others: Vec<usize> = (0..nouns.len()).filter(|j| *j != i && counts[*j] > 0).collect();
        others.sort_by_key(|j| (std::cmp::Reverse(counts[*j]), *j));
        NounReport {
            noun: nouns[i].name.clone(),
            n_crops: counts.iter().sum(),
            n_right: counts[i],
            taken_for: others.iter().take(3).map(|j| (nouns[*j].name.clone(), counts[*j])).collect(),
        }
    };
    counts.iter().enumerate().map(report).collect()
}

/// Draws the confusion matrix: a row per true noun, a column per answer; darker is more frequent.
fn picture(seen: &[Seen], n_nouns: usize) -> image::GrayImage {
    const EDGE_PX: u32 = 8;
    let counts = confusion(seen, n_nouns);
    image::GrayImage::from_fn(n_nouns as u32 * EDGE_PX, n_nouns as u32 * EDGE_PX, |x, y| {
        let row = &counts[(y / EDGE_PX) as usize];
        let share = row[(x / EDGE_PX) as usize] as f64 / row.iter().sum::<usize>().max(1) as f64;
        image::Luma([(255.0 * (1.0 - share.sqrt())) as u8])
    })
}

/// Returns the median time of a call, milliseconds.
fn timed(mut call: impl FnMut(usize) -> Result<(), InferenceError>) -> Result<f64, InferenceError> {
    let mut times = Vec::with_capacity(N_TIMED);
    for i in 0..N_TIMED {
        let start = Instant::now();
        call(i)?;
        times.push(start.elapsed().as_secs_f64() * 1e3);
    }
    Ok(quantile(&mut times, 500, Rank::Nearest).unwrap_or_default())
}

impl fmt::Display for EncoderReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{} on {} scenes from seed {}\n", self.encoder, self.n_scenes, self.first_seed)?;
        writeln!(f, "{:<62} {:>7} {:>7} {:>7} {:>9}", "top-1, %", "crops", "noun", "colour", "material")?;
        for (name, t) in &self.tallies {
            let percent = |n: usize| 100.0 * n as f64 / t.n_crops.max(1) as f64;
            let [noun, colour, material] = [t.noun, t.colour, t.material].map(percent);
            writeln!(f, "{name:<62} {:>7} {noun:>7.1} {colour:>7.1} {material:>9.1}", t.n_crops)?;
        }
        writeln!(f, "\n{:<20} {:>6} {:>6}  taken for", "noun", "crops", "%")?;
        for noun in &self.nouns {
            let percent = 100.0 * noun.n_right as f64 / noun.n_crops.max(1) as f64;
            let others: Vec<String> =
                noun.taken_for.iter().map(|(other, n)| format!("{other} {n}")).collect();
            writeln!(f, "{:<20} {:>6} {percent:>6.0}  {}", noun.noun, noun.n_crops, others.join(", "))?;
        }
        if let (Some(threshold), Some(own), Some(others), Some(absent)) =
            (self.threshold, self.found, self.found_others, self.found_absent)
        {
            writeln!(
                f,
                "\nabove the threshold {threshold:.3}: own noun {:.1} %, another {:.2} %, absent categories {:.2} %",
                100.0 * own,
                100.0 * others,
                100.0 * absent
            )?;
        }
        writeln!(f, "{:.2} ms per crop, {:.2} ms per text, one thread", self.ms_per_crop, self.ms_per_text)
    }
}
