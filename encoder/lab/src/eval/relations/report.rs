//! What came of the questions.

use std::collections::BTreeMap;
use std::fmt;

use serde::Serialize;

use super::truth::Asked;

/// How a question is asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Way {
    /// As relations between things.
    Relations,
    /// The phrase as one text, with the scene's threshold.
    Phrase,
    /// The phrase as one text; its best answer, whatever the score.
    BestOfPhrase,
    /// The noun alone, with the scene's threshold.
    Noun,
}

impl Way {
    /// Every way.
    pub const ALL: [Self; 4] = [Self::Relations, Self::Phrase, Self::BestOfPhrase, Self::Noun];
}

/// What came of some questions.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Counts {
    /// Questions.
    pub n_questions: usize,
    /// Those whose best answer is right; without a thing that is meant: those without an answer.
    pub n_right: usize,
    /// Answers.
    pub n_answers: usize,
    /// Answers that are a thing that is meant.
    pub n_answers_right: usize,
    /// Things that are meant.
    pub n_meant: usize,
    /// Those among the answers.
    pub n_meant_found: usize,
}

impl Counts {
    fn add(&mut self, other: Self) {
        self.n_questions += other.n_questions;
        self.n_right += other.n_right;
        self.n_answers += other.n_answers;
        self.n_answers_right += other.n_answers_right;
        self.n_meant += other.n_meant;
        self.n_meant_found += other.n_meant_found;
    }

    /// Returns the share of questions whose best answer is right.
    pub fn success(&self) -> Option<f64> {
        share(self.n_right, self.n_questions)
    }
}

fn share(n: usize, of: usize) -> Option<f64> {
    (of > 0).then(|| n as f64 / of as f64)
}

/// Figures of one way of asking.
#[derive(Clone, Debug, Serialize)]
struct Row {
    relation: Option<Asked>,
    has_answer: bool,
    way: Way,
    success: Option<f64>,
    precision: Option<f64>,
    recall: Option<f64>,
    #[serde(flatten)]
    counts: Counts,
}

/// The figures by relation, and over all.
#[derive(Clone, Debug, Default)]
pub struct RelationsReport {
    /// The scenes.
    pub scenes: Vec<String>,
    counts: BTreeMap<(Asked, bool, Way), Counts>,
}

impl RelationsReport {
    /// Adds what came of a question. `has_answer`: whether a thing is meant.
    pub fn count(&mut self, asked: Asked, has_answer: bool, way: Way, counts: Counts) {
        self.counts.entry((asked, has_answer, way)).or_default().add(counts);
    }

    /// Returns what came of all questions with or without an answer.
    pub fn total(&self, has_answer: bool, way: Way) -> Counts {
        let mut total = Counts::default();
        let of = self.counts.iter().filter(|((_, has, by), _)| *has == has_answer && *by == way);
        of.for_each(|(_, counts)| total.add(*counts));
        total
    }

    fn rows(&self) -> Vec<Row> {
        let row = |relation, has_answer, way, counts: Counts| Row {
            relation,
            has_answer,
            way,
            success: counts.success(),
            precision: share(counts.n_answers_right, counts.n_answers),
            recall: share(counts.n_meant_found, counts.n_meant),
            counts,
        };
        let each =
            self.counts.iter().map(|((asked, has, way), counts)| row(Some(*asked), *has, *way, *counts));
        let totals = [true, false].into_iter().flat_map(|has| Way::ALL.map(|way| (has, way)));
        each.chain(totals.map(|(has, way)| row(None, has, way, self.total(has, way)))).collect()
    }
}

impl Serialize for RelationsReport {
    fn serialize<S: serde::Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        #[derive(Serialize)]
        struct Shown<'a> {
            scenes: &'a [String],
            rows: Vec<Row>,
        }
        Shown { scenes: &self.scenes, rows: self.rows() }.serialize(to)
    }
}

impl fmt::Display for RelationsReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{} scenes: {}", self.scenes.len(), self.scenes.join(", "))?;
        writeln!(
            f,
            "{:<12} {:<8} {:<15} {:>9} {:>8} {:>10} {:>7}",
            "relation", "answer", "asked as", "questions", "success", "precision", "recall"
        )?;
        let percent =
            |share: Option<f64>| share.map_or("-".into(), |share| format!("{:.0} %", 100.0 * share));
        for row in self.rows() {
            let relation = row.relation.map_or("all".into(), |relation| format!("{relation:?}"));
            writeln!(
                f,
                "{relation:<12} {:<8} {:<15} {:>9} {:>8} {:>10} {:>7}",
                if row.has_answer { "some" } else { "none" },
                format!("{:?}", row.way),
                row.counts.n_questions,
                percent(row.success),
                percent(row.precision),
                percent(row.recall)
            )?;
        }
        Ok(())
    }
}
