//! `--help` shows what most people need, on one screen; `--help-all` shows every flag in full.

use clap::builder::StyledStr;
use clap::{Arg, ArgAction, Command};

/// Examples precede the flags.
const TEMPLATE: &str = "{about-with-newline}\n{before-help}{usage-heading} {usage}\n\n{all-args}{after-help}";

/// Shortens the help of a command and its subcommands: the first sentence of each flag, without flags hidden from the
/// short help.
pub fn layered(command: Command) -> Command {
    let below: Vec<String> = command.get_subcommands().map(|below| below.get_name().to_owned()).collect();
    let command = below.iter().fold(command, |command, name| command.mut_subcommand(name, layered));
    let short =
        Arg::new("help").short('h').long("help").action(ArgAction::HelpShort).help("Prints this help");
    let long = Arg::new("help-all").long("help-all").action(ArgAction::HelpLong);
    // `--limit -5` is then a wrong value, not an unknown flag.
    command
        .allow_negative_numbers(true)
        .mut_args(first_sentence_first)
        .disable_help_flag(true)
        .help_template(TEMPLATE)
        .arg(short)
        .arg(long.help("Prints every flag, and all about it"))
}

fn first_sentence_first(arg: Arg) -> Arg {
    let Some(all) = arg.get_help().map(StyledStr::to_string) else { return arg };
    let long = arg.get_long_help().map_or_else(|| all.clone(), StyledStr::to_string);
    let end = all.find(". ").into_iter().chain(all.find("; ")).min();
    // Texts end with the default if the program chooses it.
    let default = all.rfind(" [default:").map_or("", |at| &all[at..]);
    match end {
        Some(end) if end + default.len() < all.len() => arg.help(format!("{}{default}", &all[..end])),
        _ => arg,
    }
    .long_help(long)
}

#[cfg(test)]
mod tests {
    use clap::Command;

    use super::*;

    #[test]
    fn short_help_has_first_sentences_and_all_has_everything() {
        let rare = Arg::new("rare").long("rare").help("Rarely turned.").hide_short_help(true);
        let long = Arg::new("often").long("often").help("Turned often. With care [default: the preset's].");
        let command = Command::new("slag").about("Does it.").before_help("Examples").arg(rare).arg(long);
        let help = |flag: &str| {
            let line = ["slag", "below", flag];
            let command = layered(Command::new("slag").subcommand(command.clone().name("below")));
            command.try_get_matches_from(line).expect_err("help").to_string()
        };
        let (short, all) = (help("--help"), help("--help-all"));
        assert_eq!(short, help("-h"));
        assert!(short.contains("Turned often [default: the preset's]."), "{short}");
        assert!(!short.contains("rare") && !short.contains("With care"), "{short}");
        assert!(all.contains("Rarely turned.") && all.contains("With care"), "{all}");
        assert!(short.find("Examples") < short.find("Usage"), "{short}");
    }
}
