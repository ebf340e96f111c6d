use proptest::prelude::*;

use super::*;

fn scene(means: &[[f64; 3]], scale: f32) -> Gaussians {
    let scales = vec![[scale, 2.0 * scale, 0.0]; means.len()];
    Gaussians { scales, ..Gaussians::balls(means.iter().map(|m| DVec3::from(*m)).collect(), scale) }
}

proptest! {
    #[test]
    fn every_usable_gaussian_lies_in_one_cell_within_the_limits(
        mut means in prop::collection::vec(prop::array::uniform3(-100.0..100.0f64), 1..2000),
        max_gaussians in 1usize..300, max_width in 5.0..50.0f64, repeat in 0usize..400,
    ) {
        means.extend(std::iter::repeat_n(means[0], repeat));
        means.push([f64::NAN, 0.0, 0.0]);
        let scene = scene(&means, 0.5);
        let limits = CellLimits { max_width: Some(max_width), ..CellLimits::by_count(max_gaussians) };
        let result = split(&scene, limits);
        prop_assert_eq!((result.n_rejected, result.n_for_precision), (1, 0));
        let mut seen = vec![0; means.len()];
        for (id, cell) in result.cells.iter().enumerate() {
            prop_assert!(cell.gaussians.len() <= max_gaussians);
            let narrow = cell.mean_bounds.size().max_element() <= max_width;
            prop_assert!(narrow || cell.gaussians.len() <= MIN_GAUSSIANS_TO_NARROW);
            for (local, g) in cell.gaussians.iter().enumerate() {
                seen[*g as usize] += 1;
                prop_assert_eq!(result.cell_of_gaussian[*g as usize], id as u32);
                prop_assert_eq!(result.local_of_gaussian[*g as usize], local as u32);
                let mean = scene.means_in_world[*g as usize];
                let half = DVec3::new(1.5, 3.0, 0.0);
                prop_assert!((mean - half).cmpge(cell.bounds.min - 1e-6).all() && (mean + half).cmple(cell.bounds.max + 1e-6).all());
            }
        }
        prop_assert!(seen[..means.len() - 1].iter().all(|n| *n == 1));
        prop_assert_eq!(result.cell_of_gaussian[means.len() - 1], NO_CELL);
    }
}

/// Coordinates whose neighbouring doubles are farther apart than a cell may be wide do not recurse for ever.
#[test]
fn cells_narrower_than_coordinates_resolve_end() {
    let large = 1e18f64;
    let means: Vec<[f64; 3]> = (0..2 * MIN_GAUSSIANS_TO_NARROW)
        .map(|i| [if i % 2 == 0 { large } else { large.next_up() }, 0.0, 0.0])
        .collect();
    let limits = CellLimits { max_width: Some(25.0), ..CellLimits::by_count(usize::MAX) };
    let result = split(&scene(&means, 0.5), limits);
    let sizes: Vec<usize> = result.cells.iter().map(|cell| cell.gaussians.len()).collect();
    assert_eq!(sizes, [MIN_GAUSSIANS_TO_NARROW; 2]);
}

/// The caller can refuse: all cells that precision asks for are counted.
#[test]
fn errors_finer_than_coordinates_are_counted() {
    let means: Vec<[f64; 3]> = (0..100).map(|i| [f64::from(i) * 1e9, 0.0, 0.0]).collect();
    let position_error = PositionError::Within(1e-9);
    let result = split(&scene(&means, 0.5), CellLimits { position_error, ..CellLimits::by_count(1000) });
    assert_eq!((result.cells.len(), result.n_for_precision), (100, 100));
}

/// A hundred thousand Gaussians of a sky do not decide how exact the few thousand of a chair are, nor where the
/// nearest are; ordinary cells, whose sizes differ less, keep their 10th percentile.
#[test]
fn a_sky_costs_the_chair_no_precision() {
    let (n_near, n_far) = (3_500, 60_000);
    let place = |i: usize| DVec3::new((i % 17) as f64, (i % 19) as f64, (i % 23) as f64) / 30.0;
    let near = (0..n_near).map(place);
    let means: Vec<DVec3> =
        near.chain((0..n_far).map(|i| place(i).normalize_or(DVec3::X) * 1000.0)).collect();
    let mut scene = Gaussians::balls(means, 15.0);
    scene.scales[..n_near].fill([0.01; 3]);
    let result = split(&scene, CellLimits::by_count(65_536));
    for g in 0..n_near {
        let cell = &result.cells[result.cell_of_gaussian[g] as usize];
        let error = cell.grid.step.into_iter().fold(0.0, f64::max) / 2.0;
        assert!(error <= 0.01 / 4.0, "{error}");
    }
    let all: Vec<u32> = (0..scene.len() as u32).collect();
    let error = PositionError::OfSize.of_part(&scene, &all);
    assert!((error - f64::from(0.01f32) / 4.0).abs() < 1e-9, "{error}");
    // Sizes of 1 to 7 belong to one scene.
    let ordinary: Vec<f32> = (0..60_000).map(|i| 1.0 + 6.0 * (i as f32 / 6_000.0).min(1.0)).collect();
    assert_eq!(of_small(ordinary), 7.0);
    // Points without a size say nothing of it, nor do few Gaussians.
    assert_eq!(of_small([vec![0.0; 600], vec![5.0; 60_000]].concat()), 5.0);
    assert_eq!(of_small([vec![0.01; 512], vec![5.0; 60_000]].concat()), 5.0);
    assert_eq!(of_small(vec![1.0; 9]), 1.0);
}

/// A few huge Gaussians count in their cell's box like the largest of the others, which count whole.
#[test]
fn huge_gaussians_leave_the_boxes_of_cells_small() {
    let means: Vec<[f64; 3]> = (0..4000).map(|i| [f64::from(i) / 100.0, 0.0, 0.0]).collect();
    let mut huge = scene(&means, 0.1);
    let ordinary = split(&huge, CellLimits::by_count(1000));
    (0..4).for_each(|k| huge.scales[500 + 1000 * k] = [490.0; 3]);
    let result = split(&huge, CellLimits::by_count(1000));
    assert_eq!((result.cells.len(), ordinary.cells.len()), (4, 4));
    for (cell, before) in result.cells.iter().zip(&ordinary.cells) {
        assert_eq!((&cell.gaussians, cell.mean_bounds), (&before.gaussians, before.mean_bounds));
        let width = cell.mean_bounds.size().max_element();
        assert!(cell.bounds.size().max_element() <= width + 1.3, "{:?}", cell.bounds);
        assert!(before.bounds.size().max_element() > width + 0.5, "their own extents stay");
    }
    // Of a hundred, one is no stray.
    let mut few = scene(&means[..100], 0.1);
    few.scales[7] = [490.0; 3];
    let bounds = split(&few, CellLimits::by_count(1000)).cells[0].bounds;
    assert!(bounds.size().min_element() >= 6.0 * 490.0, "{bounds:?}");
}

#[test]
fn morton_interleaves_bits() {
    assert_eq!(spread_bits(0b1011), 0b1_000_001_001);
    assert_eq!(spread_bits((1 << 21) - 1).count_ones(), 21);
}
