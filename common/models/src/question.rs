//! A question's text, prepared for a text model.

use crate::words::words;
use crate::{InferenceError, KnownPhrases};

/// Words that name nothing to find: alone, a text model would answer them with the nearest object.
const NAMELESS: &str = "a all an and any are at behind beneath between biggest bring by closest farthest fifth find first for fourth \
    from furthest go here i in is it largest littlest look me my near nearest next no not of on one or over please second show \
    smallest some take that the there these third this to under us what what's where where's which with your you";

/// Words before the thing asked for, one after another, and behind it.
const OPENINGS: &str = "please, where is, where are, where's, find me, find, show me, go to, bring me, look for, \
    take me to, is there, are there, how many, any, all of, all";
const ENDINGS: &str = "are there, is there, please";
pub const ARTICLES: [&str; 4] = ["the", "a", "an", "my"];
/// Words that compare things by size, then by distance: the most and the least.
pub const COMPARISONS: [[&str; 2]; 4] =
    [["largest", "biggest"], ["smallest", "littlest"], ["nearest", "closest"], ["farthest", "furthest"]];
/// Who asks; only robots know where that is.
const ASKERS: [&str; 3] = ["me", "us", "you"];

/// Returns the words of a text that name what to find, separated by a space: "sofa" of "Where is the sofa?".
///
/// # Errors
/// No word can name something.
pub fn words_to_find(text: &str) -> Result<String, InferenceError> {
    let words = asked_thing(text).map_or_else(|| words(text), |thing| words(&thing));
    let is_nameless =
        |word: &String| NAMELESS.split_whitespace().any(|nameless| word.eq_ignore_ascii_case(nameless));
    match words.iter().all(is_nameless) {
        true => Err(InferenceError::EmptyText),
        false => Ok(words.join(" ")),
    }
}

/// As [`words_to_find`], where only one thing can be asked for: neither several of the `known` phrases, nor one that
/// others are compared with.
pub fn one_to_find(text: &str, known: Option<&KnownPhrases>) -> Result<String, InferenceError> {
    known.map_or(Ok(()), |known| known.check_one(text))?;
    let found = words_to_find(text)?;
    let words: Vec<String> = found.split(' ').map(str::to_lowercase).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let named = without_article(&words);
    let compares = named.first().filter(|word| COMPARISONS.as_flattened().contains(word));
    let of_asker = named.last().filter(|word| ASKERS.contains(word));
    match compares.or(of_asker) {
        Some(word) if named.len() > 1 => Err(InferenceError::Comparison((*word).to_owned())),
        _ => Ok(found),
    }
}

/// Returns the thing asked for in lower case; `None` without words around a thing.
pub fn asked_thing(text: &str) -> Option<String> {
    let words = words(&text.to_lowercase());
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let asked = asked(&words);
    (asked.len() < words.len()).then(|| without_article(asked).join(" "))
}

/// Returns the words for what a question asks for, without its opening and ending.
pub fn asked<'a, 'b>(mut words: &'a [&'b str]) -> &'a [&'b str] {
    while let Some(n) = OPENINGS.split(", ").filter_map(|opening| starts(words, opening)).max() {
        words = &words[n..];
    }
    let ends = |pattern: &str| {
        let at = words.len().checked_sub(pattern.split(' ').count())?;
        starts(&words[at..], pattern).map(|_| at)
    };
    let end = ENDINGS.split(", ").filter_map(ends).min();
    &words[..end.unwrap_or(words.len())]
}

/// Returns the number of words of `pattern` if `words` begin with it.
pub fn starts(words: &[&str], pattern: &str) -> Option<usize> {
    let n = pattern.split(' ').count();
    (words.len() >= n && pattern.split(' ').eq(words[..n].iter().copied())).then_some(n)
}

pub fn without_article<'a, 'b>(words: &'a [&'b str]) -> &'a [&'b str] {
    let n_articles = words.iter().take_while(|word| ARTICLES.contains(word)).count();
    &words[n_articles..]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signs_count_for_nothing() {
        for text in
            ["chair", " chair ?", "\"chair\"", "🪑 chair", "ch\u{200d}air", "\u{202e}chair", "(chair).."]
        {
            assert_eq!(words_to_find(text).expect(text), "chair");
        }
        assert_eq!(words_to_find("a man’s T-shirt, size 3.5").expect("named"), "a man's T-shirt size 3.5");
        assert_eq!(words_to_find("so\u{ad}fa🪑ch\u{200b}air").expect("named"), "sofa chair");
        assert_eq!(words_to_find("чашка на столе").expect("named"), "чашка на столе");
    }

    #[test]
    fn what_stands_around_a_thing_is_not_looked_for() {
        for text in
            "is there a barrel|Show me the barrel!|look for a barrel|all barrel|how many barrel are there?"
                .split('|')
        {
            assert_eq!(one_to_find(text, None).expect(text), "barrel");
        }
        assert_eq!(one_to_find("the barrel", None).expect("a thing"), "the barrel");
        for text in ["largest pallet", "show me the nearest pallet", "barrel near me"] {
            assert!(matches!(one_to_find(text, None), Err(InferenceError::Comparison(_))), "{text}");
        }
    }

    #[test]
    fn a_text_that_names_nothing_is_refused() {
        let empty =
            "|?|%|..|!!!|\"|🪑🪑|\u{200b}|the|An ?|a the|of|is|Where is the|find|go to|the largest|second|on";
        for text in empty.split('|') {
            assert!(matches!(words_to_find(text), Err(InferenceError::EmptyText)), "{text}");
        }
    }
}
