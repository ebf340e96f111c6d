//! `diff`: what changed between two generations.

use std::fmt::{self, Write};
use std::path::PathBuf;

use anyhow::{Result, anyhow};
use clap::Args;
use slag_common::ByteSize;
use slag_common::objects::{Thing, public_id};

use super::common::{Exit, print};
use crate::diff::{self, Diff, Generation};
use crate::store::{Published, StoreReader};

#[derive(Debug, Args)]
pub struct DiffArgs {
    /// The earlier generation: STORE for its current one, STORE@N for generation N, which is the current one or
    /// the one before it.
    #[arg(value_name = "OLD")]
    old: At,
    /// The later generation [default: OLD's current one, and OLD is the one before it].
    #[arg(value_name = "NEW")]
    new: Option<At>,
}

#[derive(Clone, Debug, PartialEq)]
struct At {
    store: PathBuf,
    generation: Option<u64>,
}

impl std::str::FromStr for At {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        // A folder may have an @ in its name.
        let at = text.rsplit_once('@').and_then(|(store, n)| Some((store, n.parse::<u64>().ok()?)));
        Ok(match at {
            Some((store, generation)) => Self { store: store.into(), generation: Some(generation) },
            None => Self { store: text.into(), generation: None },
        })
    }
}

pub(super) fn run(args: &DiffArgs, json: bool) -> Result<Exit> {
    let old_reader = StoreReader::open(&args.old.store)?;
    let found = match &args.new {
        Some(new) => {
            let new_reader = StoreReader::open(&new.store)?;
            diff::diff(
                generation(&old_reader, args.old.generation)?,
                generation(&new_reader, new.generation)?,
            )
        }
        None => {
            let published = old_reader.previous().ok_or_else(|| {
                anyhow!("{} has one generation; name the store of another", args.old.store.display())
            })?;
            let old = match args.old.generation {
                Some(_) => generation(&old_reader, args.old.generation)?,
                None => Generation { reader: &old_reader, published },
            };
            diff::diff(old, Generation { reader: &old_reader, published: old_reader.current() })
        }
    }?;
    print(json, &found, lines(&found)?)?;
    Ok(Exit::Done)
}

/// `None` is the current generation.
fn generation(reader: &StoreReader, number: Option<u64>) -> Result<Generation<'_>> {
    let is_meant =
        |published: &&Published| number.is_none_or(|number| published.manifest.generation == number);
    let mut both = std::iter::once(reader.current()).chain(reader.previous());
    let published = both.find(is_meant).ok_or_else(|| {
        let current = reader.manifest().generation;
        anyhow!(
            "{} keeps its current generation, {current}, and the one before it; generation {} is neither",
            reader.dir().display(),
            number.unwrap_or_default()
        )
    })?;
    Ok(Generation { reader, published })
}

fn lines(diff: &Diff) -> Result<String, fmt::Error> {
    let mut lines = String::new();
    let unit = if diff.metric { " m" } else { "" };
    let place = |thing: &Thing| {
        let [[x, y, z], [w, d, h]] =
            [thing.position_in_world, thing.box_in_world.size()].map(|v| v.to_array());
        let (id, n, photo) = (public_id(thing.id), thing.n_gaussians, &thing.photo);
        format!("{id} at {x:.2} {y:.2} {z:.2}, {w:.2} x {d:.2} x {h:.2}{unit}, {n} Gaussians, in {photo}")
    };
    writeln!(lines, "generation {} to {}", diff.old_generation, diff.new_generation)?;
    for thing in &diff.appeared {
        writeln!(lines, "appeared  {}", place(thing))?;
    }
    for thing in &diff.went {
        writeln!(lines, "went      {}", place(thing))?;
    }
    for moved in &diff.moved {
        writeln!(
            lines,
            "moved     {:.2}{unit}: {}; was {}",
            moved.distance,
            place(&moved.to),
            place(&moved.from)
        )?;
    }
    let n_alike = diff.n_same + diff.n_stayed;
    writeln!(lines, "things    {n_alike} stayed, {} of them unchanged", diff.n_same)?;
    if diff.n_not_compared > 0 {
        writeln!(
            lines,
            "          {} are outlined in another way where the splat is the same, or sparse pieces of things that stayed",
            diff.n_not_compared
        )?;
    }
    let bytes = diff.fetch_bytes.iter().map(|(profile, n)| format!("{profile} {}", ByteSize(*n)));
    let bytes = bytes.collect::<Vec<_>>().join(", ");
    writeln!(lines, "to fetch  {} of {} cells: {bytes}", diff.n_cells_changed, diff.n_cells)?;
    Ok(lines)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_generation_follows_the_last_at_sign() {
        let at = |store: &str, generation| At { store: store.into(), generation };
        assert_eq!("a/store".parse(), Ok(at("a/store", None)));
        assert_eq!("a/store@3".parse(), Ok(at("a/store", Some(3))));
        assert_eq!("me@home/store".parse(), Ok(at("me@home/store", None)));
    }
}
