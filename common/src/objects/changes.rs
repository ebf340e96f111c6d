//! Which objects of two generations are the same.
//!
//! Matched first: equal Gaussians; then similar vectors and overlapping boxes, most overlap first; then, of the rest,
//! similar vectors and equal size, nearest first. An object is matched once. The more equal two boxes are, the less
//! their vectors need be: what stands around a thing, and the views that show it, change its vector, not its box.

use std::collections::BTreeMap;

use glam::DVec3;
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};

use super::columns::Objects;
use crate::frames::Aabb;
use crate::shard::ShardView;

/// Least cosine of an object that stayed: new photos change its vector, another object in its place differs more.
const STAYED_COSINE: f64 = 0.8;
/// Least intersection over union of the boxes of an object that stayed.
const STAYED_OVERLAP: f64 = 0.25;
/// Least cosine for an object that moved: higher than for one that stayed, as its place is no evidence.
const MOVED_COSINE: f64 = 0.9;
/// Largest ratio of the sorted box edges of an object that moved; sorted, because it may have turned.
const MOVED_SIZE_RATIO: f64 = 1.5;
/// Least intersection over union of boxes, and largest ratio of edges and of numbers of Gaussians, of one shape: other
/// things have other shapes.
const ONE_SHAPE_OVERLAP: f64 = 0.85;
const ONE_SHAPE_RATIO: f64 = 1.1;
/// Least cosines of an object of one shape, at the same place and at another.
const ONE_SHAPE_STAYED_COSINE: f64 = 0.5;
const ONE_SHAPE_MOVED_COSINE: f64 = 0.75;
/// Most Gaussians of a sparse piece, in shares of those of the thing that it touches, and most of its density.
const PIECE_SHARE: f64 = 0.05;
const PIECE_DENSITY: f64 = 0.25;
/// Boxes are widened on each side by this share of their diagonal, so that flat objects can overlap.
const MARGIN: f64 = 0.05;
/// Candidates kept for each earlier object, those of lowest cost: bounds memory where thousands are alike.
const MAX_CANDIDATES: usize = 32;

#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Place {
    pub bounds: Aabb,
    /// See [`ShardView::splat_digest`](crate::shard::ShardView::splat_digest).
    pub splat: u64,
}

/// Returns whether the splat around an object is unchanged: the other generation has every cell that its box touches.
/// Such an object may be outlined differently, but has neither appeared nor gone.
pub fn is_unchanged(thing: &Thing, own: &[Place], other: &[Place]) -> bool {
    let mut here = own.iter().filter(|place| place.bounds.touches(&thing.box_in_world)).peekable();
    here.peek().is_some() && here.all(|place| other.iter().any(|known| known.splat == place.splat))
}

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Moved {
    pub from: Thing,
    pub to: Thing,
    /// Between the positions, world units.
    pub distance: f64,
}

#[derive(Clone, Debug, Default, PartialEq)]
pub struct Changes {
    /// With exactly the same Gaussians.
    pub n_same: usize,
    /// At the same place with other Gaussians.
    pub n_stayed: usize,
    /// In one list only, and not compared: the other does not know their place, the splat there is unchanged, or it is
    /// a sparse piece of a thing that both have.
    pub n_not_compared: usize,
    /// In the later list only, by id.
    pub appeared: Vec<Thing>,
    /// In the earlier list only, by id.
    pub went: Vec<Thing>,
    /// Moved, by their earlier ids.
    pub moved: Vec<Moved>,
}

/// Returns the changes between two lists, each ascending by id.
///
/// `new_tells`: whether an earlier object absent from the later list is gone; `old_tells`: the reverse. Others are only
/// matched in place.
pub fn changes(
    old: Vec<Thing>,
    new: Vec<Thing>,
    new_tells: impl Fn(&Thing) -> bool,
    old_tells: impl Fn(&Thing) -> bool,
) -> Changes {
    let is_in = |things: &[Thing], id: u64| things.binary_search_by_key(&id, |thing| thing.id).is_ok();
    let same: Vec<Thing> = new.iter().filter(|thing| is_in(&old, thing.id)).cloned().collect();
    let n_same = same.len();
    let went: Vec<Thing> = old.iter().filter(|thing| !is_in(&new, thing.id)).cloned().collect();
    let appeared: Vec<Thing> = new.into_iter().filter(|thing| !is_in(&old, thing.id)).collect();
    let stayed = pairs(&went, &appeared, |old, new| {
        let overlap = overlap(&old.box_in_world, &new.box_in_world);
        let is_one_shape = overlap >= ONE_SHAPE_OVERLAP && have_one_shape(old, new);
        let least_cosine = if is_one_shape { ONE_SHAPE_STAYED_COSINE } else { STAYED_COSINE };
        (overlap >= STAYED_OVERLAP && cosine(old, new) >= least_cosine).then_some(-overlap)
    });
    let both: Vec<Thing> = stayed.iter().map(|(at_old, _)| went[*at_old].clone()).chain(same).collect();
    let [mut went, mut appeared] = without(went, appeared, &stayed);
    let n_rest = went.len() + appeared.len();
    let is_piece = |thing: &Thing| both.iter().any(|of| is_sparse_piece(thing, of));
    went.retain(|thing| new_tells(thing) && !is_piece(thing));
    appeared.retain(|thing| old_tells(thing) && !is_piece(thing));
    let n_not_compared = n_rest - went.len() - appeared.len();
    let moved = pairs(&went, &appeared, |old, new| {
        let distance = old.position_in_world.distance(new.position_in_world);
        let least_cosine = if have_one_shape(old, new) { ONE_SHAPE_MOVED_COSINE } else { MOVED_COSINE };
        (edge_ratio(old, new) <= MOVED_SIZE_RATIO && cosine(old, new) >= least_cosine).then_some(distance)
    });
    let of_pair = |&(at_old, at_new): &(usize, usize)| {
        let (from, to) = (went[at_old].clone(), appeared[at_new].clone());
        Moved { distance: from.position_in_world.distance(to.position_in_world), from, to }
    };
    let mut list: Vec<Moved> = moved.iter().map(of_pair).collect();
    list.sort_by_key(|moved| moved.from.id);
    let [went, appeared] = without(went, appeared, &moved);
    Changes { n_same, n_stayed: stayed.len(), n_not_compared, appeared, went, moved: list }
}

/// Pairs objects of two lists, lowest cost first; a cost of `None` excludes a pair.
fn pairs(old: &[Thing], new: &[Thing], cost: impl Fn(&Thing, &Thing) -> Option<f64>) -> Vec<(usize, usize)> {
    let mut candidates: Vec<(f64, usize, usize)> = Vec::new();
    for (at_old, old) in old.iter().enumerate() {
        let of_old = new.iter().enumerate().filter_map(|(at, new)| Some((cost(old, new)?, at_old, at)));
        let first = candidates.len();
        candidates.extend(of_old);
        if candidates.len() > first + MAX_CANDIDATES {
            candidates[first..].sort_by(|a, b| a.0.total_cmp(&b.0).then(a.2.cmp(&b.2)));
            candidates.truncate(first + MAX_CANDIDATES);
        }
    }
    candidates.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    let (mut old_is_free, mut new_is_free) = (vec![true; old.len()], vec![true; new.len()]);
    candidates.retain(|(_, at_old, at_new)| {
        let is_pair = old_is_free[*at_old] && new_is_free[*at_new];
        if is_pair {
            (old_is_free[*at_old], new_is_free[*at_new]) = (false, false);
        }
        is_pair
    });
    candidates.into_iter().map(|(_, at_old, at_new)| (at_old, at_new)).collect()
}

fn without(old: Vec<Thing>, new: Vec<Thing>, pairs: &[(usize, usize)]) -> [Vec<Thing>; 2] {
    let rest = |things: Vec<Thing>, mut taken: Vec<usize>| -> Vec<Thing> {
        taken.sort_unstable();
        let is_free = |at: &usize| taken.binary_search(at).is_err();
        things.into_iter().enumerate().filter(|(at, _)| is_free(at)).map(|(_, thing)| thing).collect()
    };
    let (of_old, of_new) = pairs.iter().copied().unzip();
    [rest(old, of_old), rest(new, of_new)]
}

fn cosine(a: &Thing, b: &Thing) -> f64 {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let lengths = (dot(&a.vector, &a.vector) * dot(&b.vector, &b.vector)).sqrt();
    dot(&a.vector, &b.vector) / lengths.max(f64::MIN_POSITIVE)
}

/// Intersection over union of two boxes, with margins.
fn overlap(a: &Aabb, b: &Aabb) -> f64 {
    let [a, b] = [a, b].map(|of| {
        let margin = DVec3::splat(MARGIN * of.size().length());
        Aabb { min: of.min - margin, max: of.max + margin }
    });
    let volume = |size: DVec3| size.max(DVec3::ZERO).element_product();
    let both = volume(a.max.min(b.max) - a.min.max(b.min));
    both / (volume(a.size()) + volume(b.size()) - both).max(f64::MIN_POSITIVE)
}

/// Returns whether sizes and numbers of Gaussians are nearly equal.
fn have_one_shape(a: &Thing, b: &Thing) -> bool {
    let n = [a, b].map(|of| f64::from(of.n_gaussians));
    edge_ratio(a, b) <= ONE_SHAPE_RATIO && n[0].max(n[1]) <= ONE_SHAPE_RATIO * n[0].min(n[1])
}

/// Returns whether one thing touches another and has few Gaussians beside it, thinly spread: a piece that the masks of
/// one generation cut off, such as a leg. A small thing that stands on another is as dense.
fn is_sparse_piece(piece: &Thing, of: &Thing) -> bool {
    let density = |thing: &Thing| {
        let [x, y, z] = thing.box_in_world.size().to_array();
        f64::from(thing.n_gaussians) / (x * y + y * z + z * x).max(f64::MIN_POSITIVE)
    };
    f64::from(piece.n_gaussians) <= PIECE_SHARE * f64::from(of.n_gaussians)
        && density(piece) <= PIECE_DENSITY * density(of)
        && of.box_in_world.touches(&piece.box_in_world)
}

/// Returns the largest ratio of the sorted edges of two boxes.
fn edge_ratio(a: &Thing, b: &Thing) -> f64 {
    let edges = |of: &Thing| {
        let size = of.box_in_world.size();
        // A flat thing's thickness is noise.
        let least = MARGIN * size.length();
        let mut edges = size.to_array().map(|edge| edge.max(least));
        edges.sort_by(f64::total_cmp);
        edges
    };
    let ratio = |(a, b): (f64, f64)| a.max(b) / a.min(b).max(f64::MIN_POSITIVE);
    edges(a).into_iter().zip(edges(b)).map(ratio).fold(1.0, f64::max)
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Thing {
    /// Derived from the indices of its Gaussians in the splat: equal while these are the same.
    #[serde(serialize_with = "as_public", deserialize_with = "from_public")]
    pub id: u64,
    pub n_gaussians: u32,
    /// Mean of its Gaussians inside the box.
    pub position_in_world: DVec3,
    /// From the 2nd to the 98th percentile of its means along each axis.
    pub box_in_world: Aabb,
    /// Name of the view that shows it best.
    pub photo: String,
    /// `[dim]`: the mean of its masks' vectors, as a shard stores it.
    #[serde(skip)]
    pub vector: Vec<f64>,
}

/// Returns the id used in answers: `o` and 16 hex digits.
pub fn public_id(id: u64) -> String {
    format!("o{id:016x}")
}

/// Inverse of [`public_id`].
pub fn parse_public_id(text: &str) -> Option<u64> {
    let digits = text.strip_prefix('o')?;
    let is_hex = digits.len() == 16 && digits.bytes().all(|b| b.is_ascii_hexdigit());
    is_hex.then(|| u64::from_str_radix(digits, 16).ok())?
}

fn as_public<S: Serializer>(id: &u64, serializer: S) -> Result<S::Ok, S::Error> {
    // JSON numbers have 53 bits.
    serializer.serialize_str(&public_id(*id))
}

/// Records of earlier versions have the digits alone.
fn from_public<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u64, D::Error> {
    let text = String::deserialize(deserializer)?;
    u64::from_str_radix(text.strip_prefix('o').unwrap_or(&text), 16).map_err(de::Error::custom)
}

impl Thing {
    /// Adds the objects of a shard, by id; of an object in several shards, the first is kept.
    pub fn add_all(things: &mut BTreeMap<u64, Self>, shard: &ShardView<'_>, objects: &Objects<'_>) {
        let dim = shard.header.dim as usize;
        let len = objects.header.n_vectors as usize * dim;
        let vectors = shard.object_vectors(objects);
        for (record, vectors) in objects.records.iter().zip(vectors.chunks_exact(len.max(1))) {
            things.entry(record.id).or_insert_with(|| Self {
                id: record.id,
                n_gaussians: record.n_gaussians,
                position_in_world: record.position(),
                box_in_world: record.bounds(),
                photo: objects.photo(record).to_owned(),
                vector: vectors[..dim].to_vec(),
            });
        }
    }
}

#[cfg(test)]
mod tests;
