//! The grammar of phrases. `docs/api.md` describes it for users.
//!
//! ```text
//! phrase   = [pick] thing [place]
//! pick     = [nth] ("largest" | "smallest" | "nearest" | "farthest")   -- or nth alone, with "from"
//! place    = relation phrase | "between" phrase "and" phrase | ("from" | "to") phrase
//! ```
//!
//! Articles are ignored. The leftmost relation divides a phrase, so relations nest to the right: "mug on the table
//! near the window" is a mug on (a table near the window). Texts over [`MAX_TEXT_BYTES`] are no phrases, which bounds
//! time and recursion.

use super::phrase::{By, Phrase, Pick, Place, Relation};
use crate::text::MAX_TEXT_BYTES;

/// The words of each relation; the longest match counts.
const RELATIONS: [(&str, Relation); 31] = [
    ("on top of", Relation::On),
    ("on", Relation::On),
    ("under", Relation::Under),
    ("underneath", Relation::Under),
    ("beneath", Relation::Under),
    ("below", Relation::Under),
    ("above", Relation::Above),
    ("over", Relation::Above),
    ("in", Relation::In),
    ("inside", Relation::In),
    ("inside of", Relation::In),
    ("within", Relation::In),
    ("near", Relation::Near),
    ("near to", Relation::Near),
    ("close to", Relation::Near),
    ("by", Relation::Near),
    ("at", Relation::Near),
    ("beside", Relation::Beside),
    ("next to", Relation::Beside),
    ("between", Relation::Between),
    ("left of", Relation::LeftOf),
    ("to the left of", Relation::LeftOf),
    ("on the left of", Relation::LeftOf),
    ("right of", Relation::RightOf),
    ("to the right of", Relation::RightOf),
    ("on the right of", Relation::RightOf),
    ("in front of", Relation::InFrontOf),
    ("before", Relation::InFrontOf),
    ("in back of", Relation::Behind),
    ("behind", Relation::Behind),
    ("in the back of", Relation::Behind),
];
const PICKS: [(&str, By); 8] = [
    ("largest", By::Largest),
    ("biggest", By::Largest),
    ("smallest", By::Smallest),
    ("littlest", By::Smallest),
    ("nearest", By::Nearest),
    ("closest", By::Nearest),
    ("farthest", By::Farthest),
    ("furthest", By::Farthest),
];
const NTH: [&str; 10] =
    ["first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth"];
const ARTICLES: [&str; 4] = ["the", "a", "an", "my"];
/// Words before the thing asked for.
const OPENINGS: [&str; 10] = [
    "where is",
    "where are",
    "where's",
    "find me",
    "find",
    "show me",
    "go to",
    "bring me",
    "look for",
    "take me to",
];

/// Parses a text as a phrase; `None` if it names no relation and no pick, or is too long: it is then one thing, for
/// the text model. [`Phrase::check`] checks the limits.
pub fn understand(text: &str) -> Option<Phrase> {
    if text.len() > MAX_TEXT_BYTES {
        return None;
    }
    let lower = text.to_lowercase();
    let words = words(&lower);
    let phrase = phrase(&words[opening(&words)..])?;
    (!phrase.is_asker() && (phrase.pick.is_some() || phrase.relation.is_some())).then_some(phrase)
}

/// Returns the thing asked for ("sofa" for "Where is the sofa?"); `None` without words before a thing.
pub fn asked_thing(text: &str) -> Option<String> {
    let lower = text.to_lowercase();
    let words = words(&lower);
    let thing = match opening(&words) {
        0 => return None,
        opening => without_article(&words[opening..]),
    };
    (!thing.is_empty()).then(|| thing.join(" "))
}

/// Returns the words of a text without surrounding punctuation.
fn words(lower: &str) -> Vec<&str> {
    let words = lower.split_whitespace().map(|word| word.trim_matches(['.', ',', '?', '!', '"']));
    words.filter(|word| !word.is_empty()).collect()
}

fn opening(words: &[&str]) -> usize {
    OPENINGS.iter().filter_map(|opening| starts(words, opening)).max().unwrap_or(0)
}

/// Returns the number of words of `pattern` if `words` begin with it.
fn starts(words: &[&str], pattern: &str) -> Option<usize> {
    let n = pattern.split(' ').count();
    (words.len() >= n && pattern.split(' ').eq(words[..n].iter().copied())).then_some(n)
}

/// Returns the relation that begins here, and its number of words.
fn relation(words: &[&str]) -> Option<(Relation, usize)> {
    let here = RELATIONS.iter().filter_map(|(pattern, is)| Some((*is, starts(words, pattern)?)));
    here.max_by_key(|(_, n)| *n)
}

fn without_article<'a, 'b>(words: &'a [&'b str]) -> &'a [&'b str] {
    let n_articles = words.iter().take_while(|word| ARTICLES.contains(word)).count();
    &words[n_articles..]
}

/// Parses a phrase, or `None`. Each level of recursion names a thing.
fn phrase(words: &[&str]) -> Option<Phrase> {
    let words = without_article(words);
    let (nth, rest) = nth(words);
    let by = rest.first().and_then(|word| PICKS.iter().find(|(name, _)| name == word)).map(|(_, by)| *by);
    let head = if by.is_some() { &rest[1..] } else { rest };
    let is_from = |at: usize| match by {
        Some(by) => by.is_distance() && matches!(head[at], "from" | "to"),
        None => nth.is_some() && head[at] == "from",
    };
    // The thing itself takes at least one word, as does the part after the relation.
    let at = (1..head.len().saturating_sub(1)).find(|at| is_from(*at) || relation(&head[*at..]).is_some());
    let pick = |from: Option<Phrase>| -> Option<Pick> {
        let by = by.or(from.is_some().then_some(By::Nearest))?;
        Some(Pick { by, n: nth.unwrap_or(1), from: from.map(Box::new) })
    };
    let Some(at) = at else {
        // "First aid box": a number with nothing to count from is part of the name.
        let named = if by.is_some() { head } else { words };
        return Some(Phrase { pick: pick(None), ..thing(named)? });
    };
    if is_from(at) {
        let from = phrase(&head[at + 1..])?;
        return Some(Phrase { pick: pick(Some(from)), ..thing(&head[..at])? });
    }
    let (is, n) = relation(&head[at..])?;
    let after = &head[at + n..];
    let named = if by.is_some() { &head[..at] } else { &words[..words.len() - head.len() + at] };
    let place = if is == Relation::Between {
        let and = after.iter().position(|word| *word == "and")?;
        Place { is, of: phrase(&after[..and])?, and: Some(phrase(&after[and + 1..])?) }
    } else {
        Place { is, of: phrase(after)?, and: None }
    };
    Some(Phrase { pick: pick(None), relation: Some(Box::new(place)), ..thing(named)? })
}

fn thing(words: &[&str]) -> Option<Phrase> {
    let words = without_article(words);
    (!words.is_empty()).then(|| Phrase::thing(words.join(" ")))
}

/// Reads "second" or "2nd".
fn nth<'a, 'b>(words: &'a [&'b str]) -> (Option<usize>, &'a [&'b str]) {
    let Some((first, rest)) = words.split_first() else { return (None, words) };
    let spelt = NTH.iter().position(|name| name == first).map(|at| at + 1);
    let digits = || {
        let number = ["st", "nd", "rd", "th"].iter().find_map(|end| first.strip_suffix(end))?;
        number.parse().ok().filter(|n| *n > 0)
    };
    match spelt.or_else(digits) {
        Some(n) => (Some(n), rest),
        None => (None, words),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn read(text: &str) -> Value {
        serde_json::to_value(understand(text)).expect("JSON")
    }

    #[test]
    fn the_issues_phrases_are_understood() {
        let on = |a: &str, is: &str, b: &str| json!({"thing": a, "relation": {"is": is, "of": {"thing": b}}});
        assert_eq!(read("mug on the table"), on("mug", "on", "table"));
        assert_eq!(read("Where is the chair near the window?"), on("chair", "near", "window"));
        assert_eq!(read("tools in the workshop"), on("tools", "in", "workshop"));
        assert_eq!(
            read("the red mug to the left of a dining table"),
            on("red mug", "left-of", "dining table")
        );
        assert_eq!(read("box in front of me"), on("box", "in-front-of", "me"));
        let largest = json!({"by": "largest", "n": 1});
        assert_eq!(
            read("the largest box left of the door"),
            json!({"thing": "box", "pick": largest, "relation": {"is": "left-of", "of": {"thing": "door"}}})
        );
        let second = json!({"by": "nearest", "n": 2, "from": {"thing": "gate"}});
        assert_eq!(read("second pallet from the gate"), json!({"thing": "pallet", "pick": second}));
        assert_eq!(read("2nd nearest pallet to the gate"), json!({"thing": "pallet", "pick": second}));
        assert_eq!(read("biggest chair"), json!({"thing": "chair", "pick": largest}));
        let both = json!({"is": "between", "of": {"thing": "sofa"}, "and": {"thing": "lamp"}});
        assert_eq!(
            read("the table between the sofa and the lamp"),
            json!({"thing": "table", "relation": both})
        );
        let table = on("table", "near", "window");
        assert_eq!(
            read("mug on the table near the window"),
            json!({"thing": "mug", "relation": {"is": "on", "of": table}})
        );
    }

    #[test]
    fn what_is_no_relation_stays_a_plain_phrase() {
        for text in [
            "chair",
            "red chair",
            "first aid box",
            "something to sit on",
            "on",
            "on the table",
            "between a and b",
            "chair between the tables",
            "",
            "?",
            "second chair",
            "the",
            "largest",
            "mug on the",
        ] {
            let found = understand(text);
            assert!(found.is_none(), "{text}: {found:?}");
        }
    }

    /// On a thread with the stack of the service's threads: one recursion per relation overflowed it.
    #[test]
    fn long_texts_are_no_phrases() {
        let read = |text: String| {
            let read = std::thread::Builder::new().stack_size(2 << 20).spawn(move || understand(&text));
            read.expect("a thread").join().expect("no overflow")
        };
        // No article, which would be nothing.
        let relations = |n: usize| format!("b {}", "on b ".repeat(n));
        assert_eq!(read(relations(7)).map(|phrase| phrase.check()), Some(Ok(())));
        let most = read(relations(101)).expect("512 bytes").check().expect_err("too many things");
        assert_eq!((most.found, most.expected), ("\"102 things\"".to_owned(), "at most 8".to_owned()));
        let long = [
            relations(9_000),
            "c between ".repeat(9_000) + &"and b ".repeat(9_000),
            "the ".repeat(12_000) + "mug on the table",
            "nearest c from ".repeat(9_000) + "b",
        ];
        for text in long {
            let shown: String = text.chars().take(40).collect();
            assert_eq!(read(text), None, "{shown}");
        }
    }

    /// Phrases survive JSON and back; errors in JSON are named.
    #[test]
    fn phrases_are_checked() {
        let phrase = understand("third nearest mug to the lamp on the desk").expect("a phrase");
        let text = serde_json::to_string(&phrase).expect("JSON");
        assert_eq!(serde_json::from_str::<Phrase>(&text).expect("a phrase"), phrase);
        assert_eq!(phrase.check(), Ok(()));
        assert_eq!(phrase.things(), ["mug", "lamp", "desk"]);
        let bad = [
            json!({"thing": " "}),
            json!({"thing": "me"}),
            json!({"thing": "a\u{7}"}),
            json!({"thing": "a", "pick": {"by": "nearest", "n": 0}}),
            json!({"thing": "a", "pick": {"by": "largest", "from": {"thing": "b"}}}),
            json!({"thing": "a", "relation": {"is": "between", "of": {"thing": "b"}}}),
            json!({"thing": "a", "relation": {"is": "on", "of": {"thing": "b"}, "and": {"thing": "c"}}}),
        ];
        for bad in bad {
            let phrase: Phrase = serde_json::from_value(bad.clone()).expect("a phrase");
            assert!(phrase.check().is_err(), "{bad}");
        }
        let mut deep = Phrase::thing("a");
        for _ in 0..8 {
            deep = Phrase {
                relation: Some(Box::new(Place { is: Relation::Near, of: deep, and: None })),
                ..Phrase::thing("b")
            };
        }
        assert!(deep.check().is_err());
        assert!(serde_json::from_value::<Phrase>(json!({"thing": "a", "relation": {"is": "upon"}})).is_err());
    }
}
