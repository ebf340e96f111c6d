//! Words of texts, and lists of what people ask for.

/// Returns the words of a text: letters, digits and apostrophes, with hyphens between them and points between digits.
pub fn words(text: &str) -> Vec<String> {
    let is_invisible = |c: &char| matches!(c, '\u{ad}' | '\u{200b}'..='\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2060}'..='\u{2069}' | '\u{fe00}'..='\u{fe0f}' | '\u{feff}');
    let plain = |c: char| match c {
        '\u{2018}' | '\u{2019}' | '\u{2bc}' => '\'',
        '\u{2010}' | '\u{2011}' => '-',
        other => other,
    };
    let signs: Vec<char> = text.chars().filter(|c| !is_invisible(c)).map(plain).collect();
    // Combining marks are part of a letter.
    let is_letter = |c: char| c.is_alphanumeric() || matches!(c, '\u{300}'..='\u{36f}');
    let around = |at: usize, is: fn(char) -> bool| {
        at > 0 && is(signs[at - 1]) && signs.get(at + 1).is_some_and(|after| is(*after))
    };
    let of_word = |(at, c): (usize, &char)| match c {
        '-' if around(at, char::is_alphanumeric) => '-',
        '.' if around(at, |c| c.is_ascii_digit()) => '.',
        c if is_letter(*c) || *c == '\'' => *c,
        _ => ' ',
    };
    let words: String = signs.iter().enumerate().map(of_word).collect();
    let words = words.split(' ').map(|word| word.trim_matches('\''));
    words.filter(|word| !word.is_empty()).map(str::to_owned).collect()
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
    fn words_have_letters_and_hyphens() {
        let found = words("bottle… (on-the) ‘table’/coffee_mug -");
        assert_eq!(found, ["bottle", "on-the", "table", "coffee", "mug"]);
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
