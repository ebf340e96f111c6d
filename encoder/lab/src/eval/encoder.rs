//! Evaluates an encoder on crops of generated things: classification by noun, colour and material.
//!
//! Crops of [`Split::Test`] show shapes from other seeds than the training data, in all pairs of noun and colour,
//! including those held out from training.

use std::fmt;

use anyhow::{Result, bail};
use clap::{Args, ValueEnum};
use rayon::prelude::*;
use serde::Serialize;
use slag_encoder::cli::common::{ModelArgs, open_models};
use slag_models::{Crop, TextEncoder};

use super::judge::ABSENT;
use crate::generate::crops::{self, Label, Split};
use crate::generate::grammar::{NOUNS, Noun};
use crate::generate::paint::{Colour, Material, word};
use crate::harness::Times;
use crate::table::Table;
use slag_encoder::progress::Progress;
use slag_math::dot;

/// A crop shows a whole thing if its mask is the true one and more than this share of the thing is visible.
const WHOLE: f64 = 0.6;
const SCENES_AT_A_TIME: u64 = 16;
const N_TIMED: usize = 64;

/// `eval encoder`.
#[derive(Debug, Args)]
pub(crate) struct EncoderArgs {
    /// The encoder.
    #[command(flatten)]
    models: ModelArgs,
    /// Number of scenes to take crops from.
    #[arg(long, value_name = "N", default_value_t = 300)]
    n_scenes: u64,
    /// Seed of the first scene; the others follow. The embedded encoders were trained on seeds 1000000 to 1012799.
    #[arg(long, default_value_t = 9_000_000)]
    seed: u64,
}

#[derive(Clone, Copy, Debug, Default, Serialize)]
struct Tally {
    n_crops: usize,
    noun: usize,
    colour: usize,
    material: usize,
}

/// Correct answers for a noun, over whole things.
#[derive(Clone, Debug, Serialize)]
struct NounReport {
    noun: String,
    n_crops: usize,
    n_right: usize,
    /// Most frequent wrong answers, with their counts.
    taken_for: Vec<(String, usize)>,
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct EncoderReport {
    encoder: String,
    n_scenes: u64,
    first_seed: u64,
    tallies: Vec<(String, Tally)>,
    nouns: Vec<NounReport>,
    /// Lowest cosine of a match.
    threshold: Option<f32>,
    found: Option<f64>,
    /// Share of the pairs of crop and another noun that match.
    found_others: Option<f64>,
    /// Share of the pairs of crop and absent category that match.
    found_absent: Option<f64>,
    ms_per_crop: f64,
    /// Median milliseconds per text with one thread.
    ms_per_text: f64,
}

struct Texts {
    nouns: Vec<Vec<f32>>,
    colours: Vec<Vec<f32>>,
    materials: Vec<Vec<f32>>,
    absent: Vec<Vec<f32>>,
}

impl Texts {
    fn encode(text: &mut dyn TextEncoder) -> Result<Self> {
        let mut encode = |texts: Vec<String>| -> Result<Vec<Vec<f32>>> {
            Ok(texts.iter().map(|content| text.encode(content)).collect::<Result<_, _>>()?)
        };
        Ok(Self {
            nouns: encode(NOUNS.iter().map(|noun| format!("a {}", noun.name)).collect())?,
            colours: encode(
                Colour::value_variants().iter().map(|c| format!("something {}", word(c))).collect(),
            )?,
            materials: encode(
                Material::value_variants().iter().map(|m| format!("something made of {}", word(m))).collect(),
            )?,
            absent: encode(ABSENT.split(',').map(|thing| format!("a {thing}")).collect())?,
        })
    }
}

pub(crate) fn run(args: &EncoderArgs, progress: &dyn Progress) -> Result<EncoderReport> {
    let (models, session) = open_models(&args.models)?;
    let (nouns, seeds) = (&NOUNS[..], args.seed..args.seed + args.n_scenes);
    let mut text = models.text_encoder(&session)?;
    let texts = Texts::encode(&mut *text)?;
    let text_times = Times::measure(0, N_TIMED, |i| text.encode(&nouns[i % nouns.len()].name).map(|_| ()))?;

    let mut image = models.image_encoder(&session)?;
    let mut seen: Vec<Seen> = Vec::new();
    let mut found = [0_u64; 3];
    let mut timing = Vec::new();
    let threshold = models.threshold();
    progress.begin("scenes", "scene", seeds.end - seeds.start, 0);
    for first in seeds.clone().step_by(SCENES_AT_A_TIME as usize) {
        let seeds = first..(first + SCENES_AT_A_TIME).min(seeds.end);
        let n_scenes = seeds.end - seeds.start;
        let (crops, labels): (Vec<Crop>, Vec<Label>) =
            seeds.into_par_iter().flat_map_iter(|seed| crops::crops(Split::Test, seed)).unzip();
        if timing.is_empty() {
            timing = crops.iter().take(N_TIMED).cloned().collect();
        }
        let vectors = image.encode(&crops)?;
        for (vector, label) in vectors.chunks_exact(models.dim()).zip(labels) {
            let scores: Vec<f32> = texts.nouns.iter().map(|of| dot(of, vector)).collect();
            let threshold = threshold.unwrap_or(f32::INFINITY);
            let n_found = scores.iter().filter(|score| **score >= threshold).count() as u64;
            let own = u64::from(scores[label.noun] >= threshold);
            let absent = texts.absent.iter().filter(|of| dot(of, vector) >= threshold).count() as u64;
            found.iter_mut().zip([own, n_found - own, absent]).for_each(|(sum, n)| *sum += n);
            let best = |of: &[Vec<f32>]| argmax(of.iter().map(|of| dot(of, vector)));
            seen.push((label, argmax(scores.into_iter()), best(&texts.colours), best(&texts.materials)));
        }
        progress.advance(n_scenes);
    }
    progress.end();
    if seen.is_empty() {
        bail!("the scenes gave no crops; generate more with --n-scenes");
    }
    let crop = |i: usize| image.encode(&timing[i % timing.len()..][..1]).map(|_| ());
    let crop_times = Times::measure(0, N_TIMED, crop)?;
    let n = seen.len() as f64;
    let share = |count: u64, of: usize| threshold.map(|_| count as f64 / (n * of as f64));
    Ok(EncoderReport {
        encoder: models.encoder_id().name.clone(),
        n_scenes: seeds.end - seeds.start,
        first_seed: seeds.start,
        tallies: tallies(&seen),
        nouns: of_each_noun(&seen, nouns),
        threshold,
        found: share(found[0], 1),
        found_others: share(found[1], nouns.len() - 1),
        found_absent: share(found[2], texts.absent.len()),
        ms_per_crop: crop_times.median_ms,
        ms_per_text: text_times.median_ms,
    })
}

/// A crop's label, and the nouns, colours and materials with the best scores.
type Seen = (Label, usize, usize, usize);
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
            tally.colour += usize::from(Colour::value_variants()[*colour] == label.colour);
            tally.material += usize::from(Material::value_variants()[*material] == label.material);
        }
        tally
    };
    sets.map(|(name, is_in)| (name.to_owned(), tally(is_in))).to_vec()
}

fn of_each_noun(seen: &[Seen], nouns: &[Noun]) -> Vec<NounReport> {
    // Confusion matrix over whole things: answers by true noun.
    let mut counts = vec![vec![0; nouns.len()]; nouns.len()];
    seen.iter().filter(|s| is_whole(&s.0)).for_each(|(label, noun, ..)| counts[label.noun][*noun] += 1);
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

impl fmt::Display for EncoderReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{} on {} scenes from seed {}\n", self.encoder, self.n_scenes, self.first_seed)?;
        let percent = |n: usize, of: usize| format!("{:.1}", 100.0 * n as f64 / of.max(1) as f64);
        let mut table = Table::new(["top-1, %", "crops", "noun", "colour", "material"]);
        for (name, t) in &self.tallies {
            let figures = [t.noun, t.colour, t.material].map(|n| percent(n, t.n_crops));
            table.row([name.clone(), t.n_crops.to_string()].into_iter().chain(figures));
        }
        writeln!(f, "{table}")?;
        let mut table = Table::new(["noun", "crops", "%", "taken for"]);
        for noun in &self.nouns {
            let others: Vec<String> =
                noun.taken_for.iter().map(|(other, n)| format!("{other} {n}")).collect();
            let figures = [noun.n_crops.to_string(), percent(noun.n_right, noun.n_crops), others.join(", ")];
            table.row(std::iter::once(noun.noun.clone()).chain(figures));
        }
        writeln!(f, "{table}")?;
        if let (Some(threshold), Some(own), Some(others), Some(absent)) =
            (self.threshold, self.found, self.found_others, self.found_absent)
        {
            let [own, others, absent] = [own, others, absent].map(|share| 100.0 * share);
            writeln!(
                f,
                "above the threshold {threshold:.3}: own noun {own:.1} %, another {others:.2} %, absent categories {absent:.2} %"
            )?;
        }
        writeln!(f, "{:.2} ms per crop, {:.2} ms per text, one thread", self.ms_per_crop, self.ms_per_text)
    }
}
