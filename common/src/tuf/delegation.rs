//! Which paths a delegated role signs for.

use sha2::{Digest, Sha256};

use super::metadata::DelegatedRole;

impl DelegatedRole {
    /// Returns whether the role may sign for a path.
    pub fn signs_for(&self, path: &str) -> bool {
        if let Some(patterns) = &self.paths {
            return patterns.iter().any(|pattern| matches_path(pattern, path));
        }
        let hash = hex::encode(Sha256::digest(path));
        self.path_hash_prefixes.iter().flatten().any(|prefix| hash.starts_with(prefix.as_str()))
    }
}

/// Matches a path against a pattern, part by part: `*` is any text of a part, `?` any one character.
fn matches_path(pattern: &str, path: &str) -> bool {
    let (patterns, parts): (Vec<&str>, Vec<&str>) = (pattern.split('/').collect(), path.split('/').collect());
    patterns.len() == parts.len() && patterns.iter().zip(&parts).all(|(p, part)| matches_part(p, part))
}

fn matches_part(pattern: &str, part: &str) -> bool {
    let (pattern, part): (Vec<char>, Vec<char>) = (pattern.chars().collect(), part.chars().collect());
    let (mut p, mut t) = (0, 0);
    // Where the last star stands, and the text that it has taken so far: at a mismatch it takes one more.
    let mut star: Option<(usize, usize)> = None;
    while t < part.len() {
        match pattern.get(p) {
            Some('*') => {
                star = Some((p, t));
                p += 1;
            }
            Some(c) if *c == '?' || *c == part[t] => {
                p += 1;
                t += 1;
            }
            _ => {
                let Some((at, taken)) = star else { return false };
                star = Some((at, taken + 1));
                p = at + 1;
                t = taken + 1;
            }
        }
    }
    pattern[p..].iter().all(|c| *c == '*')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_stay_within_a_part() {
        for (pattern, path, expected) in [
            ("a/*.tgz", "a/b.tgz", true),
            ("a/*.tgz", "a/b/c.tgz", false),
            ("*", "a/b", false),
            ("*/*", "a/b", true),
            ("a-?-*z*", "a-b-czzd", true),
            ("a-?", "a-", false),
            ("", "", true),
            ("**b", "aab", true),
            ("*ab*ab", "xabab", true),
            ("*ab*abc", "xababab", false),
        ] {
            assert_eq!(matches_path(pattern, path), expected, "{pattern} {path}");
        }
    }
}
