//! The words of a question, prepared for a text model.

use crate::InferenceError;

/// Words that name nothing to find: alone, a text model would answer them with the nearest object.
const NAMELESS: &str = "a an and are at behind beneath between biggest bring by closest farthest fifth find first for fourth \
    from furthest go here i in is it largest littlest look me my near nearest next no not of on one or over second show \
    smallest some take that the there these third this to under us what where where's which with your you";

/// Returns the words of a text, separated by a space, without signs around them (emoji, quotation and question marks,
/// invisible characters). Refuses a text without a word that can name something.
pub fn words_to_find(text: &str) -> Result<String, InferenceError> {
    let is_invisible = |c: &char| matches!(c, '\u{ad}' | '\u{200b}'..='\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2060}'..='\u{2069}' | '\u{fe00}'..='\u{fe0f}' | '\u{feff}');
    let visible: String = text.chars().filter(|c| !is_invisible(c)).collect();
    // A sign within a word, as in "t-shirt", belongs to it; emoji separate words.
    let is_between = |c: char| c.is_whitespace() || !(c.is_ascii() || c.is_alphanumeric() || is_mark(c));
    let words = visible
        .split(is_between)
        .map(|word| word.trim_matches(|c: char| !(c.is_alphanumeric() || is_mark(c))));
    let words: Vec<&str> = words.filter(|word| !word.is_empty()).collect();
    let is_nameless =
        |word: &&str| NAMELESS.split_whitespace().any(|nameless| word.eq_ignore_ascii_case(nameless));
    match words.iter().all(is_nameless) {
        true => Err(InferenceError::EmptyText),
        false => Ok(words.join(" ")),
    }
}

/// Combining marks and typographic apostrophes are part of a word.
fn is_mark(c: char) -> bool {
    matches!(c, '\u{300}'..='\u{36f}' | '\u{2019}')
}

/// Phrases as people ask them, one per line.
const TEXTS: &str = include_str!("everyday.txt");
/// Nouns of objects, one per line, sorted.
const NOUNS: &str = include_str!("nouns.txt");

pub fn everyday_texts() -> impl Iterator<Item = &'static str> {
    TEXTS.lines()
}

/// Nouns of objects indoors, outdoors and on the road, as names for models without words of their own.
pub fn everyday_nouns() -> impl Iterator<Item = &'static str> {
    NOUNS.lines()
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
        assert_eq!(words_to_find("a man’s T-shirt, size 3.5").expect("named"), "a man’s T-shirt size 3.5");
        assert_eq!(words_to_find("so\u{ad}fa🪑ch\u{200b}air").expect("named"), "sofa chair");
        assert_eq!(words_to_find("чашка на столе").expect("named"), "чашка на столе");
    }

    #[test]
    fn a_text_that_names_nothing_is_refused() {
        for text in [
            "",
            "?",
            "%",
            "..",
            "!!!",
            "\"",
            "🪑🪑",
            "\u{200b}",
            "the",
            "An ?",
            "a the",
            "of",
            "is",
            "Where is the",
            "find",
            "go to",
            "the largest",
            "second",
            "on",
        ] {
            assert!(matches!(words_to_find(text), Err(InferenceError::EmptyText)), "{text}");
        }
    }

    #[test]
    fn nouns_are_distinct_and_bare() {
        let nouns: Vec<&str> = everyday_nouns().collect();
        assert!(nouns.is_sorted_by(|a, b| a < b) && nouns.len() > 1600, "{}", nouns.len());
        for noun in ["aeroplane", "person", "sofa", "traffic cone", "washing machine"] {
            assert!(nouns.contains(&noun), "{noun}");
        }
        let is_bare = |noun: &&str| noun.trim() == *noun && !noun.starts_with("a ") && !noun.contains(',');
        assert!(nouns.iter().all(is_bare));
    }
}
