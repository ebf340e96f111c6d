//! `slag-mcap`: a robot's answers and map as an MCAP file.

use std::io::{self, Write};
use std::process::ExitCode;

use clap::Parser;
use slag_mcap::{Args, record};

fn main() -> ExitCode {
    let args = Args::parse();
    match record(&args) {
        Ok(n_messages) => {
            let _ = writeln!(io::stdout(), "{n_messages} messages in {}", args.out.display());
            ExitCode::SUCCESS
        }
        Err(error) => {
            slag_robot::note(format_args!("slag-mcap: {error:#}"));
            ExitCode::FAILURE
        }
    }
}
