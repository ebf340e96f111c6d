//! Near synonyms, for models that do not know all words: `couch` is asked as `sofa`.

use std::collections::HashSet;

use crate::InferenceError;
use crate::words::words;

/// Groups of near synonyms, one per line.
const GROUPS: &str = include_str!("synonyms.txt");
/// Longest phrase that is searched in a text, words.
const MAX_WORDS: usize = 4;
/// Words between two things in a text.
const JOINTS: &str =
    "and or with against plus on in under above below over near beside next behind between left right by at";
/// Endings of plurals and their singulars.
const PLURALS: [(&str, &str); 5] = [("ies", "y"), ("ves", "f"), ("ves", "fe"), ("es", ""), ("s", "")];

/// Possible singulars of a phrase in lower case, in the order of [`PLURALS`].
pub(crate) fn singulars(phrase: &str) -> impl Iterator<Item = String> {
    PLURALS.iter().filter_map(move |(plural, end)| Some(phrase.strip_suffix(plural)?.to_owned() + end))
}

pub(crate) fn without_hyphens(key: &str) -> String {
    key.replace('-', " ")
}

/// Lookup key of a phrase: lower case, single spaces, no leading article.
pub(crate) fn key(text: &str) -> String {
    let text = text.to_lowercase();
    let mut words: Vec<&str> = text.split_whitespace().collect();
    if words.len() > 1 && ["a", "an", "the"].contains(&words[0]) {
        words.remove(0);
    }
    words.join(" ")
}

#[derive(Debug)]
pub struct KnownPhrases {
    phrases: HashSet<String>,
    /// Whether the model takes these phrases only; otherwise they may occur within any text.
    is_closed: bool,
}

impl KnownPhrases {
    /// `phrases`: in lower case, with spaces for hyphens.
    pub(crate) fn new(phrases: impl IntoIterator<Item = String>, is_closed: bool) -> Self {
        Self { phrases: phrases.into_iter().collect(), is_closed }
    }

    /// Replaces unknown phrases by known near synonyms (`sofa` for `couch`); `None` if there is nothing to replace.
    pub fn asked_as(&self, text: &str) -> Option<String> {
        let text = without_hyphens(&if self.is_closed { key(text) } else { text.to_lowercase() });
        let words: Vec<&str> = text.split_whitespace().collect();
        let (mut asked, mut at, mut is_other) = (Vec::new(), 0, false);
        while at < words.len() {
            let phrases =
                (1..=MAX_WORDS.min(words.len() - at)).rev().map(|n| (n, words[at..at + n].join(" ")));
            let known = phrases.filter_map(|(n, phrase)| Some((n, self.known_for(&phrase)?))).next();
            let (n, phrase) = known.unwrap_or_else(|| (1, words[at].to_owned()));
            is_other |= phrase != words[at..at + n].join(" ");
            asked.push(phrase);
            at += n;
        }
        let asked = asked.join(" ");
        (is_other && (!self.is_closed || self.phrases.contains(&asked))).then_some(asked)
    }

    /// Checks that a text does not join several known things, as "chair, person" or "bottle on the crate" do: where a
    /// model knows few words, its vector of such a text is like one of them.
    pub fn check_one(&self, text: &str) -> Result<(), InferenceError> {
        let text = text.to_lowercase().replace([',', ';', '&', '+', '/'], " and ");
        let words = words(&text);
        let known_in = |part: &[String]| {
            let lengths = (1..=MAX_WORDS.min(part.len())).rev();
            let mut phrases = lengths.flat_map(|n| part.windows(n).map(|phrase| phrase.join(" ")));
            phrases.find(|phrase| self.known_for(phrase).is_some())
        };
        let parts = words.split(|word| JOINTS.split(' ').any(|joint| joint == word));
        let named: Vec<String> = parts.filter_map(known_in).collect();
        if named.len() > 1 && !self.is_closed { Err(InferenceError::SeveralThings(named)) } else { Ok(()) }
    }

    /// Returns a known phrase, also a plural, as it is; else the first known synonym.
    fn known_for(&self, phrase: &str) -> Option<String> {
        let forms: Vec<String> = [phrase.to_owned()].into_iter().chain(singulars(phrase)).collect();
        if forms.iter().any(|form| self.phrases.contains(form)) {
            return Some(phrase.to_owned());
        }
        let groups =
            GROUPS.lines().filter(|line| line.split(", ").any(|word| forms.iter().any(|f| f == word)));
        groups.flat_map(|line| line.split(", ")).find(|word| self.phrases.contains(*word)).map(str::to_owned)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// By hand: known words stay, also as plurals and in longer texts, and so do words of no group.
    #[test]
    fn unknown_words_are_asked_as_known_ones() {
        let phrases = ["sofa", "trash can", "street lamp", "table"].map(str::to_owned);
        let [open, closed] = [false, true].map(|is_closed| KnownPhrases::new(phrases.clone(), is_closed));
        for (text, asked) in [
            ("couch", Some("sofa")),
            ("Couches", Some("sofa")),
            ("a red settee", Some("a red sofa")),
            ("wheelie-bins", Some("trash can")),
            ("lamp post", Some("street lamp")),
            ("coffee table", Some("table")),
            ("sofa", None),
            ("sofas", None),
            ("red table", None),
            ("zeppelin", None),
            ("", None),
        ] {
            assert_eq!(open.asked_as(text).as_deref(), asked, "{text}");
        }
        assert_eq!(closed.asked_as("The couch").as_deref(), Some("sofa"));
        assert_eq!((closed.asked_as("a red settee"), closed.asked_as("sofas")), (None, None));
    }

    /// By hand. A closed model refuses such texts itself.
    #[test]
    fn several_things_in_a_text_are_refused() {
        let phrases = ["sofa", "trash can", "table"].map(str::to_owned);
        let [open, closed] = [false, true].map(|is_closed| KnownPhrases::new(phrases.clone(), is_closed));
        for (text, named) in [
            ("sofa, table", &["sofa", "table"][..]),
            ("a red couch with tables", &["couch", "tables"]),
            ("Trash can or the sofa", &["trash can", "sofa"]),
            ("the sofa left of a table", &["sofa", "table"]),
            ("black and white sofa", &[]),
            ("sofa table", &[]),
            ("sofa and zeppelin", &[]),
        ] {
            let found = open.check_one(text);
            match named {
                [] => found.expect(text),
                _ => assert!(
                    matches!(&found, Err(InferenceError::SeveralThings(of)) if of == named),
                    "{text}: {found:?}"
                ),
            }
            closed.check_one(text).expect(text);
        }
    }

    #[test]
    fn groups_are_lines_of_several_distinct_phrases() {
        for line in GROUPS.lines() {
            let mut words: Vec<&str> = line.split(", ").collect();
            assert!(words.iter().all(|word| *word == word.trim() && *word == word.to_lowercase()), "{line}");
            assert!(words.iter().all(|word| word.split(' ').count() <= MAX_WORDS), "{line}");
            let n = words.len();
            words.sort_unstable();
            words.dedup();
            assert!(n > 1 && words.len() == n, "{line}");
        }
    }
}
