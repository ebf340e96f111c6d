use super::*;
use crate::codebook::basis::{ScoreMetric, TextBank};
use slag_math::random::Random;

/// Oracle: farthest-point picks over all Gaussians in float64, each vector decoded in full. The basis keeps all
/// components, so the last pick leaves less than the first.
#[test]
fn the_farthest_get_centroids_first() {
    let (n, dim, n_more) = (400, 6, 12);
    let mut random = Random::new(3);
    let vectors: Vec<f32> = (0..n)
        .flat_map(|at| {
            let spread = if at % 20 == 7 { 1.0 } else { 0.02 };
            let mut v = [1.0f32, 0.0, 0.0, 0.0, 0.0, 0.0].map(|c| c + spread * random.normal() as f32);
            let length = dot(&v, &v).sqrt();
            v.iter_mut().for_each(|c| *c /= length);
            v
        })
        .collect();
    let rows = Rows::all(&vectors, dim);
    let basis = Basis::fit(rows, &ScoreMetric::new(dim, &TextBank::directions(dim)), 0.0, dim);
    let m = basis.n_components;
    let points = basis.components(rows);
    let mut found = Clusters { codes: vec![0; n], centres: vec![0.0; m] };
    separate(rows, &basis, Rows::all(&points, m), &mut found, n_more, 0.0);

    let decode = |c: &[f32]| -> Vec<f64> {
        let of =
            |i: usize| (0..m).map(|k| f64::from(c[k]) * f64::from(basis.basis[k * dim + i])).sum::<f64>();
        (0..dim).map(|i| basis.mean[i].to_f64() + of(i)).collect()
    };
    let distance = |at: usize, centre: &[f64]| {
        let own = &vectors[at * dim..][..dim];
        own.iter().zip(centre).map(|(e, c)| (f64::from(*e) - c).powi(2)).sum::<f64>().sqrt()
    };
    let first = decode(&vec![0.0; m]);
    let mut expected: Vec<(u32, f64)> = (0..n).map(|at| (0, distance(at, &first))).collect();
    let before = expected.iter().map(|(_, d)| *d).fold(0.0, f64::max);
    for number in 1..=n_more as u32 {
        let farthest = (0..n).max_by(|a, b| expected[*a].1.total_cmp(&expected[*b].1)).expect("some");
        let centre = decode(&points[farthest * m..][..m]);
        for (at, (code, nearest)) in expected.iter_mut().enumerate() {
            let d = distance(at, &centre);
            if d < *nearest {
                (*code, *nearest) = (number, d);
            }
        }
    }
    let after = expected.iter().map(|(_, d)| *d).fold(0.0, f64::max);
    assert!(after < before / 2.0, "{before} -> {after}");
    assert_eq!(found.centres.len(), (1 + n_more) * m);
    // Clusters are numbered by their first Gaussian.
    let mut numbers = std::collections::HashMap::new();
    for (at, (code, _)) in expected.iter().enumerate() {
        assert_eq!(*numbers.entry(*code).or_insert(found.codes[at]), found.codes[at], "Gaussian {at}");
    }
    assert_eq!(numbers.len(), 1 + n_more);
}
