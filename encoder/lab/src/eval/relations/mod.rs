//! Relations between things, judged on generated scenes: each question is asked of the robot's program as
//! relations, as the plain phrase, and by the noun alone, and the answers are compared with the layout.

mod truth;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::{Path, PathBuf};

use anyhow::{Result, anyhow};
use clap::Args;
use glam::DVec3;
use serde::Serialize;
use serde_json::{Value, json};
use slag_common::frames::Aabb;
use slag_encoder::progress::Progress;

use super::truth::{Thing, read_things};
use crate::generate::compose::Walk;
use crate::generate::grammar::SceneKind;
use crate::programs::{Prepared, Service, sibling};
use crate::table::{Table, percent};
use truth::{Asked, QUESTIONS};

/// Things with fewer pixels over all photos are not asked about.
const MIN_PIXELS: u64 = 4000;
/// Least intersection over union of an answer's box and a thing's; below it, the thing around its position counts.
const MIN_IOU: f64 = 0.1;
/// Distance by which a position may lie outside.
const TOLERANCE_M: f64 = 0.25;
/// Most questions about a relation in a scene, with and without an answer each.
const MAX_QUESTIONS: usize = 12;
const LIMIT: usize = 10;

/// `eval relations`.
#[derive(Debug, Args)]
pub(crate) struct RelationsArgs {
    /// Folder for scenes, stores and caches; what an earlier run left there is used.
    #[arg(long, value_name = "DIR", default_value = "target/relations")]
    out: PathBuf,
    /// Kinds of scenes.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "room,yard")]
    kind: Vec<SceneKind>,
    /// Seeds of each kind. One choice of the relations was made on rooms 1 to 4: judge by others.
    #[arg(long, value_name = "N", value_delimiter = ',', default_values_t = [11, 12, 13, 14])]
    seeds: Vec<u64>,
    /// Photos of each scene.
    #[arg(long, value_name = "N", default_value_t = 48, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    n_views: u32,
}

struct Question {
    asked: Asked,
    thing: String,
    text: String,
    /// Indices of the things meant; empty if there is none.
    truth: Vec<usize>,
}

pub(crate) fn run(args: &RelationsArgs, progress: &dyn Progress) -> Result<RelationsReport> {
    let mut counts = BTreeMap::new();
    let scenes = Prepared {
        out: &args.out,
        kinds: &args.kind,
        seeds: &args.seeds,
        n_views: args.n_views,
        walk: Walk::Oval,
        encode_flags: &[],
    };
    let scenes = scenes.judge(progress, |_, _, dir| judge(dir, &mut counts))?;
    let row = |((_, relation, has_answer, way), counts)| Row { relation, has_answer, way, counts };
    Ok(RelationsReport { scenes, rows: counts.into_iter().map(row).collect() })
}

/// By whether all relations are meant, the relation, whether a thing is meant, and how it is asked for.
type AllCounts = BTreeMap<(bool, Option<Asked>, bool, Way), Counts>;

fn judge(dir: &Path, counts: &mut AllCounts) -> Result<()> {
    let (things, _) = read_things(&dir.join("scene"))?;
    let robot = middle(&things);
    let service = Service::start(&sibling("slag-edge")?, "--cache", &dir.join("cache"))?;
    for question in questions(&things, robot) {
        for way in Way::ALL {
            let answered = ask(&service, &question, way, robot)?;
            let found: Vec<Option<usize>> = answered.iter().map(|answer| thing_of(&things, answer)).collect();
            let is_right = |at: &Option<usize>| at.is_some_and(|at| question.truth.contains(&at));
            let distinct: BTreeSet<usize> = found.iter().copied().flatten().collect();
            let is_best_right = found.first().map_or(question.truth.is_empty(), is_right);
            for relation in [Some(question.asked), None] {
                let key = (relation.is_none(), relation, !question.truth.is_empty(), way);
                let counts = counts.entry(key).or_default();
                counts.n_questions += 1;
                counts.n_right += usize::from(is_best_right);
                counts.n_answers += found.len();
                counts.n_answers_right += found.iter().filter(|at| is_right(at)).count();
                counts.n_meant += question.truth.len();
                counts.n_meant_found += distinct.iter().filter(|at| question.truth.contains(at)).count();
            }
        }
    }
    Ok(())
}

fn middle(things: &[Thing]) -> DVec3 {
    let all = things.iter().fold(Aabb::EMPTY, |all, thing| Aabb {
        min: all.min.min(thing.aabb_min),
        max: all.max.max(thing.aabb_max),
    });
    all.centre().with_z(0.0)
}

/// Returns for each relation the questions with and without an answer, evenly spread over all pairs of words.
fn questions(things: &[Thing], robot: DVec3) -> Vec<Question> {
    let is_shown = |thing: &&Thing| thing.train_pixels >= MIN_PIXELS;
    let nouns: BTreeSet<&str> = things.iter().filter(is_shown).map(|thing| thing.category.as_str()).collect();
    let mut n_of_kind: BTreeMap<&str, usize> = BTreeMap::new();
    // "Furniture", but not "something to sit on", which is a relation in words.
    let kinds = things.iter().filter(is_shown).flat_map(|thing| &thing.kinds);
    kinds
        .filter(|kind| !kind.starts_with("something"))
        .for_each(|kind| *n_of_kind.entry(kind).or_default() += 1);
    let several = n_of_kind.into_iter().filter(|(_, n)| *n > 1).map(|(kind, _)| kind);
    let ones: Vec<&str> = nouns.iter().copied().chain(several).collect();
    let mut all = Vec::new();
    for (asked, text) in QUESTIONS {
        let mut of_relation: [Vec<Question>; 2] = [Vec::new(), Vec::new()];
        for thing in &ones {
            for of in nouns.iter().filter(|of| *of != thing) {
                // The second word must mean one thing, or the question is ambiguous.
                let n_of = things.iter().filter(|thing| thing.sounds_like(of)).count();
                let is_part = |at: &Thing| at.sounds_like(thing) && at.sounds_like(of);
                if n_of != 1 || things.iter().any(is_part) {
                    continue;
                }
                let truth = truth::meant(things, asked, thing, of, robot);
                // The thing that a picked one is compared with must be visible.
                if truth.iter().any(|at| things[*at].train_pixels < MIN_PIXELS) {
                    continue;
                }
                let text = text.replace("{A}", thing).replace("{B}", of);
                let has_answer = usize::from(!truth.is_empty());
                of_relation[has_answer].push(Question { asked, thing: (*thing).to_owned(), text, truth });
            }
        }
        for questions in of_relation {
            let step = questions.len().div_ceil(MAX_QUESTIONS).max(1);
            all.extend(questions.into_iter().step_by(step));
        }
    }
    all
}

fn ask(service: &Service, question: &Question, way: Way, robot: DVec3) -> Result<Vec<Value>> {
    let near = [robot.x, robot.y, 0.0];
    // Distance must not affect the plain phrase, so it is asked without a position.
    let body = match way {
        Way::Relations => json!({"texts": [question.text], "near": near, "limit": LIMIT}),
        Way::Phrase => json!({"texts": [question.text], "relations": false, "limit": LIMIT}),
        Way::Noun => json!({"texts": [question.thing], "relations": false, "limit": LIMIT}),
    };
    let mut reply = service.post("/v1/query", &body)?;
    match reply["results"][0]["answers"].take() {
        Value::Array(answers) => Ok(answers),
        // 422: words unknown to the model.
        _ if reply["status"] == 422 => Ok(Vec::new()),
        _ => Err(anyhow!("{}: {}", question.text, reply["detail"])),
    }
}

fn thing_of(things: &[Thing], answer: &Value) -> Option<usize> {
    let corner = |name: &str| serde_json::from_value::<DVec3>(answer[name].clone()).ok();
    let of = Aabb { min: corner("box_min_in_world")?, max: corner("box_max_in_world")? };
    let position = corner("position_in_world")?;
    let overlap = |at: &usize| iou(&of, &things[*at].bounds());
    let best = (0..things.len()).max_by(|a, b| overlap(a).total_cmp(&overlap(b)));
    let inside = |at: &usize| {
        let bounds = things[*at].bounds();
        bounds.distance_to(position) <= TOLERANCE_M
    };
    let nearest = |a: &usize, b: &usize| {
        let distance = |at: &usize| things[*at].bounds().distance_to(position);
        let size = |at: &usize| things[*at].bounds().size().element_product();
        distance(a).total_cmp(&distance(b)).then(size(a).total_cmp(&size(b)))
    };
    best.filter(|at| overlap(at) >= MIN_IOU)
        .or_else(|| (0..things.len()).filter(inside).min_by(|a, b| nearest(a, b)))
}

fn iou(a: &Aabb, b: &Aabb) -> f64 {
    let shared = (a.max.min(b.max) - a.min.max(b.min)).max(DVec3::ZERO).element_product();
    let both = a.size().element_product() + b.size().element_product() - shared;
    if both > 0.0 { shared / both } else { 0.0 }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
enum Way {
    Relations,
    /// The phrase as one text, with the scene's threshold.
    Phrase,
    /// The noun alone, with the scene's threshold.
    Noun,
}

impl Way {
    const ALL: [Self; 3] = [Self::Relations, Self::Phrase, Self::Noun];
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
struct Counts {
    n_questions: usize,
    /// Those whose best answer is right; without a thing that is meant: those without an answer.
    n_right: usize,
    n_answers: usize,
    n_answers_right: usize,
    n_meant: usize,
    /// Those among the answers.
    n_meant_found: usize,
}

#[derive(Clone, Debug, Serialize)]
struct Row {
    /// `None` for all of them.
    relation: Option<Asked>,
    has_answer: bool,
    way: Way,
    #[serde(flatten)]
    counts: Counts,
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct RelationsReport {
    scenes: Vec<String>,
    rows: Vec<Row>,
}

impl fmt::Display for RelationsReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{} scenes: {}\n", self.scenes.len(), self.scenes.join(", "))?;
        let columns = ["relation", "answer", "asked as", "questions", "best right", "precision", "recall"];
        let mut table = Table::new(columns);
        for Row { relation, has_answer, way, counts } in &self.rows {
            let percent = |n: usize, of: usize| percent(n as u64, of as u64);
            table.row([
                relation.map_or("all".into(), |relation| format!("{relation:?}")),
                if *has_answer { "some" } else { "none" }.to_owned(),
                format!("{way:?}"),
                counts.n_questions.to_string(),
                percent(counts.n_right, counts.n_questions),
                percent(counts.n_answers_right, counts.n_answers),
                percent(counts.n_meant_found, counts.n_meant),
            ]);
        }
        write!(f, "{table}")
    }
}
