//! Everyday words and phrases: the queries to expect of a model that takes any text.

/// Phrases, one a line, as people ask them.
const TEXTS: &str = include_str!("everyday.txt");
/// Phrases with one of these name no single thing: relations and uses.
const NOT_WORDS: [&str; 3] = [" on ", " in ", "something "];

/// Returns phrases as people ask them, articles included.
pub fn everyday_texts() -> impl Iterator<Item = &'static str> {
    TEXTS.lines()
}

/// Returns those that name a thing, a material or a colour, without articles.
pub fn everyday_words() -> impl Iterator<Item = &'static str> {
    let is_word = |text: &&str| !NOT_WORDS.iter().any(|part| text.contains(part));
    let bare = |text: &'static str| ["a ", "an "].iter().find_map(|article| text.strip_prefix(article));
    everyday_texts().filter(is_word).map(move |text| bare(text).unwrap_or(text))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_have_no_articles_and_no_relations() {
        let words: Vec<&str> = everyday_words().collect();
        for word in ["person", "aeroplane", "washing machine", "stairs", "red", "the sky"] {
            assert!(words.contains(&word), "{word}");
        }
        let others = ["a person", "picture on the wall", "something dangerous", "plant in a pot"];
        assert!(others.iter().all(|text| !words.contains(text)));
        assert!(words.len() > 150 && words.len() < everyday_texts().count());
    }
}
