//! Everyday words and phrases: what to expect of people who ask a model that takes any text.

/// Phrases, one a line, as people ask them.
const TEXTS: &str = include_str!("everyday.txt");
/// Nouns of things, one a line, sorted.
const NOUNS: &str = include_str!("nouns.txt");

/// Returns phrases as people ask them, articles included.
pub fn everyday_texts() -> impl Iterator<Item = &'static str> {
    TEXTS.lines()
}

/// Returns nouns of things indoors, outdoors and on the road: what a thing may be called by a model that has no words
/// of its own.
pub fn everyday_nouns() -> impl Iterator<Item = &'static str> {
    NOUNS.lines()
}

#[cfg(test)]
mod tests {
    use super::*;

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
