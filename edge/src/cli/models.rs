//! `models`.

use std::io::{self, Write};

use clap::Args;
use slag_models::commands::{self as model_commands, ModelsCommand};
use slag_models::hub::Side;

use super::args::variable;
use super::failure::Failure;
use super::output::print_json;

#[derive(Debug, Args)]
pub struct ModelsArgs {
    #[command(subcommand)]
    pub command: ModelsCommand,
    /// Print the result as JSON.
    #[arg(long, global = true)]
    pub json: bool,
}

pub fn run(args: ModelsArgs) -> Result<(), Failure> {
    let context = model_commands::Context {
        variable: &variable,
        side: Side::Text,
        ask: &|question| !args.json && model_commands::ask(question),
    };
    let report = model_commands::run(&args.command, &context);
    let report = report.map_err(|e| Failure::failed("models", e))?;
    if args.json { print_json(&report) } else { Ok(write!(io::stdout(), "{report}")?) }
}
