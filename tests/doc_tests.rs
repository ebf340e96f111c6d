//! The documents are short, and the files, headings, flags and tests that they name exist.

use super::*;

use slag_tests::{files_below, words};

const MAX_WORDS: usize = 22_000;
/// Most characters of a line and of a table row, and most columns.
const MAX_LINE: usize = 120;
const MAX_ROW: usize = 200;
const MAX_COLUMNS: usize = 8;
/// Flags of other programs and of scripts that documents name besides ours.
const OTHER_FLAGS: [&str; 6] =
    ["--alignment_type", "--container", "--help", "--help-all", "--no-normalize-world-space", "--ref_is_gps"];

/// The documents with their texts, relative to the project's root.
fn documents() -> Vec<(PathBuf, String)> {
    let mut paths: Vec<PathBuf> = ["README.md", "ARCHITECTURE.md", "CHANGELOG.md", "jetson/README.md"]
        .into_iter()
        .chain(["clients/python/README.md", "common/models/embedded/CARD.md"])
        .map(PathBuf::from)
        .collect();
    let pages = files_below(&root().join("docs")).into_iter();
    let pages = pages.filter(|page| page.extension().is_some_and(|of| of == "md"));
    paths.extend(pages.map(|page| page.strip_prefix(root()).expect("in the project").to_owned()));
    assert!(paths.len() > 15, "only {paths:?}");
    paths
        .into_iter()
        .map(|path| (path.clone(), fs_err::read_to_string(root().join(path)).expect("a document")))
        .collect()
}

fn check(faults: impl Fn(&Path, &str) -> Vec<String>) {
    let found: Vec<String> = documents()
        .iter()
        .flat_map(|(path, text)| {
            let of_page = faults(path, text).into_iter();
            of_page.map(|fault| format!("{}: {fault}", path.display())).collect::<Vec<_>>()
        })
        .collect();
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn the_documents_are_short() {
    let n_words: usize = documents().iter().map(|(_, text)| text.split_whitespace().count()).sum();
    assert!(n_words <= MAX_WORDS, "the documents have {n_words} words, at most {MAX_WORDS} are wanted");
}

#[test]
fn lines_and_tables_fit_a_screen() {
    check(|_, text| {
        let mut is_layers = false;
        let mut faults = Vec::new();
        let (mut was_row, mut next) = (false, text.lines().skip(1));
        for (line, number) in text.lines().zip(1..) {
            if line.starts_with("```") {
                is_layers = line == "```layers";
            }
            let n_chars = line.chars().count();
            let is_row = line.trim_start().starts_with('|');
            let n_columns = line.replace("\\|", "").matches('|').count().saturating_sub(1);
            // Pictures and the table that a test reads cannot be wrapped.
            if n_chars > if is_row { MAX_ROW } else { MAX_LINE } && !line.starts_with("![") && !is_layers {
                faults.push(format!("line {number} has {n_chars} characters"));
            }
            if is_row && n_columns > MAX_COLUMNS {
                faults.push(format!("line {number} has {n_columns} columns"));
            }
            // A rule follows the first row.
            let has_rule = next.next().is_some_and(|next| next.trim_start().starts_with("|-"));
            if is_row && !was_row && !has_rule {
                faults.push(format!("line {number} is a row without a table"));
            }
            was_row = is_row;
        }
        faults
    });
}

/// GitHub's anchor of a heading.
fn anchor(heading: &str) -> String {
    let heading = heading.trim_start_matches('#').trim().to_lowercase();
    let kept = heading.chars().filter(|c| c.is_alphanumeric() || [' ', '-', '_'].contains(c));
    kept.map(|c| if c == ' ' { '-' } else { c }).collect()
}

#[test]
fn links_lead_somewhere() {
    check(|path, text| {
        let links = text.split("](").skip(1).filter_map(|rest| rest.split(')').next());
        let ours = links.filter(|link| !link.starts_with("http"));
        ours.filter(|link| {
            let (file, heading) = link.split_once('#').unwrap_or((link, ""));
            let target = match file {
                "" => root().join(path),
                file => root().join(path).with_file_name("").join(file),
            };
            let has_heading = || {
                let page = fs_err::read_to_string(&target).unwrap_or_default();
                page.lines().any(|line| line.starts_with('#') && anchor(line) == heading)
            };
            !target.exists() || (!heading.is_empty() && !has_heading())
        })
        .map(|link| format!("the link {link} leads nowhere"))
        .collect()
    });
}

/// Collects clap's flags from fields of structs and variants.
#[derive(Default)]
struct Flags(BTreeSet<String>);

impl<'ast> Visit<'ast> for Flags {
    fn visit_field(&mut self, field: &'ast syn::Field) {
        for attribute in field.attrs.iter().filter(|attribute| attribute.path().is_ident("arg")) {
            let Ok(list) = attribute.meta.require_list() else { continue };
            let tokens = list.tokens.to_string();
            let named = tokens.split("long = \"").nth(1).and_then(|rest| rest.split('"').next());
            let is_long = tokens.split([',', ' ']).any(|word| word == "long");
            let of_field =
                field.ident.as_ref().filter(|_| is_long).map(|name| name.to_string().replace('_', "-"));
            self.0.extend(named.map(str::to_owned).or(of_field).map(|name| format!("--{name}")));
        }
        visit::visit_field(self, field);
    }
}

/// Commands of our programs in the code blocks of a document, as words.
fn commands(text: &str) -> Vec<Vec<String>> {
    let mut lines = vec![String::new()];
    let mut is_fenced = false;
    for line in text.lines() {
        is_fenced ^= line.trim_start().starts_with("```");
        if is_fenced || line.starts_with("    ") {
            let line = line.split(" #").next().unwrap_or_default().trim();
            *lines.last_mut().expect("never empty") += line.strip_suffix('\\').unwrap_or(line);
            if !line.ends_with('\\') {
                lines.push(String::new());
            }
        }
    }
    let parts = lines.iter().flat_map(|line| line.split([';', '|', '&', '>']));
    let before = ["sudo", "-u", "slag"];
    let commands =
        parts.map(|part| words(part).into_iter().skip_while(|word| before.contains(&&**word)).collect());
    commands
        .filter(|words: &Vec<String>| words.first().is_some_and(|program| program.starts_with("slag-")))
        .collect()
}

/// Code in sentences that begins like commands and flags of our programs.
fn code_in_sentences(text: &str) -> Vec<&str> {
    const OURS: [&str; 12] = [
        "encode", "check", "query", "serve", "fetch", "worker", "goal", "store", "keys", "trust", "push",
        "bench",
    ];
    let mut is_fenced = false;
    let sentences = text.lines().filter(|line| {
        is_fenced ^= line.trim_start().starts_with("```");
        !is_fenced && !line.starts_with("    ")
    });
    let code = sentences.flat_map(|line| line.split('`').skip(1).step_by(2));
    code.filter(|code| {
        let mut words = code.split(' ').filter(|word| !word.contains('='));
        words
            .next()
            .is_some_and(|word| word.starts_with("--") || word.starts_with("slag-") || OURS.contains(&word))
    })
    .collect()
}

fn flags<'a>(words: impl Iterator<Item = &'a str>) -> Vec<&'a str> {
    words
        .map(|word| word.split('=').next().unwrap_or_default())
        .filter(|word| word.starts_with("--") && word.len() > 2)
        .collect()
}

#[test]
fn flags_that_the_documents_name_exist() {
    let mut known = Flags::default();
    for file in sources("rs") {
        let text = fs_err::read_to_string(&file).expect("a source file");
        if text.contains("#[arg(") {
            let parsed = syn::parse_file(&text);
            known.visit_file(&parsed.unwrap_or_else(|error| panic!("{}: {error}", file.display())));
        }
    }
    assert!(known.0.len() > 100 && known.0.contains("--radius"), "{:?}", known.0);
    check(|_, text| {
        let commands = commands(text);
        let of_commands = flags(commands.iter().flatten().map(String::as_str));
        let code = code_in_sentences(text);
        let of_sentences = flags(code.into_iter().flat_map(|code| code.split([' ', '\\', '|', '"'])));
        let named = of_sentences.into_iter().chain(of_commands);
        let missing = named.filter(|flag| !known.0.contains(*flag) && !OTHER_FLAGS.contains(flag));
        missing.map(|flag| format!("no program has {flag}")).collect()
    });
}

/// Documented command lines parse, with values for their placeholders.
#[test]
fn documented_commands_are_understood() {
    let programs =
        [slag_encoder::cli::Cli::command, slag_edge::cli::Cli::command, slag_lab::cli::Cli::command]
            .map(|command| (command().get_name().to_owned(), command));
    let n: usize = documents().iter().map(|(_, text)| commands(text).len()).sum();
    assert!(n > 50, "{n} commands are documented");
    check(|_, text| {
        let mut faults = Vec::new();
        for words in commands(text) {
            let Some((_, program)) = programs.iter().find(|(name, _)| *name == words[0]) else { continue };
            let given = words.iter().map(|word| match &**word {
                "HEX" | "HEX_A" | "HEX_B" => "0".repeat(64),
                word => word.replace("LAT,LON", "46.8,-92").replace("VERSION", "0.1.0"),
            });
            if let Err(error) = program().try_get_matches_from(given) {
                let message = error.to_string();
                faults.push(format!("`{}`: {}", words.join(" "), message.lines().next().unwrap_or_default()));
            }
        }
        for code in code_in_sentences(text) {
            let words: Vec<&str> = code.split([' ', '|']).collect();
            let Some((_, program)) = programs.iter().find(|(name, _)| *name == words[0]) else { continue };
            if !has_command(&program(), &words[1..]) {
                faults.push(format!("`{code}` is no command"));
            }
        }
        faults
    });
}

/// Whether the words before the first flag are commands, if the program has any.
fn has_command(program: &clap::Command, words: &[&str]) -> bool {
    match words {
        [word, rest @ ..] if program.has_subcommands() && !word.starts_with('-') => {
            program.find_subcommand(word).is_some_and(|command| has_command(command, rest))
        }
        _ => true,
    }
}

/// Functions of all Rust files: `function` and `file::function`.
fn functions() -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    for path in sources("rs") {
        let text = fs_err::read_to_string(&path).expect("a source file");
        let module = path.file_stem().and_then(|stem| stem.to_str()).expect("a name");
        for line in text.lines() {
            let line = line.trim_start().trim_start_matches("pub ").trim_start_matches("async ");
            let Some(rest) = line.strip_prefix("fn ") else { continue };
            let name: String = rest.chars().take_while(|c| c.is_ascii_alphanumeric() || *c == '_').collect();
            found.insert(format!("{module}::{name}"));
            found.insert(name);
        }
    }
    found
}

/// Names of tests in a text: words in backquotes with a `::`, or of at least four parts (`a_b_c_d`); names of
/// columns and fields are shorter.
fn tests_named(text: &str) -> Vec<&str> {
    let is_name = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_' || c == ':';
    let words = text.split('`').skip(1).step_by(2);
    words
        .filter(|word| word.chars().all(is_name) && (word.contains("::") || word.split('_').count() > 3))
        .collect()
}

#[test]
fn every_test_that_the_documents_name_exists() {
    let known = functions();
    let n_named: usize = documents().iter().map(|(_, text)| tests_named(text).len()).sum();
    assert!(n_named > 50, "{n_named} tests are named");
    check(|_, text| {
        let missing = tests_named(text).into_iter().filter(|name| !known.contains(*name));
        missing.map(|name| format!("no test is called {name}")).collect()
    });
}
