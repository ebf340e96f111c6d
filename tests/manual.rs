//! Manual pages and completions, against the programs' own output and as `man` and bash read them.

use super::*;

use slag_tests::*;

/// The programs, and their least number of pages.
const PROGRAMS: [(&str, usize); 5] =
    [("slag-encoder", 21), ("slag-edge", 16), ("slag-mcap", 1), ("slag-mcp", 1), ("slag-ros", 1)];

fn manual() -> tempfile::TempDir {
    let out = tempfile::tempdir().expect("a folder");
    run(Command::new(program("slag-manual")).arg(out.path()));
    out
}

fn with_single_spaces(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Help of a program, in long lines.
fn help(path: &[&str]) -> String {
    let mut command = Command::new(program(path[0]));
    let flag = if ["slag-encoder", "slag-edge"].contains(&path[0]) { "--help-all" } else { "--help" };
    command.args(&path[1..]).arg(flag).env("COLUMNS", "10000").env("SLAG_EDGE_CONFIG", "");
    String::from_utf8(run(&mut command).stdout).expect("text")
}

/// Flags of a help text, each with the first paragraph of its help.
fn flags(help: &str) -> Vec<(String, String)> {
    let mut flags: Vec<(String, String)> = Vec::new();
    let mut is_open = false;
    for line in help.lines() {
        let trimmed = line.trim_start();
        let indent = line.len() - trimmed.len();
        if trimmed.starts_with('-') && (2..=6).contains(&indent) {
            let (head, rest) = trimmed.split_once("  ").unwrap_or((trimmed, ""));
            let flag = head.split([' ', ',']).rfind(|word| word.starts_with("--")).unwrap_or(head);
            flags.push((flag.trim_end_matches("...").to_owned(), rest.trim().to_owned()));
            is_open = true;
        } else if is_open && indent > 6 && !trimmed.is_empty() {
            let (_, help) = flags.last_mut().expect("a flag before its help");
            *help += " ";
            *help += trimmed;
        } else {
            is_open = false;
        }
    }
    for (_, help) in &mut flags {
        // Pages show defaults and the like elsewhere.
        let end =
            [" [default:", " [env:", " [possible", " [alias"].iter().filter_map(|mark| help.find(mark)).min();
        *help = with_single_spaces(&help[..end.unwrap_or(help.len())]);
    }
    flags
}

/// Subcommands in a help text.
fn commands(help: &str) -> Vec<&str> {
    let below = help.split("\nCommands:\n").nth(1).unwrap_or_default();
    let lines = below.lines().take_while(|line| !line.is_empty());
    let is_name = |line: &&str| line.starts_with("  ") && !line.starts_with("   ");
    lines
        .filter(is_name)
        .filter_map(|line| line.split_whitespace().next())
        .filter(|name| *name != "help")
        .collect()
}

/// A page as `man` shows it, without warnings.
fn page(path: &Path) -> String {
    let shown = Command::new("man")
        .args(["--warnings=w", "--nh", "--nj", "--encoding=UTF-8", "-l", text(path)])
        .env("MANWIDTH", "10000")
        .env("LC_ALL", "C.UTF-8")
        .env("GROFF_NO_SGR", "1")
        .output()
        .expect("man runs (Debian: man-db)");
    assert!(shown.status.success() && shown.stderr.is_empty(), "{}: {shown:?}", path.display());
    with_single_spaces(&String::from_utf8(shown.stdout).expect("text"))
}

/// Compares the pages of a command and its subcommands; returns their number and that of their flags.
fn compare(path: &[&str], manual: &Path) -> (usize, usize) {
    let help = help(path);
    let name = format!("{}.1", path.join("-"));
    let page = page(&manual.join(&name));
    let (mut n_pages, mut n_flags) = (1, 0);
    for (flag, help) in flags(&help) {
        assert!(page.contains(&flag), "{name} lacks {flag}: {page}");
        assert!(page.contains(&help), "{name}: {flag}: {help:?} is not in the page: {page}");
        n_flags += 1;
    }
    for below in commands(&help) {
        let path: Vec<&str> = path.iter().copied().chain([below]).collect();
        let (pages, flags) = compare(&path, manual);
        n_pages += pages;
        n_flags += flags;
    }
    (n_pages, n_flags)
}

/// Oracle: `--help` of the real programs, and `man`.
#[test]
fn every_flag_is_in_its_page_with_its_help() {
    let manual = manual();
    for (program, least) in PROGRAMS {
        let (n_pages, n_flags) = compare(&[program], manual.path());
        assert!(n_pages >= least && n_flags >= 4 * n_pages, "{program}: {n_pages} pages, {n_flags} flags");
    }
}

/// A person's keys in an interactive bash.
#[test]
fn bash_completes_commands_flags_and_values() {
    let manual = manual();
    for (program, keys, completed) in [
        ("slag-edge", "fetch --max-by", "fetch --max-bytes"),
        ("slag-edge", "models pul", "models pull"),
        ("slag-encoder", "encode --occupanc", "encode --occupancy"),
        ("slag-mcp", "--rob", "--robot"),
        ("slag-ros", "--rmw rmw_cyc", "--rmw rmw_cyclonedds_cpp"),
    ] {
        let script = manual.path().join(format!("{program}.bash"));
        let line = judge(
            Path::new("python3"),
            "packaging/manual/tests/complete.py",
            &[text(&script), &format!("{program} {keys}")],
        );
        assert!(line.starts_with(&format!("{program} {completed}")), "{program} {keys}: {line:?}");
    }
}

/// Every example of `--help` parses.
#[test]
fn examples_of_help_parse() {
    let mut n_examples = 0;
    for (name, command) in
        [("slag-encoder", slag_encoder::cli::Cli::command()), ("slag-edge", slag_edge::cli::Cli::command())]
    {
        let mut waiting = vec![command.clone()];
        while let Some(below) = waiting.pop() {
            waiting.extend(below.get_subcommands().cloned());
            let examples = below.get_before_help().map(ToString::to_string).unwrap_or_default();
            let lines: Vec<&str> = examples.lines().skip(1).collect();
            assert!(lines.is_empty() || lines.len() == 3, "{}: {examples}", below.get_name());
            for line in lines {
                let words = slag_tests::words(line);
                assert_eq!(words[0], name);
                let words = words.into_iter().map(|word| if word == "HEX" { "0".repeat(64) } else { word });
                if let Err(error) = command.clone().try_get_matches_from(words) {
                    panic!("{line}: {error}");
                }
                n_examples += 1;
            }
        }
    }
    assert_eq!(n_examples, 45);
}

/// Otherwise clap takes them for unknown flags and suggests `-- -5`, which is wrong for a flag's value.
#[test]
fn negative_numbers_are_values_of_flags() {
    for (name, line) in [
        ("slag-encoder", "encode --scene a --store b --cell-gaussians -5"),
        ("slag-edge", "query mug --limit -5"),
        ("slag-edge", "serve --scrub-secs -5"),
        ("slag-lab", "demo --seed -5"),
        ("slag-mcap", "--text mug --limit -5 a.mcap"),
        ("slag-ros", "--limit -5"),
    ] {
        let output = Command::new(program(name)).args(line.split(' ')).output().expect("starts");
        let told = String::from_utf8_lossy(&output.stderr);
        assert!(told.contains("invalid value '-5' for '--"), "{name} {line}: {told}");
    }
}
