//! Flags from the environment and from a file, overridden by the command line.
//!
//! In the file, a table holds a command's flags by their long names; keys before the first table apply to every
//! command that has the flag. The environment has `SLAG_EDGE_FETCH_RADIUS` for `fetch --radius`, `SLAG_EDGE_CACHE`
//! for `--cache` of every command. Values become the flags' defaults, so clap parses them and `--help` shows them.
//! clap's defaults neither require nor exclude other flags, so that is checked here.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::io;
use std::path::PathBuf;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::parser::ValueSource;
use clap::{Arg, ArgAction, ArgMatches, Command};
use slag_common::files;
use toml::{Table, Value};

/// Read if it exists and no other file is named.
const DEFAULT_FILE: &str = "/etc/slag/edge.toml";
pub const HELP: &str = "Flags may also come from the environment (SLAG_EDGE_CACHE for --cache, SLAG_EDGE_FETCH_RADIUS for fetch --radius) \
    and from the configuration file (cache = \"DIR\", and radius = 20 under [fetch]); the command line comes first, then \
    the environment, then the file.";
/// Prefix of all variables.
const PREFIX: &str = "SLAG_EDGE";
/// The flag that names the file; `SLAG_EDGE_CONFIG` in the environment.
const FILE_FLAG: &str = "config";
const MAX_FILE_BYTES: u64 = 1 << 20;

#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    #[error("the configuration: {cause}")]
    Unreadable { cause: io::Error },
    #[error("{place}: {what}")]
    Wrong { place: String, what: String },
    #[error(transparent)]
    Line(#[from] clap::Error),
}

/// Parses a command line; `variable` looks up the environment.
///
/// # Errors
/// [`ConfigError`]. The whole file is checked, whichever command is asked for.
pub fn parse(
    command: Command,
    line: &[OsString],
    variable: &dyn Fn(&str) -> Option<OsString>,
) -> Result<ArgMatches, ConfigError> {
    // Without checks for missing flags: the file may have them.
    let first = switchable(command.clone()).ignore_errors(true).try_get_matches_from(line);
    let Ok(first) = first else { return Ok(command.try_get_matches_from(line)?) };
    let named = first.try_get_one::<OsString>(FILE_FLAG).ok().flatten().map(PathBuf::from);
    let file = read(named, variable)?;
    let (asked, explicit) = asked(&first);
    let settings = Settings { variable, file, explicit, asked, root: command.clone() };
    let command = settings.apply(command, &[])?;
    if let Some(file) = &settings.file {
        file.refuse_unknown(&command, &file.table, &mut Vec::new())?;
    }
    Ok(command.try_get_matches_from(line)?)
}

struct File {
    path: PathBuf,
    table: Table,
}

fn read(
    named: Option<PathBuf>,
    variable: &dyn Fn(&str) -> Option<OsString>,
) -> Result<Option<File>, ConfigError> {
    let from_environment = || variable(&format!("{PREFIX}_CONFIG")).map(PathBuf::from);
    let named = named.or_else(from_environment);
    // An empty name stands for no file.
    if named.as_ref().is_some_and(|path| path.as_os_str().is_empty()) {
        return Ok(None);
    }
    let is_default = named.is_none();
    let path = named.unwrap_or_else(|| DEFAULT_FILE.into());
    let bytes = match files::read_short(&path, MAX_FILE_BYTES) {
        Err(cause) if is_default && cause.kind() == io::ErrorKind::NotFound => return Ok(None),
        read => read.map_err(|cause| ConfigError::Unreadable { cause })?,
    };
    let wrong = |what: String| ConfigError::Wrong { place: path.display().to_string(), what };
    let text =
        String::from_utf8(bytes).map_err(|_| wrong("not text in UTF-8; save it as such".to_owned()))?;
    let table = text.parse::<Table>().map_err(|e| wrong(e.to_string().trim_end().to_owned()))?;
    Ok(Some(File { path, table }))
}

/// Lets `--trust-first=false` switch off a flag that a file switches on.
fn switch(arg: Arg) -> Arg {
    let arg = arg.action(ArgAction::Set).num_args(0..=1).require_equals(true);
    arg.value_parser(clap::value_parser!(bool)).default_missing_value("true")
}

/// Lets all flags take a value, so that parsing continues after one.
fn switchable(command: Command) -> Command {
    let below: Vec<String> = command.get_subcommands().map(|below| below.get_name().to_owned()).collect();
    let command = below.iter().fold(command, |command, name| command.mut_subcommand(name, switchable));
    let is_switch = |arg: &Arg| matches!(arg.get_action(), ArgAction::SetTrue);
    command.mut_args(|arg| if is_switch(&arg) { switch(arg) } else { arg })
}

/// Returns the names of the requested command and its parents, and the flags that the line gives.
fn asked(matches: &ArgMatches) -> (Vec<String>, BTreeSet<String>) {
    let (mut names, mut explicit, mut at) = (Vec::new(), BTreeSet::new(), matches);
    loop {
        let is_given = |id: &&clap::Id| at.value_source(id.as_str()) == Some(ValueSource::CommandLine);
        explicit.extend(at.ids().filter(is_given).map(ToString::to_string));
        let Some((name, below)) = at.subcommand() else { return (names, explicit) };
        names.push(name.to_owned());
        at = below;
    }
}

/// Returns a warning for each variable with our prefix and an unknown name.
pub fn unknown_variables(root: &Command, names: impl Iterator<Item = String>) -> Vec<String> {
    let of_command = |(path, command): (Vec<&str>, &Command)| -> Vec<String> {
        let longs = flags(command).filter_map(Arg::get_long);
        longs.flat_map(|long| [variable_of([long]), variable_of([&path[..], &[long]].concat())]).collect()
    };
    let of_commands = with_those_below(root).into_iter().flat_map(of_command);
    let known: BTreeSet<String> = of_commands.chain([variable_of([FILE_FLAG])]).collect();
    let warning = |name: String| {
        let likeness = |known: &&String| strsim::jaro(known, &name);
        let nearest = known.iter().max_by(|a, b| likeness(a).total_cmp(&likeness(b)));
        let hint = nearest.map(|nearest| format!("; perhaps {nearest}")).unwrap_or_default();
        format!("{name} is set, but it is no variable of a flag{hint}")
    };
    let is_ours = |name: &str| name.strip_prefix(PREFIX).is_some_and(|rest| rest.starts_with('_'));
    names.filter(|name| is_ours(name) && !known.contains(name)).map(warning).collect()
}

/// Returns a flag's variable, by the names of its command's path and its own.
fn variable_of<'a>(words: impl IntoIterator<Item = &'a str>) -> String {
    let words: Vec<&str> = [PREFIX].into_iter().chain(words).collect();
    words.join("_").replace('-', "_").to_uppercase()
}

/// Returns the flags that a file may set: all but those required on the command line.
fn flags(command: &Command) -> impl Iterator<Item = &Arg> {
    let is_choice = |group: &&clap::ArgGroup| group.is_required_set();
    let by_hand = move |arg: &&Arg| {
        !command.get_groups().filter(is_choice).any(|group| group.get_args().any(|id| id == arg.get_id()))
    };
    let is_help = |arg: &&Arg| matches!(arg.get_action(), ArgAction::HelpShort | ArgAction::HelpLong);
    let is_named = |arg: &&Arg| arg.get_long().is_some_and(|long| long != FILE_FLAG);
    command.get_arguments().filter(is_named).filter(move |arg| !is_help(arg) && by_hand(arg))
}

/// Returns a command and all below it, each with the names on the way there.
fn with_those_below(command: &Command) -> Vec<(Vec<&str>, &Command)> {
    let mut all = vec![(Vec::new(), command)];
    let mut at = 0;
    while let Some((path, command)) = all.get(at).cloned() {
        let below = command.get_subcommands();
        all.extend(below.map(|below| ([&path[..], &[below.get_name()]].concat(), below)));
        at += 1;
    }
    all
}

/// A flag's value from the environment or the file.
struct Given {
    id: clap::Id,
    values: Vec<String>,
    place: String,
    rank: Rank,
}

/// Precedence: the environment before the file, and in each a command's own value before that for all commands.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Rank {
    is_environment: bool,
    is_own: bool,
}

impl Given {
    /// Returns whether this sets the flag: one switched off counts as absent.
    fn is_on(&self, arg: &Arg) -> bool {
        match arg.get_action() {
            ArgAction::SetTrue => self.values.iter().any(|value| value == "true"),
            ArgAction::Count => self.values.iter().any(|value| value != "0"),
            _ => !self.values.is_empty(),
        }
    }
}

struct Settings<'a> {
    variable: &'a dyn Fn(&str) -> Option<OsString>,
    file: Option<File>,
    explicit: BTreeSet<String>,
    /// The requested command.
    asked: Vec<String>,
    root: Command,
}

impl Settings<'_> {
    /// Makes values of the environment and the file the defaults of a command and its subcommands.
    fn apply(&self, command: Command, path: &[&str]) -> Result<Command, ConfigError> {
        let mut given: Vec<Given> = Vec::new();
        for arg in flags(&command) {
            if let Some(of) = self.value(arg, path)?
                && !self.is_overruled(&command, arg)
            {
                given.push(of);
            }
        }
        if self.asked.iter().map(String::as_str).zip(path).filter(|(a, b)| a == *b).count() == path.len() {
            given = self.with_what_it_needs(&command, compatible(&command, given)?)?;
        }
        let mut command = command;
        for Given { id, values, .. } in given {
            // clap keeps names and defaults for as long as the program runs.
            let values: Vec<&'static str> = values.into_iter().map(|value| &*value.leak()).collect();
            command = command.mut_arg(id, |arg| match arg.get_action() {
                ArgAction::SetTrue => switch(arg).default_values(values),
                _ => arg.default_values(values).required(false),
            });
        }
        let below: Vec<String> = command.get_subcommands().map(|below| below.get_name().to_owned()).collect();
        for name in below {
            let mut failed = Ok(());
            let path: Vec<&str> = path.iter().copied().chain([name.as_str()]).collect();
            command = command.mut_subcommand(&name, |below| match self.apply(below.clone(), &path) {
                Ok(applied) => applied,
                Err(error) => {
                    failed = Err(error);
                    below
                }
            });
            failed?;
        }
        Ok(command)
    }

    /// Returns whether the command line has a flag that excludes this one.
    fn is_overruled(&self, command: &Command, arg: &Arg) -> bool {
        let is_given = |other: &Arg| self.explicit.contains(other.get_id().as_str());
        command.get_arguments().any(|other| is_given(other) && exclude(command, arg, other))
    }

    /// Refuses a flag without another one that it requires. A value for all commands does not count there: `radius` is
    /// a fetch's before it is a question's.
    fn with_what_it_needs(
        &self,
        command: &Command,
        mut given: Vec<Given>,
    ) -> Result<Vec<Given>, ConfigError> {
        loop {
            let lacking = given.iter().enumerate().find_map(|(at, of)| {
                let lacks = self.lacks(command, of, &given);
                (!lacks.is_empty()).then_some((at, lacks))
            });
            let Some((at, lacks)) = lacking else { return Ok(given) };
            let of = given.remove(at);
            if of.rank.is_own {
                let what = format!("needs {} as well; give it, or take this away", lacks.join(" and "));
                return Err(wrong(&of.place, &what));
            }
        }
    }

    /// Returns the missing flags that one requires.
    fn lacks(&self, command: &Command, of: &Given, given: &[Given]) -> Vec<String> {
        let Some(arg) = argument(command, &of.id).filter(|arg| of.is_on(arg)) else { return Vec::new() };
        let is_given = |arg: &Arg| {
            self.explicit.contains(arg.get_id().as_str())
                || given.iter().any(|of| of.id == *arg.get_id() && of.is_on(arg))
        };
        let is_there = |usage: &String| {
            let flag = usage.split(' ').next().and_then(|flag| flag.strip_prefix("--"));
            command.get_arguments().any(|arg| arg.get_long() == flag && flag.is_some() && is_given(arg))
        };
        needs(command, arg, &of.values).into_iter().filter(|usage| !is_there(usage)).collect()
    }

    /// Returns a flag's value: the environment's, else the file's; its own command's, else that for all.
    fn value(&self, arg: &Arg, path: &[&str]) -> Result<Option<Given>, ConfigError> {
        let Some(long) = arg.get_long() else { return Ok(None) };
        let own = variable_of(path.iter().copied().chain([long]));
        for (name, is_own) in [(own, !path.is_empty()), (variable_of([long]), false)] {
            if let Some(text) = (self.variable)(&name) {
                let text = text.into_string().map_err(|_| wrong(&name, "not text in UTF-8"))?;
                let rank = Rank { is_environment: true, is_own };
                return self.fitting(arg, rank, name, &|arg| Ok(from_text(arg, &text)));
            }
        }
        let Some(file) = &self.file else { return Ok(None) };
        for path in [path, &[]] {
            if let Some(value) = table_at(&file.table, path)
                .and_then(|table| table.get(long))
                .filter(|value| !value.is_table())
            {
                let rank = Rank { is_environment: false, is_own: !path.is_empty() };
                return self.fitting(arg, rank, file.place(path, long), &|arg| from_value(arg, value));
            }
        }
        Ok(None)
    }

    /// Checks a value. One for all commands need not fit each: `from` is an address to one and a number to another.
    fn fitting(
        &self,
        arg: &Arg,
        rank: Rank,
        place: String,
        texts: &dyn Fn(&Arg) -> Result<Vec<String>, String>,
    ) -> Result<Option<Given>, ConfigError> {
        let check = |arg: &Arg| checked(arg, texts(arg).map_err(|what| wrong(&place, &what))?, &place);
        let fits_another = || {
            let all = with_those_below(&self.root).into_iter().flat_map(|(_, command)| flags(command));
            all.filter(|other| other.get_long() == arg.get_long()).any(|other| check(other).is_ok())
        };
        match check(arg) {
            Err(_) if !rank.is_own && fits_another() => Ok(None),
            checked => {
                let values = checked?;
                Ok(Some(Given { id: arg.get_id().clone(), values, place, rank }))
            }
        }
    }
}

impl File {
    fn place(&self, path: &[&str], key: &str) -> String {
        let key: Vec<&str> = path.iter().copied().chain([key]).collect();
        format!("{}: {}", self.path.display(), key.join("."))
    }

    /// Refuses keys that are no command's flag.
    fn refuse_unknown<'a>(
        &'a self,
        command: &Command,
        table: &'a Table,
        path: &mut Vec<&'a str>,
    ) -> Result<(), ConfigError> {
        let mut of = with_those_below(command);
        if !path.is_empty() {
            of.truncate(1);
        }
        let longs = of.into_iter().flat_map(|(_, command)| flags(command)).filter_map(Arg::get_long);
        let known: BTreeSet<String> = longs.map(str::to_owned).collect();
        for (key, value) in table {
            if let (Some(below), Value::Table(table)) = (command.find_subcommand(key), value) {
                path.push(key);
                self.refuse_unknown(below, table, path)?;
                path.pop();
            } else if !known.contains(key) {
                let tables: Vec<&str> = command.get_subcommands().map(Command::get_name).collect();
                let near = |known: &String| strsim::jaro(known, key) > 0.75;
                let near: Vec<String> = known.into_iter().filter(near).take(3).collect();
                let hint = match (value.is_table(), near.is_empty()) {
                    (true, _) if !tables.is_empty() => format!("; tables: {}", tables.join(", ")),
                    (_, false) => format!("; perhaps {}", near.join(" or ")),
                    _ => format!("; see `slag-edge {} --help`", path.join(" ")).replace("  ", " "),
                };
                return Err(wrong(&self.place(path, key), &format!("no flag of this name{hint}")));
            }
        }
        Ok(())
    }
}

/// Drops a value excluded by one of higher precedence; refuses conflicts within a rank.
fn compatible(command: &Command, mut given: Vec<Given>) -> Result<Vec<Given>, ConfigError> {
    given.sort_by_key(|of| std::cmp::Reverse(of.rank));
    let mut kept: Vec<Given> = Vec::new();
    for of in given {
        let exclude_each_other = |before: &&Given| {
            let args = argument(command, &before.id).zip(argument(command, &of.id));
            args.is_some_and(|(a, b)| before.is_on(a) && of.is_on(b) && exclude(command, a, b))
        };
        match kept.iter().find(exclude_each_other) {
            None => kept.push(of),
            Some(before) if before.rank > of.rank => {}
            Some(before) => {
                let what = format!("cannot stand beside {}; take one of the two away", before.place);
                return Err(wrong(&of.place, &what));
            }
        }
    }
    Ok(kept)
}

fn argument<'a>(command: &'a Command, id: &clap::Id) -> Option<&'a Arg> {
    command.get_arguments().find(|arg| arg.get_id() == id)
}

fn exclude(command: &Command, one: &Arg, other: &Arg) -> bool {
    let against = |one: &Arg, other: &Arg| {
        command.get_arg_conflicts_with(one).iter().any(|against| against.get_id() == other.get_id())
    };
    against(one, other) || against(other, one)
}

/// Returns the flags that one requires, as `--near <X,Y,Z>`: those that clap demands for it alone, not for no flag.
fn needs(command: &Command, arg: &Arg, values: &[String]) -> Vec<String> {
    let is_help = |arg: &&Arg| matches!(arg.get_action(), ArgAction::HelpShort | ArgAction::HelpLong);
    let args = || command.get_arguments().filter(|arg| !is_help(arg)).cloned().map(|arg| arg.required(false));
    let groups = || command.get_groups().cloned().map(|group| group.required(false));
    let missing = |line: Vec<String>| {
        let alone = Command::new("alone").no_binary_name(true).disable_help_flag(true);
        let parsed =
            alone.disable_version_flag(true).args(args()).groups(groups()).try_get_matches_from(line);
        match parsed {
            Err(error) if error.kind() == ErrorKind::MissingRequiredArgument => {
                match error.get(ContextKind::InvalidArg) {
                    Some(ContextValue::Strings(usages)) => usages.clone(),
                    _ => Vec::new(),
                }
            }
            _ => Vec::new(),
        }
    };
    let flag = format!("--{}", arg.get_long().unwrap_or_default());
    let line = match arg.get_action() {
        ArgAction::SetTrue | ArgAction::Count => vec![flag],
        _ => values.iter().map(|value| format!("{flag}={value}")).collect(),
    };
    let of_nothing = missing(Vec::new());
    missing(line).into_iter().filter(|usage| !of_nothing.contains(usage)).collect()
}

fn table_at<'a>(table: &'a Table, path: &[&str]) -> Option<&'a Table> {
    path.iter().try_fold(table, |table, name| table.get(*name)?.as_table())
}

fn wrong(place: &str, what: &str) -> ConfigError {
    ConfigError::Wrong { place: place.to_owned(), what: what.to_owned() }
}

fn is_list(arg: &Arg) -> bool {
    matches!(arg.get_action(), ArgAction::Append)
}

fn from_text(arg: &Arg, text: &str) -> Vec<String> {
    match is_list(arg) {
        true => text.split(',').map(|part| part.trim().to_owned()).filter(|part| !part.is_empty()).collect(),
        false => vec![text.to_owned()],
    }
}

fn from_value(arg: &Arg, value: &Value) -> Result<Vec<String>, String> {
    let one = |value: &Value| match (value, arg.get_action()) {
        (Value::Boolean(value), ArgAction::SetTrue) => Ok(value.to_string()),
        (_, ArgAction::SetTrue) => Err(format!("found {}, expected true or false", value.type_str())),
        (Value::String(text), _) => Ok(text.clone()),
        (Value::Integer(number), _) => Ok(number.to_string()),
        (Value::Float(number), _) => Ok(number.to_string()),
        _ => Err(format!("found {}, expected a text or a number", value.type_str())),
    };
    match value {
        Value::Array(values) if is_list(arg) => values.iter().map(one).collect(),
        Value::Array(_) => Err("found a list, expected one value".to_owned()),
        value => Ok(vec![one(value)?]),
    }
}

/// Checks values with clap's own parser: clap takes an invalid default for a bug of the program.
fn checked(arg: &Arg, values: Vec<String>, place: &str) -> Result<Vec<String>, ConfigError> {
    let long = arg.get_long().unwrap_or_default().to_owned();
    let refused = |e: clap::Error| {
        let text = e.to_string();
        // What was found, and the values that are taken.
        let lines: Vec<&str> = text.lines().take_while(|line| !line.is_empty()).map(str::trim).collect();
        let what = lines.join(" ");
        wrong(place, what.strip_prefix("error: ").unwrap_or(&what))
    };
    let parser = match arg.get_action() {
        ArgAction::SetTrue => clap::value_parser!(bool),
        ArgAction::Count => clap::value_parser!(u8).into(),
        _ => arg.get_value_parser().clone(),
    };
    let mut alone =
        Arg::new("value").long(&*long.clone().leak()).action(ArgAction::Append).value_parser(parser);
    if let Some(delimiter) = arg.get_value_delimiter() {
        alone = alone.value_delimiter(delimiter);
    }
    let line = values.iter().map(|value| format!("--{long}={value}"));
    Command::new("values").no_binary_name(true).arg(alone).try_get_matches_from(line).map_err(refused)?;
    Ok(values)
}

#[cfg(test)]
mod tests;
