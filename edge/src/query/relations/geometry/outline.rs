//! Convex outlines on the ground.

use glam::DVec2;

/// Returns the area that two convex outlines share, both counter-clockwise (Sutherland and Hodgman, 1974).
pub fn shared_area(a: &[DVec2], b: &[DVec2]) -> f64 {
    let mut shared: Vec<DVec2> = a.to_vec();
    for (from, to) in edges(b) {
        let side = |p: DVec2| (to - from).perp_dot(p - from);
        let mut kept = Vec::with_capacity(shared.len() + 1);
        for (p, q) in edges(&shared) {
            let (of_p, of_q) = (side(p), side(q));
            if of_p >= 0.0 {
                kept.push(p);
            }
            if of_p * of_q < 0.0 {
                kept.push(p + (q - p) * (of_p / (of_p - of_q)));
            }
        }
        shared = kept;
    }
    edges(&shared).map(|(p, q)| p.perp_dot(q)).sum::<f64>().max(0.0) * 0.5
}

/// Returns the distance between two convex outlines, 0 if they share a point.
pub fn gap(a: &[DVec2], b: &[DVec2]) -> f64 {
    if contains(a, b[0]) || contains(b, a[0]) {
        return 0.0;
    }
    let pairs = edges(a).flat_map(|one| edges(b).map(move |other| (one, other)));
    pairs.map(|(one, other)| between_segments(one, other)).fold(f64::INFINITY, f64::min)
}

fn edges(of: &[DVec2]) -> impl Iterator<Item = (DVec2, DVec2)> {
    (0..of.len()).map(move |at| (of[at], of[(at + 1) % of.len()]))
}

fn contains(of: &[DVec2], point: DVec2) -> bool {
    edges(of).all(|(from, to)| (to - from).perp_dot(point - from) >= 0.0)
}

fn between_segments(a: (DVec2, DVec2), b: (DVec2, DVec2)) -> f64 {
    let side = |(from, to): (DVec2, DVec2), p: DVec2| (to - from).perp_dot(p - from);
    let crosses = |one, other: (DVec2, DVec2)| side(one, other.0) * side(one, other.1) < 0.0;
    if crosses(a, b) && crosses(b, a) {
        return 0.0;
    }
    let ends = [to_segment(a.0, b), to_segment(a.1, b), to_segment(b.0, a), to_segment(b.1, a)];
    ends.into_iter().fold(f64::INFINITY, f64::min)
}

pub fn to_segment(point: DVec2, (from, to): (DVec2, DVec2)) -> f64 {
    let along = to - from;
    let at = (point - from).dot(along) / along.length_squared().max(f64::MIN_POSITIVE);
    point.distance(from + along * at.clamp(0.0, 1.0))
}
