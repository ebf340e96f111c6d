//! Phrases about things and their places, in words or as JSON.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use slag_service::params::RequestError;

use crate::text::MAX_TEXT_BYTES;

/// Most things that a phrase may name.
pub const MAX_THINGS: usize = 8;
pub const MAX_NTH: usize = 100;
/// Names for the asker, who may be asked: "behind you".
pub const ASKER: [&str; 5] = ["me", "myself", "us", "here", "you"];
/// Names for any thing.
const ANYTHING: [&str; 9] =
    ["thing", "things", "object", "objects", "item", "items", "anything", "something", "everything"];

/// Whether a thing's name stands for every object.
pub fn is_anything(thing: &str) -> bool {
    ANYTHING.contains(&thing.trim().to_lowercase().as_str())
}

/// A thing, chosen by what it is, where it is, and how it compares with others of its kind.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
pub struct Phrase {
    /// What it is, in the text model's words; me, inside another phrase, is the asker.
    pub thing: String,
    /// Which one, if several fit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pick: Option<Pick>,
    /// Where it is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub relation: Option<Box<Place>>,
}

/// Where a thing is: a relation to another thing.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
pub struct Place {
    /// The relation.
    pub is: Relation,
    /// The other thing.
    pub of: Phrase,
    /// The second one, for `between`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub and: Option<Phrase>,
}

/// A relation between things.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Relation {
    /// Rests on it, or hangs on it.
    On,
    /// Below it, within its outline.
    Under,
    /// Over it, within its outline.
    Above,
    /// Inside it.
    In,
    /// A short way from it.
    Near,
    /// Next to it, at the same height.
    Beside,
    /// Between two things.
    Between,
    /// To the left of it, seen by the asker.
    LeftOf,
    /// To the right of it, seen by the asker.
    RightOf,
    /// Nearer to the asker than it, in the same direction.
    InFrontOf,
    /// Farther from the asker than it, in the same direction.
    Behind,
}

slag_common::named_members!(Phrase, Place, Pick; Serialize);

impl Relation {
    pub fn is_seen(self) -> bool {
        matches!(self, Self::LeftOf | Self::RightOf | Self::InFrontOf | Self::Behind)
    }

    pub(crate) fn needs_up(self) -> bool {
        !matches!(self, Self::In | Self::Near | Self::Between)
    }
}

impl fmt::Display for Relation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = serde_json::to_value(self).unwrap_or_default();
        f.write_str(&name.as_str().unwrap_or_default().replace('-', " "))
    }
}

/// Which of several things is meant.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, remote = "Self")]
pub struct Pick {
    /// What they are compared by.
    pub by: By,
    /// Which one in that order, from 1.
    #[serde(default = "first")]
    #[schemars(range(min = 1, max = MAX_NTH))]
    pub n: usize,
    /// For `nearest` and `farthest`: from what; from the asker if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from: Option<Box<Phrase>>,
}

fn first() -> usize {
    1
}

/// What things are compared by.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum By {
    /// Volume of the box, falling.
    Largest,
    /// Volume of the box, rising.
    Smallest,
    /// Distance, rising.
    Nearest,
    /// Distance, falling.
    Farthest,
}

impl By {
    pub(crate) fn is_distance(self) -> bool {
        matches!(self, Self::Nearest | Self::Farthest)
    }
}

impl Phrase {
    pub fn thing(thing: impl Into<String>) -> Self {
        Self { thing: thing.into(), pick: None, relation: None }
    }

    pub(crate) fn is_asker(&self) -> bool {
        ASKER.contains(&self.thing.as_str())
    }

    pub fn inner(&self) -> impl Iterator<Item = &Phrase> {
        let place = self.relation.iter().flat_map(|place| std::iter::once(&place.of).chain(&place.and));
        place.chain(self.pick.iter().flat_map(|pick| pick.from.as_deref()))
    }

    /// Returns the names of all things but the asker, each once, in the order of the phrase.
    pub fn things(&self) -> Vec<&str> {
        let mut things = Vec::new();
        self.collect(&mut things);
        things
    }

    fn collect<'a>(&'a self, things: &mut Vec<&'a str>) {
        if !self.is_asker() && !things.contains(&self.thing.as_str()) {
            things.push(&self.thing);
        }
        self.inner().for_each(|inner| inner.collect(things));
    }

    pub fn n_things(&self) -> usize {
        1 + self.inner().map(Phrase::n_things).sum::<usize>()
    }

    /// Returns whether any part needs the asker's position, and its heading.
    pub fn needs(&self) -> [bool; 2] {
        let seen = self.relation.as_ref().is_some_and(|place| place.is.is_seen());
        let from_asker = self.relation.as_ref().is_some_and(|place| place.of.is_asker());
        let compared = self.pick.as_ref().is_some_and(|pick| pick.by.is_distance() && pick.from.is_none());
        let own = [seen || compared || self.is_asker(), seen && from_asker];
        self.inner().map(Phrase::needs).fold(own, |[a, b], [c, d]| [a || c, b || d])
    }

    /// Checks every limit of a phrase, and that `between` alone has two things.
    pub fn check(&self) -> Result<(), RequestError> {
        if self.is_asker() {
            let expected = "a thing to look for; the asker can only be what it is compared with";
            return refuse(&self.thing, expected);
        }
        if self.n_things() > MAX_THINGS {
            return refuse(&format!("{} things", self.n_things()), &format!("at most {MAX_THINGS}"));
        }
        let n_unnamed = self.things().into_iter().filter(|thing| is_anything(thing)).count();
        if n_unnamed > 1 || self.inner().any(|of| is_anything(&of.thing) && is_anything(&self.thing)) {
            return refuse(&self.thing, "a phrase that names all its things but one");
        }
        self.check_parts()
    }

    fn check_parts(&self) -> Result<(), RequestError> {
        let is_text = |c: char| !c.is_control() || c.is_whitespace();
        let is_short = (1..=MAX_TEXT_BYTES).contains(&self.thing.len()) && !self.thing.trim().is_empty();
        if !is_short || !self.thing.chars().all(is_text) {
            return refuse(&self.thing, &format!("a thing in 1 to {MAX_TEXT_BYTES} bytes of words"));
        }
        if self.is_asker() && (self.relation.is_some() || self.pick.is_some()) {
            return refuse(&self.thing, "the asker without a relation or pick of its own");
        }
        if let Some(place) = &self.relation
            && (place.is == Relation::Between) != place.and.is_some()
        {
            return refuse(&place.is.to_string(), "`and` with between, and only there");
        }
        if let Some(pick) = &self.pick {
            if !(1..=MAX_NTH).contains(&pick.n) {
                return refuse(&pick.n.to_string(), &format!("n from 1 to {MAX_NTH}"));
            }
            if pick.from.is_some() && !pick.by.is_distance() {
                return refuse("from", "from only with nearest and farthest");
            }
        }
        self.inner().try_for_each(Phrase::check_parts)
    }
}

fn refuse(found: &str, expected: &str) -> Result<(), RequestError> {
    Err(RequestError::new("phrases", found, expected))
}
