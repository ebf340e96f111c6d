//! `slag-mcap`: a robot's answers and map as an MCAP file.

use std::process::ExitCode;

use clap::Parser;
use slag_mcap::{Args, record};

fn main() -> ExitCode {
    let args = Args::parse();
    match record(&args) {
        Ok(n_messages) => {
            println!("{n_messages} messages in {}", args.out.display());
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("slag-mcap: {error:#}");
            ExitCode::FAILURE
        }
    }
}
