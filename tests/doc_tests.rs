//! The documents of formats and numerics promise nothing that no test holds: every test that they name exists.

use std::collections::BTreeSet;
use std::path::Path;

use slag_tests::root;

/// Folders with tests.
const FOLDERS: [&str; 4] = ["common", "encoder", "edge", "tests"];

/// Collects the functions of all Rust files below a folder: `function` and `file::function`.
fn collect(dir: &Path, found: &mut BTreeSet<String>) {
    for entry in fs_err::read_dir(dir).expect("a folder") {
        let path = entry.expect("an entry").path();
        if path.is_dir() && !path.ends_with("target") {
            collect(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            let text = fs_err::read_to_string(&path).expect("a source file");
            let module = path.file_stem().and_then(|stem| stem.to_str()).expect("a name");
            for line in text.lines() {
                let line = line.trim_start().trim_start_matches("pub ").trim_start_matches("async ");
                let Some(rest) = line.strip_prefix("fn ") else { continue };
                let is_name = |c: char| c.is_ascii_alphanumeric() || c == '_';
                let name: String = rest.chars().take_while(|c| is_name(*c)).collect();
                found.insert(format!("{module}::{name}"));
                found.insert(name);
            }
        }
    }
}

/// Returns the names of tests in a text: words in backquotes with a `::`, or of at least four parts (`a_b_c_d`). Names of
/// columns and fields are shorter.
fn tests_named(text: &str) -> Vec<&str> {
    let is_name = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_' || c == ':';
    let words = text.split('`').skip(1).step_by(2);
    let is_test =
        |word: &&str| word.chars().all(is_name) && (word.contains("::") || word.split('_').count() > 3);
    words.filter(is_test).collect()
}

#[test]
fn every_test_that_the_documents_name_exists() {
    let mut known = BTreeSet::new();
    FOLDERS.iter().for_each(|folder| collect(&root().join(folder), &mut known));
    for (document, n_least) in
        [("formats.md", 20), ("numerics.md", 40), ("accuracy.md", 5), ("security.md", 20)]
    {
        let text = fs_err::read_to_string(root().join("docs").join(document)).expect("the document");
        let named = tests_named(&text);
        assert!(named.len() >= n_least, "{document} names {} tests", named.len());
        let missing: Vec<&&str> = named.iter().filter(|name| !known.contains(**name)).collect();
        assert!(missing.is_empty(), "docs/{document} names tests that do not exist: {missing:?}");
        assert!(!text.contains("_...`"), "docs/{document} abbreviates a test's name");
    }
}
