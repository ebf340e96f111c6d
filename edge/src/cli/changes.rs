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
    use glam::DVec3;

    use super::*;
    use slag_api::changes::{ComparedGeneration, Likeness, NotCompared};

    fn thing(id: &str, x: f64, like: Option<&str>) -> ChangedThing {
        let at = DVec3::new(x, 2.0, 0.5);
        ChangedThing {
            id: id.into(),
            position_in_world: at,
            geographic: None,
            box_min_in_world: at - 1.0,
            box_max_in_world: at + 1.0,
            n_gaussians_in_scene: 9,
            photo: "p.jpg".into(),
            like: like.map(|text| Likeness { text: text.into(), score: 0.5 }),
        }
    }

    /// One of each kind; the later generation's encoder had an earlier clock.
    #[test]
    fn each_change_has_its_line() {
        let of = |generation, created_unix_secs| ComparedGeneration { generation, created_unix_secs };
        let (from, to) = (thing("o3", 3.0, None), thing("o4", 5.5, Some("chair")));
        let mut reply = ChangesReply {
            scene: "yard".into(),
            frame: "world".into(),
            unit: "m".into(),
            from: Some(of(4, 1000)),
            to: of(6, 500),
            generations: vec![4, 6],
            n_same: 3,
            n_stayed: 4,
            n_not_compared: 5,
            appeared: vec![thing("o1", 1.0, Some("box"))],
            went: vec![thing("o2", -2.0, None)],
            moved: vec![MovedThing { from, to, distance: 2.5 }],
            none: None,
        };
        let expected = "generation 4 to 6\n\
            appeared  o1 at 1.00, 2.00, 0.50, like \"box\" (0.50)\n\
            went      o2 at -2.00, 2.00, 0.50\n\
            moved     2.50 m: o4 at 5.50, 2.00, 0.50, like \"chair\" (0.50); was o3 at 3.00, 2.00, 0.50\n\
            things    7 stayed, 3 of them unchanged; 5 not compared: one generation alone knows their place, or the splat there is the same\n";
        assert_eq!(lines(&reply), expected);
        reply.unit = "world".into();
        assert!(lines(&reply).contains("moved     2.50: o4"), "{}", lines(&reply));
        reply.none =
            Some(NotCompared { kind: "no-earlier-generation".into(), detail: "there is none".into() });
        assert_eq!(lines(&reply), "there is none\n");
    }
}
