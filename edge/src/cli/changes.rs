//! `changes`.

use std::io::Write;

use crate::query::ChangesRequest;
use crate::score::Budget;
use clap::Args;
use slag_api::changes::{ChangedThing, ChangesReply, MovedThing};

use super::args::{CacheArgs, ModelArgs, engine};
use super::failure::Failure;
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
    engine.reload()?;
    let request = ChangesRequest { from: args.from, to: args.to, ball: None, texts: args.texts };
    let reply = engine.changes(&request, &Budget::default())?;
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
        "things    {n_alike} stayed, {n_same} of them unchanged; {} not compared: one generation alone knows their place, or the splat there is the same\n",
        reply.n_not_compared
    ));
    text
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn thing(id: &str, x: f64) -> Value {
        json!({
            "id": id, "position_in_world": [x, 2.0, 0.5], "box_min_in_world": [0, 0, 0],
            "box_max_in_world": [1, 1, 1], "n_gaussians_in_scene": 9, "photo": "p.jpg",
        })
    }

    fn like(mut thing: Value, text: &str) -> Value {
        thing["like"] = json!({"text": text, "score": 0.5});
        thing
    }

    /// One of each kind; the later generation's encoder had an earlier clock.
    #[test]
    fn each_change_has_its_line() {
        let moved = json!({"from": thing("o3", 3.0), "to": like(thing("o4", 5.5), "chair"), "distance": 2.5});
        let reply = json!({
            "scene": "yard", "frame": "world", "unit": "m", "from": {"generation": 4, "created_unix_secs": 1000},
            "to": {"generation": 6, "created_unix_secs": 500}, "generations": [4, 6], "n_same": 3, "n_stayed": 4,
            "n_not_compared": 5, "appeared": [like(thing("o1", 1.0), "box")], "went": [thing("o2", -2.0)],
            "moved": [moved], "none": null,
        });
        let mut reply: ChangesReply = serde_json::from_value(reply).expect("a reply");
        let expected = "generation 4 to 6\n\
            appeared  o1 at 1.00, 2.00, 0.50, like \"box\" (0.50)\n\
            went      o2 at -2.00, 2.00, 0.50\n\
            moved     2.50 m: o4 at 5.50, 2.00, 0.50, like \"chair\" (0.50); was o3 at 3.00, 2.00, 0.50\n\
            things    7 stayed, 3 of them unchanged; 5 not compared: one generation alone knows their place, or the splat there is the same\n";
        assert_eq!(lines(&reply), expected);
        reply.unit = "world".into();
        assert!(lines(&reply).contains("moved     2.50: o4"), "{}", lines(&reply));
        reply.none =
            serde_json::from_value(json!({"kind": "none", "detail": "there is none"})).expect("none");
        assert_eq!(lines(&reply), "there is none\n");
    }
}
