//! The grammar of phrases. `docs/api.md` describes it for users.
//!
//! ```text
//! phrase   = [pick] thing [place]
//! pick     = [nth] ("largest" | "smallest" | "nearest" | "farthest")   -- or nth alone, with "from"
//!            the last two also after the thing: "chair nearest to the sink" is "nearest chair to the sink"
//! place    = relation phrase | "between" phrase "and" phrase | ("from" | "to") phrase
//! ```
//!
//! Articles are ignored. The leftmost relation divides a phrase, so relations nest to the right: "mug on the table
//! near the window" is a mug on (a table near the window). Texts over [`MAX_TEXT_BYTES`] are no phrases, which bounds
//! time and recursion.

use slag_models::question::{ARTICLES, COMPARISONS, asked, starts, without_article};
use slag_models::words;
use slag_service::params::RequestError;

use super::phrase::{ASKER, By, MAX_NTH, Phrase, Pick, Place, Relation};
use crate::text::MAX_TEXT_BYTES;

/// The words of each relation; the longest match counts.
pub(super) const RELATIONS: [(Relation, &str); 11] = [
    (Relation::On, "on top of, on"),
    (Relation::Under, "under, underneath, beneath, below"),
    (Relation::Above, "above, over"),
    (Relation::In, "in, inside, inside of, within"),
    (Relation::Near, "near, near to, close to, by, at"),
    (Relation::Beside, "beside, next to"),
    (Relation::Between, "between"),
    (Relation::LeftOf, "left of, to the left of, on the left of"),
    (Relation::RightOf, "right of, to the right of, on the right of"),
    (Relation::InFrontOf, "in front of, before"),
    (Relation::Behind, "in back of, behind, in the back of"),
];
/// As [`COMPARISONS`].
const PICKS: [By; 4] = [By::Largest, By::Smallest, By::Nearest, By::Farthest];
const NTH: [&str; 12] = [
    "first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth",
    "eleventh", "twelfth",
];
/// Words before a relation that ask for any thing.
const ANY: [&str; 3] = ["what is", "what's", "what are"];
const NEGATIONS: [&str; 4] = ["not", "isn't", "aren't", "never"];
const EXCEPTIONS: [&str; 5] = ["without", "except", "but", "besides", "excluding"];
/// Words that make "within" a distance.
const UNITS: &str = "m metre metres meter meters cm centimetres centimeters foot feet ft inches yards";

/// Words that name a side or a place only for somebody who stands somewhere.
const SIDES: [&str; 6] = ["left", "right", "front", "back", "middle", "there"];
const BEFORE_SIDES: [&str; 6] = ["from", "on", "to", "at", "in", "over"];

/// Parses a text as a phrase; `None` if it names no relation and no pick, or is too long: it is then one thing, for
/// the text model. [`Phrase::check`] checks the limits.
///
/// # Errors
/// A word that would turn the meaning of a relation is not understood: without it, another thing would be found.
pub fn understand(text: &str) -> Result<Option<Phrase>, RequestError> {
    if text.len() > MAX_TEXT_BYTES {
        return Ok(None);
    }
    let words = words_of(text);
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let words = asked(&words);
    let any =
        ANY.iter().filter_map(|pattern| starts(words, pattern)).find(|n| relation(&words[*n..]).is_some());
    let words = any.map_or(words.to_vec(), |n| [&["thing"], &words[n..]].concat());
    refuse(&words)?;
    let found = phrase(&words);
    Ok(found.filter(|of| !of.is_asker() && (of.pick.is_some() || of.relation.is_some())))
}

/// Refuses words that are not understood beside relations and comparisons.
fn refuse(words: &[&str]) -> Result<(), RequestError> {
    let refused = |found: String, expected: String| Err(RequestError::new("text", &found, expected));
    if let ["not", ..] = words {
        return refused(
            words.join(" "),
            "what to look for; negatives name what must not be found".to_owned(),
        );
    }
    for at in 1..words.len() {
        let (here, after) = (words[at], &words[at + 1..]);
        let turns = EXCEPTIONS.contains(&here) || NEGATIONS.contains(&here) && relation(after).is_some();
        if !after.is_empty() && turns {
            let named = thing(&words[..at]).map_or_else(|| "the thing".to_owned(), |of| of.thing);
            let advice = format!("no {here:?}, which relations do not understand; ask for {named:?} alone");
            return refused(words.join(" "), advice);
        }
        if matches!(here, "and" | "or") && relation(after).is_some() {
            let advice = format!("one place for a thing; ask for {:?} alone", words[..at].join(" "));
            return refused(words.join(" "), advice);
        }
        if here == "within" && after.iter().take(3).any(|word| UNITS.split(' ').any(|unit| unit == *word)) {
            let advice =
                "near in place of a distance, or the distance as radius around a position given as near";
            return refused(words[at..].join(" "), advice.to_owned());
        }
    }
    // "Second chair from the left": of nobody knows whom.
    if let [before @ .., side] = words
        && SIDES.contains(side)
        && let before =
            &before[..before.iter().rposition(|word| !ARTICLES.contains(word)).map_or(0, |at| at + 1)]
        && before.len() > 1
        && BEFORE_SIDES.contains(&before[before.len() - 1])
    {
        let advice =
            "what it is left of, near to or counted from, as in \"left of the door\" or \"left of me\"";
        return refused(words.join(" "), advice.to_owned());
    }
    let is_nth = |word: &str| ["st", "nd", "rd", "th"].iter().any(|end| word.ends_with(end));
    match without_article(words) {
        [first, by, after @ ..]
            if is_nth(first)
                && nth(&[first]).0.is_none()
                && picked(by).is_some()
                && origin(after).is_none() =>
        {
            refused(
                (*first).to_owned(),
                format!("a number from 1st to {MAX_NTH}th, or in words up to twelfth"),
            )
        }
        _ => Ok(()),
    }
}

/// Returns a text's words in lower case without what stands before the thing: texts that ask the same are equal.
pub fn normal(text: &str) -> String {
    let words = words_of(text);
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    without_article(asked(&words)).join(" ")
}

/// Returns the words of a text in lower case, and those of "on-the", which name no thing, apart.
fn words_of(text: &str) -> Vec<String> {
    let is_of_relation = |word: &str| {
        let mut patterns = RELATIONS.iter().flat_map(|(_, patterns)| patterns.split(", "));
        patterns.any(|pattern| pattern.split(' ').any(|part| part == word))
    };
    let is_bare = |part: &str| ARTICLES.contains(&part) || is_of_relation(part);
    let apart = |word: String| match word.split('-').all(is_bare) {
        true => word.split('-').map(str::to_owned).collect(),
        false => vec![word],
    };
    words(&text.to_lowercase()).into_iter().flat_map(apart).collect()
}

fn picked(word: &str) -> Option<By> {
    COMPARISONS.iter().position(|names| names.contains(&word)).map(|at| PICKS[at])
}

/// Returns the words after "to" or "from", or those that begin with an article or are the asker.
fn origin<'a, 'b>(words: &'a [&'b str]) -> Option<&'a [&'b str]> {
    let (first, rest) = words.split_first()?;
    match *first {
        "to" | "from" => Some(rest),
        word => (ARTICLES.contains(&word) || ASKER.contains(&word)).then_some(words),
    }
}

/// Returns the relation that begins here, and its number of words.
fn relation(words: &[&str]) -> Option<(Relation, usize)> {
    let longest = |patterns: &str| patterns.split(", ").filter_map(|pattern| starts(words, pattern)).max();
    let here = RELATIONS.iter().filter_map(|(is, patterns)| Some((*is, longest(patterns)?)));
    here.max_by_key(|(_, n)| *n)
}

/// Parses a phrase, or `None`. Each level of recursion names a thing.
fn phrase(words: &[&str]) -> Option<Phrase> {
    let words = without_article(words);
    let (nth, rest) = nth(words);
    let by = rest.first().and_then(|word| picked(word));
    let head = if by.is_some() { &rest[1..] } else { rest };
    let is_from = |at: usize| match by {
        Some(by) => by.is_distance() && matches!(head[at], "from" | "to"),
        None => nth.is_some() && head[at] == "from",
    };
    // "Nearest to the sink" after the thing; "nearest" before another word may be of a name.
    let picks = |at: usize| {
        let by = picked(head[at]).filter(|of| by.is_none() && of.is_distance())?;
        Some((by, origin(&head[at + 1..])?))
    };
    // The thing itself takes at least one word, as does the part after the relation.
    let mut places = 1..head.len().saturating_sub(1);
    let at = places.find(|at| is_from(*at) || picks(*at).is_some() || relation(&head[*at..]).is_some());
    let pick = |by: Option<By>, from: Option<Phrase>| -> Option<Pick> {
        let by = by.or(from.is_some().then_some(By::Nearest))?;
        Some(Pick { by, n: nth.unwrap_or(1), from: from.map(Box::new) })
    };
    let Some(at) = at else {
        // "First aid box": a number with nothing to count from is part of the name.
        let named = if by.is_some() { head } else { words };
        return Some(Phrase { pick: pick(by, None), ..thing(named)? });
    };
    let from =
        if is_from(at) { Some((by, &head[at + 1..])) } else { picks(at).map(|(by, of)| (Some(by), of)) };
    if let Some((by, from)) = from {
        return Some(Phrase { pick: pick(by, Some(phrase(from)?)), ..thing(&head[..at])? });
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
    Some(Phrase { pick: pick(by, None), relation: Some(Box::new(place)), ..thing(named)? })
}

fn thing(words: &[&str]) -> Option<Phrase> {
    let mut words = without_article(words);
    // "Chair that is on the rug".
    while let [named @ .., "that" | "which" | "is" | "are"] = words {
        words = named;
    }
    (!words.is_empty()).then(|| Phrase::thing(words.join(" ")))
}

/// Reads "second" or "2nd".
fn nth<'a, 'b>(words: &'a [&'b str]) -> (Option<usize>, &'a [&'b str]) {
    let Some((first, rest)) = words.split_first() else { return (None, words) };
    let spelt = NTH.iter().position(|name| name == first).map(|at| at + 1);
    let digits = || {
        let number = ["st", "nd", "rd", "th"].iter().find_map(|end| first.strip_suffix(end))?;
        number.parse().ok()
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
    use slag_test_support::assert_error;

    fn read(text: &str) -> Value {
        serde_json::to_value(understand(text).expect(text)).expect("JSON")
    }

    #[test]
    fn the_issues_phrases_are_understood() {
        let on = |a: &str, is: &str, b: &str| json!({"thing": a, "relation": {"is": is, "of": {"thing": b}}});
        assert_eq!(read("mug on the table"), on("mug", "on", "table"));
        assert_eq!(read("Where is the chair near the window?"), on("chair", "near", "window"));
        assert_eq!(read("tools in the workshop"), on("tools", "in", "workshop"));
        let found = read("the red mug to the left of a dining table");
        assert_eq!(found, on("red mug", "left-of", "dining table"));
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
        let found = read("the table between the sofa and the lamp");
        assert_eq!(found, json!({"thing": "table", "relation": both}));
        let table = on("table", "near", "window");
        let found = read("mug on the table near the window");
        assert_eq!(found, json!({"thing": "mug", "relation": {"is": "on", "of": table}}));
    }

    #[test]
    fn people_ask_in_many_words_and_signs() {
        let same = |one: &str, other: &str| assert_eq!(read(one), read(other), "{one}");
        let is_phrase = |text: &str| assert!(read(text).is_object(), "{text}");
        for text in
            ["chair closest to the sink", "chair that is nearest to the sink", "chair nearest the sink"]
        {
            same(text, "nearest chair to the sink");
        }
        same("second thing farthest from the door", "second farthest thing from the door");
        same("mug nearest me", "nearest mug to me");
        let texts = "bottle (on the table); Where\u{2019}s the bottle on the table?; bottle on-the table; \
            \u{201c}bottle\u{201d}\u{2026}on the table; please find the bottle on the table; \
            is there a bottle on the table; Please show me any bottle on the table!; bottle which is on the table";
        for text in texts.split("; ") {
            same(text, "bottle on the table");
            is_phrase(text);
        }
        same("are there any bottles on the table", "bottles on the table");
        same("how many bottles are on the table?", "bottles on the table");
        assert!(understand("not a bottle").is_err());
        same("all of the bottles on the table", "bottles on the table");
        same("what is on the table", "thing on the table");
        same("What\u{2019}s on the table?", "thing on the table");
        is_phrase("twelfth largest thing");
        assert_eq!(read("t-shirt"), Value::Null);
    }

    /// Words that are not understood are refused by name, rather than left out or taken for a thing.
    #[test]
    fn what_would_be_misunderstood_is_refused() {
        for (text, named) in [
            ("chair not near the table", "\"not\""),
            ("chair without arms", "\"without\""),
            ("anything but the bottle", "\"but\""),
            ("chair except the red one", "\"except\""),
            ("picture above the television and left of the clock", "\"picture above the television\" alone"),
            ("chair within 3 m of the door", "radius"),
            ("twenty-first nearest chair", "100th"),
            ("the second chair from the left", "left of me"),
            ("barrel on the right", "left of me"),
            ("thing on my left", "left of me"),
            ("barrel in front", "left of me"),
            ("tent over there", "left of me"),
        ] {
            assert_error(understand(text), &[named]);
        }
        for text in ["101st nearest chair", "0th nearest chair"] {
            assert!(understand(text).expect(text).expect("a phrase").check().is_err(), "{text}");
        }
        for text in ["do not enter sign", "first aid box"] {
            assert_eq!(understand(text), Ok(None), "{text}");
        }
        assert!(read("chest nearest the door").is_object());
    }

    #[test]
    fn what_is_no_relation_stays_a_plain_phrase() {
        let texts = "chair; red chair; first aid box; something to sit on; on; on the table; between a and b; \
            chair between the tables; ; ?; second chair; the; largest; mug on the";
        for text in texts.split("; ") {
            let found = understand(text).expect(text);
            assert!(found.is_none(), "{text}: {found:?}");
        }
    }

    /// On a thread with the stack of the service's threads: one recursion per relation overflowed it.
    #[test]
    fn long_texts_are_no_phrases() {
        let read = |text: String| {
            let read = std::thread::Builder::new()
                .stack_size(2 << 20)
                .spawn(move || understand(&text).expect("understood"));
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
        let phrase =
            understand("third nearest mug to the lamp on the desk").expect("understood").expect("a phrase");
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
        assert!(serde_json::from_value::<Phrase>(json!({"thing": "a", "relation": {"is": "upon"}})).is_err());
    }
}
