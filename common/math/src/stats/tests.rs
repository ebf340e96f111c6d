use super::*;
use crate::random::Random;

fn tens() -> [f64; 10] {
    [70.0, 0.0, 30.0, 90.0, 10.0, 60.0, 20.0, 80.0, 50.0, 40.0]
}

/// By hand, for 10 values.
#[test]
fn each_rank_has_its_place() {
    let expected = [
        (0, [0.0, 0.0, 0.0]),
        (100, [0.0, 10.0, 0.0]),
        (500, [40.0, 50.0, 40.0]),
        (900, [80.0, 90.0, 80.0]),
        (990, [90.0, 90.0, 80.0]),
        (1000, [90.0, 90.0, 90.0]),
    ];
    for (per_mille, expected) in expected {
        let at = |rank| quantile(&mut tens(), per_mille, rank).expect("has values");
        assert_eq!([Rank::Nearest, Rank::After, Rank::Between].map(at), expected, "{per_mille}");
    }
    assert_eq!((median(&mut tens()), median(&mut tens()[..9])), (Some(50.0), Some(50.0)));
    assert_eq!((median::<f32>(&mut []), median(&mut [7u64])), (None, Some(7)));
    assert_eq!(median(&mut [f32::NAN, 1.0, -0.0]), Some(1.0));
}

/// Oracle: the sorted values.
#[test]
fn quantiles_are_places_of_the_sorted_values() {
    let mut random = Random::new(3);
    for n in [1usize, 2, 3, 50, 51, 1000, 1001] {
        let values: Vec<f32> = (0..n).map(|_| (random.bits() % 40) as f32 - 20.0).collect();
        let mut sorted = values.clone();
        sorted.sort_by(f32::total_cmp);
        let found = |per_mille, rank| quantile(&mut values.clone(), per_mille, rank).expect("has values");
        assert_eq!(found(999, Rank::After), sorted[((n as f64 * 0.999) as usize).min(n - 1)], "{n}");
        assert_eq!(found(980, Rank::Between), sorted[(n - 1) * 49 / 50], "{n}");
        assert_eq!(found(990, Rank::Nearest), sorted[(n as f64 * 0.99).ceil() as usize - 1], "{n}");
        let cut = (n - 1) / 50;
        assert_eq!(trimmed_range(&mut values.clone(), 0.02), Some((sorted[cut], sorted[n - 1 - cut])), "{n}");
    }
}

/// By hand.
#[test]
fn a_trimmed_range_leaves_out_both_ends() {
    assert_eq!(trimmed_range(&mut tens(), 0.0), Some((0.0, 90.0)));
    assert_eq!(trimmed_range(&mut tens(), 0.25), Some((20.0, 70.0)));
    assert_eq!(trimmed_range(&mut tens()[..3], 0.5), Some((30.0, 30.0)), "of 0, 30 and 70");
    assert_eq!(trimmed_range::<f64>(&mut [], 0.1), None);
}
