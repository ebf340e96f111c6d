//! What the objects of labelled scenes are called, and how far the confidence of a name can be believed.
//!
//! An object is the thing that has most of its Gaussians, at least half of them; one without such a thing has no right
//! name. A name is right if it, or a part of it between slashes, is the label, a synonym of it, or the last words of
//! either ("door" for a folding door, not "wheelchair" for a chair). Case and a plural s do not count.

use std::collections::BTreeMap;
use std::fmt;
use std::path::PathBuf;

use anyhow::{Result, bail};
use clap::Args;
use serde::Serialize;
use slag_encoder::cli::common::{ModelArgs, text_encoder_of};
use slag_encoder::objects::NONE;
use slag_encoder::query::PublishedObjects;
use slag_encoder::store::StoreReader;
use slag_models::names::{Confidence, MAX_NAMES, Naming, Spread, words_of};

use super::run::truth_of;
use super::truth::{Thing, Truth};
use crate::table::{Table, figure, percent};

/// Least share of an object's Gaussians that its thing has.
const SHARE: f64 = 0.5;
/// Bins of the expected calibration error (Guo et al. 2017).
const N_BINS: usize = 10;
/// Words that mean the same, beside those of the labels.
const SYNONYMS: [&[&str]; 13] = [
    &["sofa", "couch"],
    &["television", "tv"],
    &["refrigerator", "fridge"],
    &["stove", "cooker", "oven"],
    &["trash can", "garbage can", "dustbin", "waste bin", "trash bin can", "bin"],
    &["picture frame", "picture", "painting", "frame"],
    &["rug", "carpet", "mat"],
    &["street light", "street lamp", "lamp post", "lamppost"],
    &["bicycle", "bike"],
    &["car", "automobile", "suv", "sports car"],
    &["tire", "tyre", "car tire"],
    &["pickup truck", "pickup"],
    &["office building", "building"],
];

/// `eval names`.
#[derive(Debug, Args)]
pub(crate) struct NamesArgs {
    /// Stores with exact shards.
    #[arg(long, value_name = "DIR", num_args = 1.., required = true)]
    store: Vec<PathBuf>,
    /// Folders of their labels, in the same order: gt/instances.json, gt/gaussian_instance.npy.
    #[arg(long, value_name = "DIR", num_args = 1.., required = true)]
    truth: Vec<PathBuf>,
    /// The models that the stores were encoded with.
    #[command(flatten)]
    models: ModelArgs,
}

#[derive(Clone, Copy, Debug)]
struct Named {
    /// Score of the best name.
    cosine: f32,
    /// Confidences, best first, and whether each name is right.
    names: [(f32, bool); MAX_NAMES],
}

#[derive(Clone, Debug, Serialize)]
struct Row {
    scene: String,
    n_objects: usize,
    n_top_1: usize,
    n_top_3: usize,
    mean_confidence: f64,
    /// Expected calibration error of the best names, by their confidence and, for comparison, by their cosine.
    calibration_error: f64,
    calibration_error_of_cosine: f64,
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct NamesReport {
    rows: Vec<Row>,
}

pub(crate) fn run(args: &NamesArgs) -> Result<NamesReport> {
    if args.store.len() != args.truth.len() {
        bail!("{} stores and {} folders of labels; give one for each", args.store.len(), args.truth.len());
    }
    let (mut rows, mut all) = (Vec::new(), Vec::new());
    for (store, truth) in args.store.iter().zip(&args.truth) {
        let reader = StoreReader::open(store)?;
        let named = judge(&reader, &truth_of(&reader, truth)?, &args.models)?;
        rows.push(Row::new(reader.manifest().scene.clone(), &named));
        all.extend(named);
    }
    rows.push(Row::new("all".to_owned(), &all));
    Ok(NamesReport { rows })
}

fn judge(reader: &StoreReader, truth: &Truth, models: &ModelArgs) -> Result<Vec<Named>> {
    let objects = PublishedObjects::read(reader)?;
    let mut encoder = text_encoder_of(reader, models)?;
    let (mut words, mut scores) = (Vec::new(), Vec::new());
    for word in words_of(encoder.nouns()) {
        if let Ok(vector) = encoder.encode(&word) {
            scores.push(objects.scores(&vector));
            words.push(word);
        }
    }
    let mut spread = Spread::default();
    scores.iter().for_each(|scores| spread.add(scores));
    let confidence = Confidence::new(&reader.manifest().encoder.name, spread);
    let things = things_of(truth, &objects);
    let named = |(object, thing): (usize, &Option<&Thing>)| {
        let mut naming = Naming::default();
        (0..).zip(&scores).for_each(|(word, of_word)| naming.add(word, of_word[object], &confidence));
        let mut named = Named { cosine: 0.0, names: [(0.0, false); MAX_NAMES] };
        for (at, (word, confidence)) in naming.names(&confidence).enumerate() {
            let is_right = thing.is_some_and(|thing| is_right(&words[word as usize], thing));
            named.names[at] = (confidence, is_right);
            if at == 0 {
                named.cosine = scores[word as usize][object];
            }
        }
        named
    };
    Ok(things.iter().enumerate().map(named).collect())
}

fn things_of<'a>(truth: &'a Truth, objects: &PublishedObjects) -> Vec<Option<&'a Thing>> {
    let mut counts: Vec<BTreeMap<u16, usize>> = vec![BTreeMap::new(); objects.ids.len()];
    for (object, id) in objects.object_of.iter().zip(&truth.id_of_gaussian) {
        if *object != NONE {
            *counts[*object as usize].entry(*id).or_default() += 1;
        }
    }
    let thing = |counts: &BTreeMap<u16, usize>| {
        let (id, n) = counts.iter().max_by_key(|(_, n)| **n)?;
        let is_most = *n as f64 >= SHARE * counts.values().sum::<usize>() as f64;
        let mut all = truth.things.iter().chain(&truth.background);
        all.find(|thing| is_most && thing.id == *id)
    };
    counts.iter().map(thing).collect()
}

fn is_right(name: &str, thing: &Thing) -> bool {
    let singular = |word: &str| {
        let word = word.split('(').next().unwrap_or_default().trim().to_lowercase();
        word.strip_suffix('s').filter(|rest| !rest.ends_with('s')).map_or(word.clone(), str::to_owned)
    };
    let own = std::iter::once(&thing.category).chain(&thing.words).map(|word| singular(word));
    let own: Vec<String> = own.collect();
    let same = SYNONYMS.iter().filter(|same| same.iter().any(|word| own.contains(&singular(word))));
    let all: Vec<String> =
        own.iter().cloned().chain(same.flat_map(|same| same.iter().map(|w| singular(w)))).collect();
    let is_last = |whole: &str, last: &str| {
        whole.strip_suffix(last).is_some_and(|rest| rest.is_empty() || rest.ends_with(' '))
    };
    name.split('/').map(singular).any(|part| all.iter().any(|word| is_last(word, &part)))
}

impl Row {
    fn new(scene: String, named: &[Named]) -> Self {
        let n = named.len().max(1) as f64;
        let best = || named.iter().map(|named| named.names[0]);
        let by_cosine = named.iter().map(|named| (named.cosine.clamp(0.0, 1.0), named.names[0].1));
        Self {
            scene,
            n_objects: named.len(),
            n_top_1: best().filter(|best| best.1).count(),
            n_top_3: named.iter().filter(|named| named.names.iter().any(|name| name.1)).count(),
            mean_confidence: best().map(|best| f64::from(best.0)).sum::<f64>() / n,
            calibration_error: calibration_error(best()),
            calibration_error_of_cosine: calibration_error(by_cosine),
        }
    }
}

/// Mean gap between confidence and share of right names, over bins of confidence weighted by their names.
fn calibration_error(names: impl Iterator<Item = (f32, bool)>) -> f64 {
    let mut bins = [(0usize, 0.0, 0usize); N_BINS];
    for (confidence, is_right) in names {
        let bin = ((f64::from(confidence) * N_BINS as f64) as usize).min(N_BINS - 1);
        bins[bin].0 += 1;
        bins[bin].1 += f64::from(confidence);
        bins[bin].2 += usize::from(is_right);
    }
    let n: usize = bins.iter().map(|(n, ..)| n).sum();
    bins.iter().map(|(_, sum, n_right)| (sum - *n_right as f64).abs()).sum::<f64>() / n.max(1) as f64
}

impl fmt::Display for NamesReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let columns = ["scene", "objects", "top-1", "top-3", "confidence", "ECE", "ECE of the cosine"];
        let mut table = Table::new(columns);
        for row in &self.rows {
            let share = |n: usize| percent(n as u64, row.n_objects as u64);
            let figures = [row.mean_confidence, row.calibration_error, row.calibration_error_of_cosine];
            let cells =
                [row.scene.clone(), row.n_objects.to_string(), share(row.n_top_1), share(row.n_top_3)];
            table.row(cells.into_iter().chain(figures.map(|of| figure(Some(of)))));
        }
        write!(f, "{table}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn right_names() {
        let thing = |category: &str, words: &[&str]| Thing {
            category: category.to_owned(),
            words: words.iter().map(|word| (*word).to_owned()).collect(),
            ..Thing::default()
        };
        for (name, category) in [
            ("couch", "sofa"),
            ("monitor/tv", "television"),
            ("door", "folding door"),
            ("Stairs", "stair"),
            ("crane (machine)", "crane"),
            ("bin", "trash can"),
        ] {
            assert!(is_right(name, &thing(category, &[])), "{name} {category}");
        }
        for (name, category) in
            [("wheelchair", "chair"), ("office chair", "chair"), ("hair", "chair"), ("as", "glass")]
        {
            assert!(!is_right(name, &thing(category, &[])), "{name} {category}");
        }
        assert!(is_right("writing desk", &thing("table", &["writing desk"])));
    }

    /// By hand: one of two names with confidence 0.9 is right, and so is one with 0.1.
    #[test]
    fn calibration_error_by_hand() {
        let names = [(0.9, true), (0.9, false), (0.1, true)];
        let expected = ((1.8f64 - 1.0) + (1.0 - 0.1)) / 3.0;
        assert!((calibration_error(names.into_iter()) - expected).abs() < 1e-6);
        assert_eq!(calibration_error(std::iter::empty()), 0.0);
    }
}
