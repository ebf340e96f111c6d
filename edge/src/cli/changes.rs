//! `changes`.

use std::io::Write;

use crate::query::{ChangedThing, ChangesError, ChangesReply, ChangesRequest, MovedThing};
use clap::Args;

use super::args::{CacheArgs, ModelArgs, engine};
use super::failure::{Failure, store_failure};
use super::output::print_json;

#[derive(Debug, Args)]
pub struct ChangesArgs {
    /// Kinds of things: each changed thing names the one that it is most like.
    pub texts: Vec<String>,
    /// The earlier generation [default: the newest before that is remembered].
    #[arg(long, value_name = "GENERATION")]
    pub from: Option<u64>,
    /// The later generation [default: that on board].
    #[arg(long, value_name = "GENERATION")]
    pub to: Option<u64>,
    #[command(flatten)]
    pub cache: CacheArgs,
    #[command(flatten)]
    pub models: ModelArgs,
    /// Print the changes as JSON.
    #[arg(long)]
    pub json: bool,
}

pub fn run(args: ChangesArgs) -> Result<(), Failure> {
    let engine = engine(args.cache.open()?, &args.models)?;
    engine.reload().map_err(store_failure)?;
    let request = ChangesRequest { from: args.from, to: args.to, ball: None, texts: args.texts };
    let reply = engine.changes(&request).map_err(|error| match error {
        ChangesError::Query(error) => error.into(),
        other => Failure::Failed(other.kind(), other.into()),
    })?;
    if args.json {
        return print_json(&reply);
    }
    Ok(std::io::stdout().write_all(lines(&reply).as_bytes())?)
}

fn lines(reply: &ChangesReply) -> String {
    if let Some(none) = &reply.none {
        return format!("{}\n", none.detail);
    }
    let unit = if reply.unit == "m" { " m" } else { "" };
    let place = |of: &ChangedThing| {
        let [x, y, z] = of.position_in_world.to_array();
        let like = of.like.as_ref().map(|like| format!(", like \"{}\" ({:.2})", like.text, like.score));
        format!("{} at {x:.2}, {y:.2}, {z:.2}{}", of.id, like.unwrap_or_default())
    };
    let from = reply.from.map(|of| of.generation).unwrap_or_default();
    let mut text = format!("generation {from} to {}\n", reply.to.generation);
    for thing in &reply.appeared {
        text.push_str(&format!("appeared  {}\n", place(thing)));
    }
    for thing in &reply.went {
        text.push_str(&format!("went      {}\n", place(thing)));
    }
    for MovedThing { from, to, distance } in &reply.moved {
        text.push_str(&format!("moved     {distance:.2}{unit}: {}; was {}\n", place(to), place(from)));
    }
    let (n_alike, n_same) = (reply.n_same + reply.n_stayed, reply.n_same);
    text.push_str(&format!(
        "things    {n_alike} stayed, {n_same} of them unchanged; {} not compared: one generation alone knows their place\n",
        reply.n_not_compared
    ));
    text
}
