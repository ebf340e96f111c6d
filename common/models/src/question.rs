//! A question's text, prepared for a text model.

use crate::words::words;
use crate::{InferenceError, KnownPhrases};

/// Words that name nothing to find: alone, a text model would answer them with the nearest object.
const NAMELESS: &str = "a all an and any are at behind beneath between biggest bring by closest farthest fifth find first for fourth \
    from furthest go here i in is it largest littlest look me my near nearest next no not of on one or over please second show \
    smallest some take that the there these third this to under us what what's where where's which with your you";

/// Returns the words of a text, separated by a space. Refuses a text without a word that can name something, and one
/// that names several of the `known` phrases.
pub fn words_to_find(text: &str, known: Option<&KnownPhrases>) -> Result<String, InferenceError> {
    known.map_or(Ok(()), |known| known.check_one(text))?;
    let words = words(text);
    let is_nameless =
        |word: &String| NAMELESS.split_whitespace().any(|nameless| word.eq_ignore_ascii_case(nameless));
    match words.iter().all(is_nameless) {
        true => Err(InferenceError::EmptyText),
        false => Ok(words.join(" ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signs_count_for_nothing() {
        for text in
            ["chair", " chair ?", "\"chair\"", "🪑 chair", "ch\u{200d}air", "\u{202e}chair", "(chair).."]
        {
            assert_eq!(words_to_find(text, None).expect(text), "chair");
        }
        assert_eq!(
            words_to_find("a man’s T-shirt, size 3.5", None).expect("named"),
            "a man's T-shirt size 3.5"
        );
        assert_eq!(words_to_find("so\u{ad}fa🪑ch\u{200b}air", None).expect("named"), "sofa chair");
        assert_eq!(words_to_find("чашка на столе", None).expect("named"), "чашка на столе");
    }

    #[test]
    fn a_text_that_names_nothing_is_refused() {
        let empty =
            "|?|%|..|!!!|\"|🪑🪑|\u{200b}|the|An ?|a the|of|is|Where is the|find|go to|the largest|second|on";
        for text in empty.split('|') {
            assert!(matches!(words_to_find(text, None), Err(InferenceError::EmptyText)), "{text}");
        }
    }
}
