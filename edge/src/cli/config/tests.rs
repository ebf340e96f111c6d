use clap::CommandFactory;

use super::*;
use crate::cli::Cli;
use slag_test_support::assert_error;

/// Parses a line with an environment and a file; returns a flag's values at the end of the chain of commands.
fn parsed(line: &str, environment: &[(&str, &str)], file: &str) -> Result<ArgMatches, ConfigError> {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("edge.toml");
    std::fs::write(&path, file).expect("written");
    let line: Vec<OsString> = line.split(' ').map(Into::into).collect();
    let variable = |name: &str| -> Option<OsString> {
        let given = environment.iter().find(|(known, _)| *known == name).map(|(_, value)| (*value).into());
        given.or_else(|| (name == "SLAG_EDGE_CONFIG").then(|| path.clone().into()))
    };
    parse(Cli::command(), &line, &variable)
}

fn values(matches: &ArgMatches, id: &str) -> Vec<String> {
    let mut leaf = matches;
    while let Some((_, below)) = leaf.subcommand() {
        leaf = below;
    }
    let raw = leaf.get_raw(id).into_iter().flatten();
    raw.map(|value| value.to_string_lossy().into_owned()).collect()
}

const SERVE: &str = "cache = 'all'\nprofile = 'exact'\n[serve]\nlisten = '127.0.0.1:1'\nradius = 7.5\nhost = ['a', 'b']\n\
    trust-first = true\nrefresh-secs = 9\n[fetch]\nat = '1,2,3'\n";

#[test]
fn the_line_comes_before_the_environment_and_that_before_the_file() {
    let environment =
        [("SLAG_EDGE_SERVE_RADIUS", "8"), ("SLAG_EDGE_CACHE", "env"), ("SLAG_EDGE_HOST", "c, d")];
    for (line, environment, id, expected) in [
        ("slag-edge serve", &environment[..0], "radius", &["7.5"][..]),
        ("slag-edge serve", &environment, "radius", &["8"]),
        ("slag-edge serve --radius 9", &environment, "radius", &["9"]),
        // The environment's value for all precedes the file's for this command.
        ("slag-edge serve", &environment[..0], "host", &["a", "b"]),
        ("slag-edge serve", &environment, "host", &["c", "d"]),
        ("slag-edge serve --host e", &environment, "host", &["e"]),
        ("slag-edge serve", &environment, "cache", &["env"]),
        ("slag-edge status", &environment[..0], "cache", &["all"]),
        ("slag-edge status --cache line", &environment, "cache", &["line"]),
        ("slag-edge fetch", &environment, "radius", &["50"]),
        ("slag-edge fetch", &environment, "profile", &["exact"]),
        ("slag-edge serve", &environment, "trust_first", &["true"]),
        ("slag-edge serve", &[("SLAG_EDGE_TRUST_FIRST", "false")], "trust_first", &["false"]),
        ("slag-edge serve", &environment, "refresh_secs", &["9"]),
        // The line's value drops a file's value that it excludes.
        ("slag-edge fetch", &environment, "at", &["1,2,3"]),
        ("slag-edge fetch --at-geo 4,5", &environment, "at", &[]),
        // One name with different values per command; the line switches off the file's flag.
        ("slag-edge fetch", &[("SLAG_EDGE_FROM", "http://a:1")], "from", &["http://a:1"]),
        ("slag-edge changes", &[("SLAG_EDGE_FROM", "http://a:1")], "from", &[]),
        ("slag-edge changes", &[("SLAG_EDGE_FROM", "7")], "from", &["7"]),
        ("slag-edge serve --trust-first=false", &[], "trust_first", &["false"]),
        ("slag-edge serve --trust-first", &[("SLAG_EDGE_TRUST_FIRST", "false")], "trust_first", &["true"]),
    ] {
        let matches = parsed(line, environment, SERVE).unwrap_or_else(|e| panic!("{line}: {e}"));
        assert_eq!(values(&matches, id), expected, "{line}: {id}");
    }
    let quiet = parsed("slag-edge -q status", &[], "verbose = 2").expect("parses");
    assert_eq!(values(&quiet, "verbose"), ["0"]);
}

/// As on the command line, where clap refuses these.
#[test]
fn flags_of_a_file_need_and_exclude_others() {
    let radius = [("SLAG_EDGE_QUERY_RADIUS", "0.5")];
    for (line, environment, file, expected) in [
        ("slag-edge query chair", &radius[..], "", "SLAG_EDGE_QUERY_RADIUS: needs --near <X,Y,Z> as well"),
        ("slag-edge query chair", &[("SLAG_EDGE_QUERY_JSON", "1")], "", "[possible values: true, false]"),
        ("slag-edge list", &[], "[list]\nradius = 3", "edge.toml: list.radius: needs --near"),
        (
            "slag-edge locate a.jpg",
            &[],
            "[locate]\nfocal-px = 500\nnear = '1,2,3'",
            "locate.near: needs --sigma",
        ),
        ("slag-edge serve", &[], "[serve]\ntls-cert = 'a'", "serve.tls-cert: needs --tls-key"),
        ("slag-edge fetch", &[], "[fetch]\nat = '1,2,3'\nat-geo = '4,5'", "at-geo: cannot stand beside "),
        ("slag-edge list", &[], "[list]\nformat = 'csv'\njson = true", "cannot stand beside "),
        ("slag-edge status", &[], "quiet = true\nverbose = 1", "cannot stand beside "),
    ] {
        assert_error(parsed(line, environment, file), &[expected]);
    }
    let here = [("SLAG_EDGE_FETCH_AT_GEO", "4,5")];
    for (line, environment, file, id, expected) in [
        ("slag-edge query chair --near 1,2,3", &radius[..], "", "radius", &["0.5"][..]),
        ("slag-edge list", &[], "[list]\nradius = 3\nnear = '1,2,3'", "radius", &["3"]),
        // For all commands: only fetches accept a radius without a position.
        ("slag-edge fetch", &[], "radius = 3", "radius", &["3"]),
        ("slag-edge list", &[], "radius = 3", "radius", &[]),
        ("slag-edge locate a.jpg --focal-px 500", &[], "sigma = 1", "sigma", &[]),
        ("slag-edge list --near 1,2,3 --radius 4", &[], "radius = 3", "radius", &["4"]),
        // A flag switched off on the line does not hide later ones.
        (
            "slag-edge fetch --trust-first=false --at-geo 4,5",
            &[],
            "[fetch]\ntrust-first = true\nat = '1,2,3'",
            "at",
            &[],
        ),
        ("slag-edge fetch", &here, "[fetch]\nat = '1,2,3'", "at", &[]),
        ("slag-edge fetch", &here, "[fetch]\nat = '1,2,3'", "at_geo", &["4,5"]),
        ("slag-edge list", &[], "[list]\nformat = 'csv'\njson = false", "format", &["csv"]),
        // Other commands' lines may complete their flags.
        ("slag-edge status", &[], "[list]\nradius = 3", "cache", &[]),
    ] {
        let matches = parsed(line, environment, file).unwrap_or_else(|e| panic!("{line}: {e}"));
        assert_eq!(values(&matches, id), expected, "{line}: {id}");
    }
}

#[test]
fn unknown_variables_are_told_with_the_nearest_name() {
    let warnings =
        |names: &[&str]| unknown_variables(&Cli::command(), names.iter().map(|name| (*name).to_owned()));
    let known =
        ["SLAG_EDGE_CACHE", "SLAG_EDGE_FETCH_RADIUS", "SLAG_EDGE_TRUST_SHOW_JSON", "SLAG_EDGE_CONFIG"];
    let others = ["PATH", "SLAG_EDGES", "slag_edge_cahce"];
    assert_eq!(warnings(&[&known[..], &others].concat()), Vec::<String>::new());
    let told = warnings(&["SLAG_EDGE_CAHCE", "SLAG_EDGE_SERVE_LISTN"]);
    let [cache, listen] = &told[..] else { panic!("{told:?}") };
    assert!(cache.starts_with("SLAG_EDGE_CAHCE ") && cache.ends_with("perhaps SLAG_EDGE_CACHE"), "{cache}");
    assert!(listen.ends_with("perhaps SLAG_EDGE_SERVE_LISTEN"), "{listen}");
}

#[test]
fn errors_name_the_file_and_the_key() {
    for (file, key, what) in [
        ("[serve]\nfollow = ''", "serve.follow", "give an address like http://host:port"),
        ("[serve]\nfollow = 'ftp://x'", "serve.follow", "it does not begin with http:// or https://"),
        ("[fetch]\nfrom = 'base:7733'", "fetch.from", "give an address like http://host:port"),
        ("[serve]\nlisten = 'nowhere'", "serve.listen", "IP:PORT or unix:PATH"),
        ("[serve]\nlisten = 7734", "serve.listen", "IP:PORT or unix:PATH"),
        ("[fetch]\nradius = 'far'", "fetch.radius", "0 or more"),
        ("[fetch]\nradius = [1, 2]", "fetch.radius", "expected one value"),
        ("[fetch]\nradius = 1979-05-27", "fetch.radius", "expected a text or a number"),
        ("[fetch]\nwatch = 'yes'", "fetch.watch", "expected true or false"),
        ("[fetch]\nprofile = 'tiny'", "fetch.profile", "invalid value 'tiny'"),
        ("[fetch]\nmax_bytes = 1", "fetch.max_bytes", "max-bytes"),
        ("cash = 'x'", "cash", "cache"),
        ("config = 'x'", "config", "no flag of this name"),
        ("[fetsch]\nradius = 1", "fetsch", "tables: fetch, serve"),
        ("[query]\ntext = 'chair'", "query.text", "no flag of this name"),
        // First trust is a deliberate step.
        ("[trust.add]\ntrust-first = true", "trust.add.trust-first", "no flag of this name"),
        // Tables of other commands are checked, too.
        ("[trust.show]\njson = 7", "trust.show.json", "expected true or false"),
    ] {
        assert_error(parsed("slag-edge status", &[], file), &[&format!("edge.toml: {key}: "), what]);
    }
    assert_error(parsed("slag-edge status", &[], "[fetch"), &["edge.toml: ", "line 1"]);
    let environment = [("SLAG_EDGE_SERVE_LISTEN", "nowhere")];
    let error = parsed("slag-edge serve", &environment, "").expect_err("no address").to_string();
    assert!(error.starts_with("SLAG_EDGE_SERVE_LISTEN: ") && error.contains("IP:PORT"), "{error}");
    assert_error(parsed("slag-edge --config nowhere.toml status", &[], ""), &["nowhere.toml`: No such file"]);
    assert!(parsed("slag-edge status", &[("SLAG_EDGE_CONFIG", "")], "[no").is_ok(), "no file is read");
    let dir = tempfile::tempdir().expect("a folder");
    let pipe = dir.path().join("pipe");
    assert!(std::process::Command::new("mkfifo").arg(&pipe).status().expect("runs").success());
    let line = format!("slag-edge --config {} status", pipe.display());
    assert!(parsed(&line, &[], "").expect_err("nobody writes").to_string().contains("is a pipe"));
    let line = ["slag-edge", "--config", "", "status"].map(OsString::from);
    let named = |name: &str| (name == "SLAG_EDGE_CONFIG").then(|| "nowhere.toml".into());
    assert!(parse(Cli::command(), &line, &named).is_ok(), "no file is read");
    let error = parsed("slag-edge status", &[("SLAG_EDGE_SCENE", "x y")], "nothing = 1").unwrap_err();
    assert!(error.to_string().len() < 120, "a hint, not all flags: {error}");
}

/// Returns the keys of all flags in a file, as `serve.listen`.
fn keys(command: &Command, path: &str) -> BTreeSet<String> {
    let own = flags(command).filter_map(|arg| arg.get_long()).map(|long| format!("{path}{long}"));
    let below =
        command.get_subcommands().flat_map(|below| keys(below, &format!("{path}{}.", below.get_name())));
    own.chain(below).collect()
}

fn written(table: &Table, path: &str) -> BTreeSet<String> {
    let keys = table.iter().flat_map(|(key, value)| match value {
        Value::Table(below) => written(below, &format!("{path}{key}.")),
        _ => BTreeSet::from([format!("{path}{key}")]),
    });
    keys.collect()
}

#[test]
fn the_sample_has_every_flag() {
    let sample = include_str!("../../../../jetson/edge.toml");
    let is_setting = |line: &str| line.split_once(" = ").is_some_and(|(key, _)| !key.contains(' '));
    let uncommented =
        sample.lines().map(|line| line.strip_prefix("# ").filter(|line| is_setting(line)).unwrap_or(line));
    let uncommented: String = uncommented.flat_map(|line| [line, "\n"]).collect();
    parsed("slag-edge status", &[], sample).expect("as it is installed");
    parsed("slag-edge status", &[], &uncommented).expect("every example is valid");
    let written = written(&uncommented.parse().expect("TOML"), "");
    let all = keys(&Cli::command(), "");
    for key in &all {
        let flag = key.rsplit('.').next().expect("a flag");
        assert!(written.contains(key) || written.contains(flag), "{key} is missing in jetson/edge.toml");
    }
    for key in written {
        let is_known = all.contains(&key) || all.iter().any(|known| known.ends_with(&format!(".{key}")));
        assert!(is_known, "{key} is no flag");
    }
}

/// By default all queries together may use four times the budget of one; the unit's limit has room for that, half as
/// much again for uncounted memory, and the program itself.
#[test]
fn the_unit_has_room_for_all_queries() {
    let unit = include_str!("../../../../jetson/slag-edge.service");
    let limit = unit.lines().find_map(|line| line.strip_prefix("MemoryMax=")?.strip_suffix('G')).unwrap();
    let limit_bytes = limit.parse::<u64>().expect("gigabytes") << 30;
    let query_bytes = &values(&parsed("slag-edge serve", &[], "").expect("parses"), "max_query_bytes")[0];
    let query_bytes = query_bytes.parse::<slag_common::ByteSize>().expect("bytes").0;
    assert!(limit_bytes >= 4 * query_bytes * 3 / 2 + (256 << 20), "{limit_bytes} for {query_bytes} a query");
}
