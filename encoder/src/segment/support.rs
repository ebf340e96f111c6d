//! How much of a component's outline the boundary model confirms.
//!
//! Components also end where the graph had to stop: across a carpet, or around two things without a visible border.
//! Such a mask shows no single thing.

use crate::masks::NO_REGION;

/// For each component, the mean, over the pairs of pixels across its outline, of the strongest boundary predicted
/// within a pixel: 0 to 1, and 1 without an outline. The photo's edge is no outline. `of_pixel`: each pixel's
/// component, row-major. `boundaries`: `[neighbour][pixel]`, the first to the right, the third below.
pub(super) fn of_outlines(
    of_pixel: &[u32],
    width_px: usize,
    n_components: usize,
    boundaries: &[f32],
) -> Vec<f32> {
    let n_pixels = of_pixel.len();
    let mut sums = vec![(0.0_f32, 0_u32); n_components];
    let [right, below] =
        [0, 2].map(|neighbour| &boundaries[neighbour * n_pixels..(neighbour + 1) * n_pixels]);
    for pixel in 0..n_pixels {
        let column = pixel % width_px;
        let beside = (column + 1 < width_px).then_some((pixel + 1, right));
        let under = (pixel + width_px < n_pixels).then_some((pixel + width_px, below));
        for (other, predicted) in [beside, under].into_iter().flatten() {
            let ends = [of_pixel[pixel], of_pixel[other]];
            if ends[0] == ends[1] {
                continue;
            }
            let near = [
                (column > 0).then(|| pixel - 1),
                (column + 1 < width_px).then_some(pixel + 1),
                pixel.checked_sub(width_px),
                Some(pixel + width_px).filter(|below| *below < n_pixels),
            ];
            let near = near.into_iter().flatten().map(|at| predicted[at]);
            let strongest = near.fold(predicted[pixel], f32::max);
            for component in ends.into_iter().filter(|component| *component != NO_REGION) {
                let (sum, n) = &mut sums[component as usize];
                *sum += strongest;
                *n += 1;
            }
        }
    }
    sums.into_iter().map(|(sum, n)| if n == 0 { 1.0 } else { sum / n as f32 }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: usize = 8;

    /// Component 1 is a square of 4 x 4 px with its upper left pixel at (x, y), component 0 the rest.
    fn square(x: usize, y: usize) -> Vec<u32> {
        let inside = |i: usize| (x..x + 4).contains(&(i % SIDE)) && (y..y + 4).contains(&(i / SIDE));
        (0..SIDE * SIDE).map(|i| u32::from(inside(i))).collect()
    }

    /// Boundaries between different components, where `seen` says so.
    fn boundaries(of_pixel: &[u32], seen: impl Fn(usize, usize) -> bool) -> Vec<f32> {
        let mut boundaries = vec![0.0; 4 * SIDE * SIDE];
        for i in 0..SIDE * SIDE {
            for (neighbour, there, step) in [(0, i % SIDE + 1 < SIDE, 1), (2, i / SIDE + 1 < SIDE, SIDE)] {
                if there && of_pixel[i] != of_pixel[i + step] && seen(i % SIDE, i / SIDE) {
                    boundaries[neighbour * SIDE * SIDE + i] = 1.0;
                }
            }
        }
        boundaries
    }

    fn support(of_pixel: &[u32], boundaries: &[f32]) -> Vec<f32> {
        of_outlines(of_pixel, SIDE, 2, boundaries)
    }

    #[test]
    fn the_share_of_the_outline_that_is_predicted() {
        let of_pixel = square(2, 2);
        assert_eq!(support(&of_pixel, &boundaries(&of_pixel, |_, _| true)), [1.0, 1.0]);
        assert_eq!(support(&of_pixel, &boundaries(&of_pixel, |_, _| false)), [0.0, 0.0]);
        // Without its right side, whose pairs begin in column 5; none of these is beside a pair of another side of its
        // kind.
        let three_sides = support(&of_pixel, &boundaries(&of_pixel, |x, y| x != 5 || !(2..6).contains(&y)));
        // The bottom's last pair begins in that column, too, but its neighbour is predicted.
        assert_eq!(three_sides, [0.75, 0.75]);
    }

    #[test]
    fn the_edge_of_the_photo_is_no_outline() {
        // Two sides lie on the photo's edge.
        let of_pixel = square(4, 4);
        assert_eq!(support(&of_pixel, &boundaries(&of_pixel, |_, _| true)), [1.0, 1.0]);
        assert_eq!(support(&[0; SIDE * SIDE], &vec![0.0; 4 * SIDE * SIDE])[0], 1.0);
    }

    #[test]
    fn a_boundary_may_be_a_pixel_off_but_not_two() {
        let [of_pixel, shifted, far] = [square(2, 2), square(3, 2), square(4, 2)];
        let [near, far] = [shifted, far].map(|other| support(&of_pixel, &boundaries(&other, |_, _| true))[1]);
        assert_eq!(near, 1.0);
        assert!(far < 0.5, "{far}");
    }

    #[test]
    fn pixels_without_a_component_have_no_outline_of_their_own() {
        let mut of_pixel = square(2, 2);
        of_pixel[0] = NO_REGION;
        let found = support(&of_pixel, &boundaries(&of_pixel, |_, _| true));
        assert_eq!(found, [1.0, 1.0]);
    }
}
