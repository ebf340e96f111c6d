//! Reasons for empty answers, with the nearest miss.

use glam::DVec3;
use slag_common::shard::ShardView;

use super::answers::{Reason, ReasonKind};
use super::request::QueryRequest;
use super::scale::Scale;
use crate::score::Search;

/// Returns why no object was found. `best`: score and position of the best object on board.
pub fn of_objects(request: &QueryRequest, threshold: f32, best: Option<(f32, DVec3)>) -> Reason {
    let place = &request.region;
    let (kind, detail) = match best {
        None => (
            ReasonKind::NothingThere,
            "the shards on board have no objects; ask with kind=clusters, or encode the scene with objects"
                .to_owned(),
        ),
        Some((score, at)) if score < threshold => (
            ReasonKind::BelowThreshold,
            format!("no object reaches {threshold}; the best has {score:.3}, at {at:.2}"),
        ),
        Some(_) => (
            ReasonKind::NothingThere,
            format!(
                "no object that reaches {threshold} has {} Gaussians{place}; fetch that area, or search elsewhere",
                request.min_count
            ),
        ),
    };
    Reason {
        kind,
        detail,
        best_score: best.map(|(score, _)| score),
        best_position_in_world: best.map(|(_, at)| at),
    }
}

/// Returns why no Gaussian or cluster was found.
pub fn of_gaussians(
    search: &Search<'_>,
    scale: Scale,
    request: &QueryRequest,
    threshold: f32,
    n_matching: u64,
) -> Reason {
    let place = &request.region;
    let best = search.best(1, f32::NEG_INFINITY, request.near).first().map(|hit| {
        (scale.shown(hit.score), search.shards()[hit.shard as usize].position_in_world(hit.index as usize))
    });
    let (kind, detail) = match best {
        None => (
            ReasonKind::NothingThere,
            format!("there is no Gaussian with an embedding{place}; fetch that area, or search elsewhere"),
        ),
        Some(_) if n_matching > 0 => (
            ReasonKind::ClustersTooSmall,
            format!(
                "{n_matching} Gaussians{place} reach {threshold}, but no cluster of them has {}; lower min_count or increase voxel",
                request.min_count
            ),
        ),
        Some((score, at)) => {
            let n: usize = search.searched().map(ShardView::n_with_evidence).sum();
            (
                ReasonKind::BelowThreshold,
                format!(
                    "no Gaussian of the {n} searched{place} reaches {threshold}; the best has {score:.3}, at {at:.2}"
                ),
            )
        }
    };
    Reason {
        kind,
        detail,
        best_score: best.map(|(score, _)| score),
        best_position_in_world: best.map(|(_, at)| at),
    }
}
