//! From candidates to a phrase's matches, best first, or the part of the phrase that failed.

use glam::DVec3;
use schemars::JsonSchema;
use serde::Serialize;

use super::candidates::{Candidate, SURE, Things};
use super::geometry::{self, HOLDS, Solid, Viewer};
use super::phrase::{By, Phrase, Pick, Place};
use crate::query::reason::{Reason, ReasonKind};

#[derive(Clone, Debug, PartialEq)]
pub struct Related {
    /// Index among the candidates of the phrase's thing.
    pub candidate: usize,
    /// Product of the confidences and degrees of every part, 0 to 1.
    pub score: f64,
    /// Degree of the phrase's own relation; 1 without one.
    pub degree: f64,
    pub to: Vec<Witness>,
}

/// A thing that another is related to.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Witness {
    /// The words that it answers to.
    pub thing: String,
    /// Its id; absent for the asker.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub id: Option<String>,
    /// Where it is.
    #[schemars(with = "[f64; 3]")]
    pub position_in_world: DVec3,
    /// Its score with the words; absent for the asker.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub score: Option<f32>,
}

fn miss(kind: ReasonKind, thing: &str, detail: String) -> Reason {
    Reason { thing: Some(thing.into()), ..Reason::new(kind, detail) }
}

/// A thing to compare others with.
struct Anchor {
    solid: Solid,
    score: f64,
    witness: Witness,
}

struct Measure<'a, 'b> {
    things: &'a Things<'b>,
    viewer: Option<&'a Viewer>,
    metre: f64,
}

/// Returns a phrase's matches in the region, best first.
pub fn relate(
    things: &Things<'_>,
    phrase: &Phrase,
    viewer: Option<&Viewer>,
    metre: f64,
) -> Result<Vec<Related>, Reason> {
    let of = things.of(&phrase.thing);
    if !of.is_empty() && !of.iter().any(|candidate| candidate.is_inside) {
        let detail = format!("nothing {} is in the region asked for", quoted(&phrase.thing));
        return Err(miss(ReasonKind::NotInRegion, &phrase.thing, detail));
    }
    Measure { things, viewer, metre }.matches(phrase, |candidate| candidate.is_inside)
}

impl<'b> Measure<'_, 'b> {
    fn matches(
        &self,
        phrase: &Phrase,
        is_asked_for: impl Fn(&Candidate<'b>) -> bool,
    ) -> Result<Vec<Related>, Reason> {
        let all = self.things.of(&phrase.thing);
        if all.is_empty() {
            let detail = format!("nothing on board is {}", quoted(&phrase.thing));
            return Err(miss(ReasonKind::NoSuchThing, &phrase.thing, detail));
        }
        let alone = |(candidate, of): (usize, &Candidate<'_>)| Related {
            candidate,
            score: of.confidence,
            degree: 1.0,
            to: Vec::new(),
        };
        let mut found = match &phrase.relation {
            None => all.iter().enumerate().map(alone).collect(),
            Some(place) => self.placed(phrase, place)?,
        };
        found.retain(|related| is_asked_for(&all[related.candidate]));
        found.sort_by(|a, b| b.score.total_cmp(&a.score).then(a.candidate.cmp(&b.candidate)));
        let described = quoted(&phrase.thing);
        if found.is_empty() {
            let detail = format!("nothing {described} that is so placed is in the region asked for");
            return Err(miss(ReasonKind::NotInRegion, &phrase.thing, detail));
        }
        match &phrase.pick {
            None => Ok(found),
            Some(pick) => self.picked(phrase, pick, found),
        }
    }

    fn placed(&self, phrase: &Phrase, place: &Place) -> Result<Vec<Related>, Reason> {
        let ones = self.anchors(&place.of)?;
        let others = match &place.and {
            Some(other) => Some((other, self.anchors(other)?)),
            None => None,
        };
        let all = self.things.of(&phrase.thing);
        let (mut found, mut best_degree) = (Vec::new(), 0.0f64);
        for (candidate, thing) in all.iter().enumerate() {
            let mut best: Option<Related> = None;
            let mut consider = |degree: f64, score: f64, to: &[&Anchor]| {
                best_degree = best_degree.max(degree);
                let score = degree * score * thing.confidence;
                if degree >= HOLDS && best.as_ref().is_none_or(|best| score > best.score) {
                    let to = to.iter().map(|anchor| anchor.witness.clone()).collect();
                    best = Some(Related { candidate, score, degree, to });
                }
            };
            let is_other = |anchor: &&Anchor| anchor.witness.id.as_deref() != Some(&thing.id);
            for one in ones.iter().filter(is_other) {
                match &others {
                    None => {
                        let degree =
                            geometry::degree(place.is, &thing.solid, &one.solid, self.viewer, self.metre);
                        consider(degree, one.score, &[one]);
                    }
                    Some((_, others)) => {
                        let is_third = |other: &&Anchor| other.witness.id != one.witness.id;
                        for other in others.iter().filter(is_other).filter(is_third) {
                            let degree = geometry::between(&thing.solid, &one.solid, &other.solid);
                            consider(degree, one.score * other.score, &[one, other]);
                        }
                    }
                }
            }
            found.extend(best);
        }
        if found.is_empty() {
            let and = others.map_or(String::new(), |(other, _)| format!(" and {}", quoted(&other.thing)));
            let (thing, of, is) = (quoted(&phrase.thing), quoted(&place.of.thing), place.is);
            let limits = geometry::limits(is);
            let detail =
                format!("{thing} and {of}{and} are on board, but no {thing} is {is} {of}{and}{limits}");
            let miss = miss(ReasonKind::NoSuchPair, &phrase.thing, detail);
            return Err(Reason { best_degree: Some(best_degree), ..miss });
        }
        Ok(found)
    }

    /// Returns the anchors of a phrase.
    fn anchors(&self, phrase: &Phrase) -> Result<Vec<Anchor>, Reason> {
        if phrase.is_asker() {
            let at = self.viewer.map_or(DVec3::ZERO, |viewer| viewer.position_in_world);
            let witness =
                Witness { thing: phrase.thing.clone(), id: None, position_in_world: at, score: None };
            return Ok(vec![Anchor { solid: Solid::point(at), score: 1.0, witness }]);
        }
        let all = self.things.of(&phrase.thing);
        let found = self.matches(phrase, |_| true)?.into_iter();
        let anchor = |related: Related| {
            let of = &all[related.candidate];
            let witness = Witness {
                thing: phrase.thing.clone(),
                id: Some(of.id.clone()),
                position_in_world: of.position_in_world(),
                score: Some(of.score),
            };
            Anchor { solid: of.solid, score: related.score, witness }
        };
        Ok(found.map(anchor).collect())
    }

    fn picked(&self, phrase: &Phrase, pick: &Pick, mut found: Vec<Related>) -> Result<Vec<Related>, Reason> {
        let all = self.things.of(&phrase.thing);
        let from = match (&pick.from, pick.by.is_distance()) {
            (Some(from), _) => self.anchors(from)?,
            (None, true) => self.anchors(&Phrase::thing(super::phrase::ASKER[0]))?,
            (None, false) => Vec::new(),
        };
        let best = found[0].score;
        found.retain(|related| related.score >= SURE * best);
        // The surest one that distances are counted from.
        let origin = from.first();
        found.retain(|related| {
            origin.is_none_or(|origin| origin.witness.id.as_ref() != Some(&all[related.candidate].id))
        });
        let key = |of: &Related| match (pick.by, &all[of.candidate].solid, origin) {
            (By::Largest, solid, _) => -solid.volume(),
            (By::Smallest, solid, _) => solid.volume(),
            (By::Nearest, solid, Some(origin)) => solid.gap(&origin.solid),
            (By::Farthest, solid, Some(origin)) => -solid.gap(&origin.solid),
            _ => 0.0,
        };
        found.sort_by(|a, b| key(a).total_cmp(&key(b)).then(a.candidate.cmp(&b.candidate)));
        let n = found.len();
        if n < pick.n {
            let detail = format!("number {} of {} was asked for, but {n} fit", pick.n, quoted(&phrase.thing));
            return Err(miss(ReasonKind::TooFew, &phrase.thing, detail));
        }
        let mut chosen = found.swap_remove(pick.n - 1);
        chosen.to.extend(origin.map(|origin| origin.witness.clone()));
        Ok(vec![chosen])
    }
}

/// Quotes a text of a client: cut, and control characters escaped.
fn quoted(text: &str) -> String {
    let cut: String = text.chars().take(40).collect();
    format!("{cut:?}")
}
