//! `bench`.

use std::time::Duration;

use anyhow::{Context, anyhow};
use slag_edge::bench::load::{self, LoadOptions};
use slag_edge::bench::pause::{self, PauseOptions};

use super::output::{Failure, print_json};
use super::{BenchCommand, LoadArgs, PauseArgs};

/// Time of queries without fetches, to compare with.
const IDLE: Duration = Duration::from_secs(2);
/// Time to measure what a service answers without overload.
const WARM_UP: Duration = Duration::from_secs(2);

pub fn run(command: BenchCommand) -> Result<(), Failure> {
    match command {
        BenchCommand::Pause(args) => bench_pause(args),
        BenchCommand::Load(args) => bench_load(args),
    }
}

fn bench_pause(args: PauseArgs) -> Result<(), Failure> {
    let in_temporary = || std::env::temp_dir().join(format!("slag-bench-pause-{}", std::process::id()));
    let options = PauseOptions {
        n_gaussians: args.gaussians,
        dim: args.dim,
        n_fetches: args.fetches,
        idle: IDLE,
        work_dir: args.work.unwrap_or_else(in_temporary),
    };
    print_json(&pause::run(&options).map_err(|e| Failure::Failed("bench", e.into()))?)
}

fn bench_load(args: LoadArgs) -> Result<(), Failure> {
    if !(0.01..=1e4).contains(&args.overload) {
        return Err(Failure::Usage(anyhow!("the overload is {}, it must be 0.01 to 10000", args.overload)));
    }
    let address = args.url.trim_end_matches('/').strip_prefix("http://");
    let advice = || Failure::Usage(anyhow!("{:?} is no address like http://127.0.0.1:7734", args.url));
    let text: String = args.text.bytes().map(percent_encoded).collect();
    let options = LoadOptions {
        address: address.ok_or_else(advice)?.to_owned(),
        path: format!("/query?text={text}"),
        n_clients: args.clients as usize,
        overload: args.overload,
        warm_up: WARM_UP,
        duration: Duration::from_secs(args.seconds),
        pid: args.pid,
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let report = runtime.block_on(load::run(&options)).context("the load ended early");
    print_json(&report.map_err(Failure::of("bench"))?)
}

fn percent_encoded(byte: u8) -> String {
    match byte {
        b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' => char::from(byte).to_string(),
        other => format!("%{other:02X}"),
    }
}
