//! Places for the labels of points: none lies on another, on a point, or outside the plot.

/// A rectangle on the page, pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Rect {
    pub(super) left: f64,
    pub(super) top: f64,
    pub(super) right: f64,
    pub(super) bottom: f64,
}

impl Rect {
    pub(super) fn meets(&self, other: &Self) -> bool {
        self.left < other.right
            && other.left < self.right
            && self.top < other.bottom
            && other.top < self.bottom
    }

    fn is_inside(&self, outer: &Self) -> bool {
        self.left >= outer.left
            && self.right <= outer.right
            && self.top >= outer.top
            && self.bottom <= outer.bottom
    }
}

/// Height of a label, pixels.
pub(super) const HEIGHT: f64 = 12.0;
/// Width of a character, pixels: an upper bound on the mean of sans-serif fonts at 10 pixels.
const CHAR_WIDTH: f64 = 6.0;
/// Half the width of a point with its rim, pixels.
pub(super) const POINT: f64 = 5.0;
/// Distances of a label from its point, in steps.
const RINGS: usize = 24;
const RING_STEP: f64 = 7.0;
const DIRECTIONS: usize = 16;

/// Returns a label's place for each point, nearest places first; `None` where none is free.
pub(super) fn place(points: &[(f64, f64)], texts: &[&str], plot: &Rect, taken: &[Rect]) -> Vec<Option<Rect>> {
    let of_point =
        |(x, y): &(f64, f64)| Rect { left: x - POINT, top: y - POINT, right: x + POINT, bottom: y + POINT };
    let mut taken: Vec<Rect> = taken.iter().copied().chain(points.iter().map(of_point)).collect();
    let mut places = Vec::new();
    for (point, text) in points.iter().zip(texts) {
        let width = CHAR_WIDTH * text.chars().count() as f64;
        let candidates = (0..RINGS).flat_map(|ring| {
            (0..DIRECTIONS).map(move |direction| {
                // The first one is to the upper right.
                let angle = std::f64::consts::TAU * (direction as f64 - 1.5) / DIRECTIONS as f64;
                let away = POINT + 1.0 + RING_STEP * ring as f64;
                let (dx, dy) = (angle.cos(), angle.sin());
                let (x, y) = (point.0 + dx * (away + 0.5 * width), point.1 + dy * (away + 0.5 * HEIGHT));
                Rect {
                    left: x - 0.5 * width,
                    top: y - 0.5 * HEIGHT,
                    right: x + 0.5 * width,
                    bottom: y + 0.5 * HEIGHT,
                }
            })
        });
        let free = |rect: &Rect| rect.is_inside(plot) && !taken.iter().any(|other| rect.meets(other));
        let found = candidates.into_iter().find(free);
        taken.extend(found);
        places.push(found);
    }
    places
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_lie_on_nothing() {
        let plot = Rect { left: 0.0, top: 0.0, right: 400.0, bottom: 300.0 };
        // Many points in one place, and in the corners.
        let mut points: Vec<(f64, f64)> =
            (0..20).map(|n| (200.0 + f64::from(n % 3), 150.0 + 2.0 * f64::from(n))).collect();
        points.extend([(1.0, 1.0), (399.0, 299.0), (399.0, 1.0)]);
        let texts = vec!["views 12.5%"; points.len()];
        let places = place(&points, &texts, &plot, &[]);
        for (a, place) in places.iter().enumerate() {
            let place = place.expect("there is room for all");
            assert!(place.left >= 0.0 && place.top >= 0.0 && place.right <= 400.0 && place.bottom <= 300.0);
            for other in places[..a].iter().flatten() {
                assert!(
                    place.right <= other.left
                        || other.right <= place.left
                        || place.bottom <= other.top
                        || other.bottom <= place.top,
                    "{place:?} lies on {other:?}"
                );
            }
            for (x, y) in &points {
                let inside = (place.left..place.right).contains(x) && (place.top..place.bottom).contains(y);
                assert!(!inside, "{place:?} lies on a point");
            }
        }
        let full = Rect { left: 0.0, top: 0.0, right: 20.0, bottom: 10.0 };
        assert_eq!(place(&[(10.0, 5.0)], &["long label"], &full, &[]), [None]);
    }
}
