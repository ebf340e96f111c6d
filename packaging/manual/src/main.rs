//! `slag-manual`: writes manual pages and shell completions of all programs from their command-line definitions. A
//! separate program, so that the others carry neither generator.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use clap::{Command, CommandFactory, Parser};
use clap_complete::Shell;
use slag_models::help;

/// Writes manual pages and shell completions of slag-encoder, slag-edge, slag-mcap, slag-mcp and slag-ros.
///
/// A page for each command: slag-edge-fetch.1. Completions under the names that bash, zsh and fish look for:
/// slag-edge.bash, _slag-edge, slag-edge.fish.
#[derive(Debug, Parser)]
#[command(name = "slag-manual", version)]
struct Args {
    /// Folder to write to; it is made where it is absent.
    out: PathBuf,
}

fn main() -> Result<()> {
    let Args { out } = Args::parse();
    fs_err::create_dir_all(&out)?;
    for program in [
        help::layered(slag_encoder::cli::Cli::command()),
        help::layered(slag_edge::cli::Cli::command()),
        slag_mcap::Args::command(),
        slag_mcp::Args::command(),
        slag_ros::Args::command(),
    ] {
        write(program, &out)?;
    }
    Ok(())
}

fn write(mut program: Command, out: &Path) -> Result<()> {
    let name = program.get_name().to_owned();
    let place = || format!("{name}: {} cannot be written to", out.display());
    clap_mangen::generate_to(program.clone(), out).with_context(place)?;
    for shell in [Shell::Bash, Shell::Zsh, Shell::Fish] {
        clap_complete::generate_to(shell, &mut program, &name, out).with_context(place)?;
    }
    Ok(())
}
