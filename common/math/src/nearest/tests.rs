use super::*;
use crate::random::Random;

/// The definition, in O(n²).
fn by_sorting(points: &[[f64; 3]], n: usize) -> Vec<Vec<u32>> {
    let distance = |a: [f64; 3], b: [f64; 3]| {
        let [x, y, z] = [0, 1, 2].map(|i| a[i] - b[i]);
        x * x + y * y + z * z
    };
    let row = |i: usize| {
        let others = (0..points.len()).filter(|j| *j != i);
        let mut others: Vec<(f64, u32)> =
            others.map(|j| (distance(points[i], points[j]), j as u32)).collect();
        others.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        others.into_iter().take(n).map(|(_, j)| j).collect()
    };
    (0..points.len()).map(row).collect()
}

#[test]
fn neighbours_are_those_of_sorting() {
    let mut random = Random::new(3);
    // Scattered, on a coarse lattice (many equal distances), in heaps of equal points, on a line, and far away.
    let spread: Vec<[f64; 3]> = (0..1500).map(|_| [0; 3].map(|_| random.between(-1.0, 1.0))).collect();
    let lattice = (0..1500).map(|_| [0; 3].map(|_| random.between(0.0, 6.0).floor())).collect();
    let heaps = spread.iter().map(|p| p.map(|v| (v * 2.0).round())).collect();
    let line = spread.iter().map(|p| [p[0], 0.0, 0.0]).collect();
    let far = spread.iter().map(|p| p.map(|v| 5e6 + (v * 64.0).round() / 1024.0)).collect();
    for points in [spread, lattice, heaps, line, far] {
        for n in [1, 8, 13] {
            let found = Neighbours::new(&points, n);
            for (i, expected) in by_sorting(&points, n).iter().enumerate() {
                assert_eq!(found.of(i as u32), expected, "{i} of {n}");
            }
        }
    }
}

#[test]
fn few_points_have_few_neighbours() {
    assert_eq!(Neighbours::new(&[], 8).rows, []);
    assert_eq!(Neighbours::new(&[[1.0; 3]], 8).of(0), []);
    assert_eq!(Neighbours::new(&[[1.0; 3], [1.0; 3]], 8).of(1), [0]);
    assert_eq!(Neighbours::new(&[[1.0; 3]; 40], 0).of(7), []);
}

#[test]
fn threads_do_not_show() {
    let mut random = Random::new(4);
    let points: Vec<[f64; 3]> =
        (0..20_000).map(|_| [0; 3].map(|_| random.between(0.0, 30.0).floor())).collect();
    let with = |n_threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().expect("threads");
        pool.install(|| Neighbours::new(&points, 8))
    };
    assert_eq!(with(1), with(3));
}

/// Some exports move pruned Gaussians to one place; comparing all their pairs would take 4e10 comparisons.
#[test]
fn a_heap_takes_no_longer_than_spread_points() {
    let found = Neighbours::new(&vec![[1.0; 3]; 200_000], 8);
    assert_eq!(found.of(0), [1, 2, 3, 4, 5, 6, 7, 8]);
    assert_eq!(found.of(199_999), [0, 1, 2, 3, 4, 5, 6, 7]);
}
