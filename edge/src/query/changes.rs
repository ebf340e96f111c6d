//! Changes between two generations that the robot has had.

use glam::DVec3;
use slag_api::FRAME;
use slag_api::changes::{
    ChangedThing, ChangesReply, ComparedGeneration, Likeness, MovedThing, NO_EARLIER, NotCompared,
};
use slag_common::manifest::Manifest;
use slag_common::objects::{self, Moved, Thing, public_id};

use super::engine::{Engine, QueryError};
use super::request::RequestError;
use super::scene::unit;
use crate::score::Budget;
use crate::store::history::{self, Record};
use crate::store::{EdgeCache, Snapshot};

#[derive(Clone, Debug, Default, PartialEq)]
pub struct ChangesRequest {
    /// The earlier generation; if absent, the newest remembered one before `to`.
    pub from: Option<u64>,
    /// The later one; if absent, the one on board.
    pub to: Option<u64>,
    /// Only changes within this distance of a point; one end of a move suffices.
    pub ball: Option<(DVec3, f64)>,
    /// Kinds of things: each changed thing gets its most similar one.
    pub texts: Vec<String>,
}

/// A generation that was asked for is not remembered.
pub const NO_SUCH_GENERATION: &str = "no-such-generation";

fn incomparable(kind: &'static str, detail: String) -> QueryError {
    QueryError::Unable { kind, title: "Generations do not compare", detail }
}

impl Engine {
    /// Compares two generations that the robot has had, in areas that both know. Blocks for milliseconds; for a second
    /// if thousands of things changed.
    ///
    /// # Errors
    /// [`QueryError`]. That nothing is remembered yet is a reply.
    pub fn changes(&self, request: &ChangesRequest, budget: &Budget) -> Result<ChangesReply, QueryError> {
        let on_board = self.on_board()?;
        let snapshot = &on_board.snapshot;
        let manifest = &snapshot.manifest;
        if !request.texts.is_empty() {
            on_board.check()?;
        }
        let texts = request.texts.iter().map(|text| Ok((text.clone(), on_board.encode(text)?.to_vec())));
        let words = Words(texts.collect::<Result<_, QueryError>>()?);
        // Two records and the reply.
        let of_thing =
            size_of::<Thing>() + size_of::<ChangedThing>() + size_of::<f64>() * manifest.encoder.dim as usize;
        budget.take(2 * of_thing * snapshot.objects.len());
        budget.check()?;
        let generations = known(self.cache(), manifest);
        let to = generation(self.cache(), snapshot, request.to.unwrap_or(manifest.generation), &generations)?;
        if let Some(from) = request.from
            && !generations.contains(&from)
        {
            generation(self.cache(), snapshot, from, &generations)?;
        }
        let from = match request.from {
            _ if generations.iter().all(|of| *of >= to.generation) => None,
            Some(from) if from >= to.generation => {
                let expected = format!("less than {}, the generation to compare with", to.generation);
                return Err(RequestError::new("from", &from.to_string(), expected).into());
            }
            Some(from) => Some(generation(self.cache(), snapshot, from, &generations)?),
            None => {
                let before = generations.iter().rev().find(|of| **of < to.generation);
                before.map(|of| generation(self.cache(), snapshot, *of, &generations)).transpose()?
            }
        };
        if let Some(from) = &from
            && from.encoder_id != to.encoder_id
        {
            let detail = format!(
                "generations {} and {} were encoded with different models, so that their things do not compare",
                from.generation, to.generation
            );
            return Err(incomparable("encoders-differ", detail));
        }
        budget.check()?;
        Ok(reply(from, to, manifest, generations, request, &words))
    }
}

/// Returns the generations that can be compared, ascending.
fn known(cache: &EdgeCache, manifest: &Manifest) -> Vec<u64> {
    let mut known = history::generations(cache);
    known.retain(|of| *of < manifest.generation && history::read(cache, &manifest.scene, *of).is_some());
    known.push(manifest.generation);
    known
}

fn generation(
    cache: &EdgeCache,
    snapshot: &Snapshot,
    wanted: u64,
    known: &[u64],
) -> Result<Record, QueryError> {
    let Snapshot { manifest, current, bad_cells, .. } = snapshot;
    let remembered = history::read(cache, &manifest.scene, wanted);
    if wanted != manifest.generation {
        return remembered.ok_or_else(|| {
            let known = known.iter().map(u64::to_string).collect::<Vec<_>>().join(", ");
            let detail = format!("generation {wanted} is not remembered; those that are: {known}");
            QueryError::Unable { kind: NO_SUCH_GENERATION, title: "No such generation", detail }
        });
    }
    // The shards of earlier generations that stand in for bad cells say nothing about this one.
    let is_own = |cell_id: u32| !bad_cells.iter().any(|bad| bad.cell_id == cell_id);
    let shards = snapshot.shards.iter().map(|shard| &**shard).filter(|shard| is_own(shard.cell.cell_id));
    let on_board = Record::collect(manifest, current.centre_in_world, shards);
    // Things left behind in this generation count, too.
    match (remembered, on_board) {
        (Some(remembered), Some(on_board)) => Ok(remembered.with(on_board)),
        (None, Some(record)) | (Some(record), None) => Ok(record),
        (None, None) => Err(incomparable(
            "no-objects",
            format!(
                "generation {wanted} has no objects on board to compare; encode the scene without --no-objects, publish it, and fetch it again"
            ),
        )),
    }
}

fn reply(
    from: Option<Record>,
    mut to: Record,
    manifest: &Manifest,
    generations: Vec<u64>,
    request: &ChangesRequest,
    words: &Words,
) -> ChangesReply {
    let compared = |of: &Record| ComparedGeneration {
        generation: of.generation,
        created_unix_secs: of.created_unix_secs,
    };
    let ends = (from.as_ref().map(compared), compared(&to));
    let found = from.map(|mut from| {
        let (old, new) = (std::mem::take(&mut from.things), std::mem::take(&mut to.things));
        let new_tells = |thing: &Thing| to.tells_of(thing, from.places());
        let old_tells = |thing: &Thing| from.tells_of(thing, to.places());
        objects::changes(old, new, new_tells, old_tells)
    });
    let none = found.is_none().then(|| NotCompared {
        kind: NO_EARLIER.into(),
        detail: format!("the robot has had no generation with objects before {}", to.generation),
    });
    let found = found.unwrap_or_default();
    let is_asked = |thing: &Thing| {
        request.ball.is_none_or(|(centre, radius)| thing.position_in_world.distance(centre) <= radius)
    };
    let describe = |thing: &Thing| words.describe(thing, manifest);
    let some = |things: &[Thing]| things.iter().filter(|of| is_asked(of)).map(describe).collect();
    let moved = found.moved.iter().filter(|moved| is_asked(&moved.from) || is_asked(&moved.to));
    let describe_move = |moved: &Moved| MovedThing {
        from: describe(&moved.from),
        to: describe(&moved.to),
        distance: moved.distance,
    };
    ChangesReply {
        scene: manifest.scene.clone(),
        frame: FRAME.into(),
        unit: unit(manifest).into(),
        from: ends.0,
        to: ends.1,
        generations,
        n_same: found.n_same,
        n_stayed: found.n_stayed,
        n_not_compared: found.n_not_compared,
        appeared: some(&found.appeared),
        went: some(&found.went),
        moved: moved.map(describe_move).collect(),
        none,
    }
}

/// The request's texts and their unit vectors.
struct Words(Vec<(String, Vec<f32>)>);

impl Words {
    fn describe(&self, thing: &Thing, manifest: &Manifest) -> ChangedThing {
        let position_in_world = thing.position_in_world;
        ChangedThing {
            id: public_id(thing.id),
            position_in_world,
            geographic: manifest.geo_reference.map(|geo| geo.geographic_from_world(position_in_world)),
            box_min_in_world: thing.box_in_world.min,
            box_max_in_world: thing.box_in_world.max,
            n_gaussians_in_scene: thing.n_gaussians,
            photo: thing.photo.clone(),
            like: self.like(&thing.vector),
        }
    }

    fn like(&self, vector: &[f64]) -> Option<Likeness> {
        let cosine = |text: &[f32]| -> f32 {
            let length = vector.iter().map(|v| v * v).sum::<f64>().sqrt().max(f64::MIN_POSITIVE);
            (vector.iter().zip(text).map(|(a, b)| a * f64::from(*b)).sum::<f64>() / length) as f32
        };
        let scored = self.0.iter().map(|(text, of_text)| (text, cosine(of_text)));
        let best = scored.reduce(|best, other| if other.1 > best.1 { other } else { best });
        best.map(|(text, score)| Likeness { text: text.clone(), score })
    }
}
