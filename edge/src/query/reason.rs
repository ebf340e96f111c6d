//! Reasons for empty answers, with the nearest miss.

use std::ops::Range;

use glam::DVec3;
use schemars::JsonSchema;
use serde::Serialize;
use slag_api::coverage::Coverage;
use slag_common::shard::ShardView;

use super::request::QueryRequest;
use super::scale::Scale;
use super::scene::Scene;
use crate::score::{Region, Search};

/// Kind of reason for an empty answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ReasonKind {
    /// No Gaussian or object reaches the threshold.
    BelowThreshold,
    /// Gaussians or objects match, but no cluster and no object has enough Gaussians.
    ClustersTooSmall,
    /// The region asked for holds nothing that could match.
    NothingThere,
    /// Views saw less than half of the region asked for.
    NotLookedThere,
    /// There are answers, all before the page.
    BeyondEnd,
    /// Of a phrase: nothing on board is such a thing.
    NoSuchThing,
    /// Of a phrase: such things are on board, but none is so placed.
    NoSuchPair,
    /// Of a phrase: there are fewer of them than counted.
    TooFew,
    /// Of a phrase: such things are on board, but none in the region asked for.
    NotInRegion,
}

/// Reason for an empty answer, with the nearest miss.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Reason {
    /// Kind.
    pub kind: ReasonKind,
    /// The reason in words.
    pub detail: String,
    /// Share of the Gaussians on board in the region asked for that a used view saw; absent where there are none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seen_share: Option<f64>,
    /// Best score found.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub best_score: Option<f32>,
    /// Position of the best score.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schemars(with = "Option<[f64; 3]>")]
    pub best_position_in_world: Option<DVec3>,
    /// Of a phrase: the thing that is missing, or not so placed.
    #[serde(skip)]
    pub thing: Option<Box<str>>,
    /// Of a phrase: greatest degree of the relation among all pairs.
    #[serde(skip)]
    pub best_degree: Option<f64>,
}

impl Reason {
    pub fn new(kind: ReasonKind, detail: String) -> Self {
        Self {
            kind,
            detail,
            seen_share: None,
            best_score: None,
            best_position_in_world: None,
            thing: None,
            best_degree: None,
        }
    }
}

/// Least share of a region's Gaussians in views for the region to count as seen.
const MIN_SEEN: f64 = 0.5;

/// Returns the share of a region's Gaussians on board seen by a used view; `None` without Gaussians.
fn seen_share(shards: &[ShardView<'_>], region: &Region) -> Option<f64> {
    let (mut n_seen, mut n_unseen) = (0, 0);
    for shard in shards.iter().filter(|shard| region.touches(&shard.position_box())) {
        // Those without evidence come last.
        let (n_with_evidence, n) = (shard.n_with_evidence(), shard.header.n_gaussians as usize);
        let in_region = |range: Range<usize>| match region.covers(&shard.position_box()) {
            true => range.len(),
            false => range.filter(|at| region.contains(shard.position_in_world(*at))).count(),
        };
        n_seen += in_region(0..n_with_evidence);
        n_unseen += in_region(n_with_evidence..n);
    }
    let n = n_seen + n_unseen;
    (n > 0).then(|| n_seen as f64 / n as f64)
}

/// Adds the seen share of the region to a reason; if too small for a no, kind and detail say so. The detail says what
/// of the region is not on board.
pub fn complete(reason: &mut Reason, shards: &[ShardView<'_>], region: &Region, coverage: &Coverage) {
    reason.seen_share = seen_share(shards, region);
    let seen = reason.seen_share.filter(|seen| *seen < MIN_SEEN);
    if let Some(share) = seen.filter(|_| reason.kind != ReasonKind::ClustersTooSmall) {
        let (percent, detail) = (100.0 * share, &reason.detail);
        reason.detail =
            format!("not looked there: photos saw {percent:.0} % of what is on board{region}; {detail}");
        reason.kind = ReasonKind::NotLookedThere;
    }
    if let Some(missing) = coverage.missing() {
        reason.detail = format!("{}; {missing}", reason.detail);
    }
}

/// `best`: score and position of the nearest miss.
fn reason((kind, detail): (ReasonKind, String), best: Option<(f32, DVec3)>) -> Reason {
    let (best_score, best_position_in_world) = best.unzip();
    Reason { best_score, best_position_in_world, ..Reason::new(kind, detail) }
}

/// The best object in the region asked for.
pub struct BestObject {
    pub score: f32,
    /// Whether it reaches the threshold, and only lacks Gaussians there.
    pub reaches: bool,
    pub position_in_world: DVec3,
}

/// Returns a hint for an empty region; [`complete`] says what of it is known to be missing.
fn elsewhere(region: &Region) -> &'static str {
    match region {
        Region { ball: None, bounds: None, polygon: None } => "fetch another area",
        Region { ball: None, bounds: None, .. } => {
            "fetch that area if it is not on board, or search elsewhere"
        }
        _ => "search elsewhere",
    }
}

/// Returns why no object was found in the region asked for.
pub fn of_objects(
    scene: &Scene<'_>,
    request: &QueryRequest,
    threshold: f32,
    best: Option<BestObject>,
) -> Reason {
    let place = &request.region;
    let (kind, detail) = match &best {
        None if scene.index.is_empty() => (
            ReasonKind::NothingThere,
            "the shards on board have no objects; ask with kind=clusters, or encode the scene with objects"
                .to_owned(),
        ),
        None if seen_share(&scene.shards, place).is_some() => {
            let advice =
                if request.kind.is_some() { "; ask with kind=clusters, or search elsewhere" } else { "" };
            let detail = format!("there are Gaussians{place}, but none of an object{advice}");
            (ReasonKind::BelowThreshold, detail)
        }
        None => (ReasonKind::NothingThere, format!("there is no object{place}; {}", elsewhere(place))),
        Some(BestObject { reaches: false, score, position_in_world }) => (
            ReasonKind::BelowThreshold,
            format!(
                "no object{place} reaches {threshold:.3}; the best has {score:.3}, at {position_in_world:.2}"
            ),
        ),
        Some(BestObject { reaches: true, .. }) => (
            ReasonKind::ClustersTooSmall,
            format!(
                "no object that reaches {threshold:.3} has {} Gaussians{place}; lower min_count",
                request.min_count
            ),
        ),
    };
    reason((kind, detail), best.map(|best| (best.score, best.position_in_world)))
}

pub fn of_gaussians(
    search: &Search<'_>,
    scale: Scale,
    request: &QueryRequest,
    threshold: f32,
    n_matching: u64,
) -> Reason {
    let place = &request.region;
    let best = search.best(1, f32::NEG_INFINITY, request.near).first().map(|hit| {
        (scale.shown(hit.score), search.shards[hit.shard as usize].position_in_world(hit.index as usize))
    });
    let (kind, detail) = match best {
        None => (
            ReasonKind::NothingThere,
            format!("there is no Gaussian with an embedding{place}; {}", elsewhere(place)),
        ),
        Some(_) if n_matching > 0 => (
            ReasonKind::ClustersTooSmall,
            format!(
                "{n_matching} Gaussians{place} reach {threshold:.3}, but no cluster of them has {}; lower min_count or increase voxel",
                request.min_count
            ),
        ),
        Some((score, at)) => {
            let n: usize = search.searched().map(ShardView::n_with_evidence).sum();
            (
                ReasonKind::BelowThreshold,
                format!(
                    "no Gaussian of the {n} searched{place} reaches {threshold:.3}; the best has {score:.3}, at {at:.2}"
                ),
            )
        }
    };
    reason((kind, detail), best)
}
