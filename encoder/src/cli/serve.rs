//! `serve`: publishes a store over HTTP.

use std::net::SocketAddr;
use std::path::PathBuf;

use anyhow::Result;
use clap::Args;

use super::common::{runtime, stopped};
use super::exit::Exit;
use crate::publish::serve;

/// `serve`.
#[derive(Debug, Args)]
pub struct ServeArgs {
    /// Store.
    #[arg(long, value_name = "DIR")]
    pub store: PathBuf,
    /// Address to listen on; 0.0.0.0:7733 lets other machines connect.
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:7733")]
    pub listen: SocketAddr,
}

pub(super) fn run(args: &ServeArgs) -> Result<Exit> {
    runtime()?.block_on(async {
        // On stdout: with port 0 this is where a script learns the port.
        let listening = |address| println!("listening on http://{address}");
        serve::serve(&args.store, args.listen, serve::Limits::default(), listening, stopped()).await
    })?;
    Ok(Exit::Done)
}
