use super::*;

/// A path of two flat stretches, a step between them and an outlier vertex; worked out by hand.
#[test]
fn a_step_separates_and_a_small_component_joins_its_neighbour() {
    let heights = [0.0_f32, 0.1, 0.2, 0.3, 5.0, 5.1, 5.2, 9.0];
    let mut edges: Vec<(f32, u32, u32)> =
        (0..7).map(|i| ((heights[i + 1] - heights[i]).abs(), i as u32, i as u32 + 1)).collect();
    edges.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut components = Components::new(8, 2.0);
    for (weight, a, b) in &edges {
        components.join_if_similar(*a, *b, *weight);
    }
    assert_eq!(components.number(0..8).of_item, [0, 0, 0, 0, 1, 1, 1, 2]);
    edges.iter().for_each(|(_, a, b)| components.join_if_small(*a, *b, 2));
    let numbering = components.number(0..8);
    assert_eq!((numbering.of_item, numbering.sizes), (vec![0, 0, 0, 0, 1, 1, 1, 1], vec![4, 4]));
}

/// Oracle: each edge in turn. Weights repeat, so that blocks have equal ones.
#[test]
fn all_at_once_is_as_one_by_one() {
    let mut random = crate::random::Random::new(17);
    for (n, n_edges, scale) in [(40, 200, 0.3_f32), (5_000, 400_000, 0.02), (200_000, 900_000, 1.5)] {
        let mut edge = || {
            let a = random.below(n);
            // Mostly near, so that components are regions and not one.
            let b = (a + 1 + random.below(6)) % n;
            ((random.below(1000) as f32) / 1000.0, a as u32, b as u32)
        };
        let mut edges: Vec<(f32, u32, u32)> = (0..n_edges).map(|_| edge()).collect();
        edges.sort_by(|a, b| a.partial_cmp(b).expect("no NaN"));
        let (mut one_by_one, mut at_once) = (Components::new(n, scale), Components::new(n, scale));
        for (weight, a, b) in &edges {
            one_by_one.join_if_similar(*a, *b, *weight);
        }
        at_once.join_all_similar(&edges, |(weight, a, b)| (*a, *b, *weight));
        let numbered = |components: &mut Components| components.number(0..n as u32);
        let expected = numbered(&mut one_by_one);
        assert!(expected.sizes.len() > n / 100 && expected.sizes.len() < n, "{}", expected.sizes.len());
        assert!(numbered(&mut at_once) == expected, "{n} vertices");
        edges.iter().for_each(|(_, a, b)| one_by_one.join_if_small(*a, *b, 30));
        at_once.join_all_small(&edges, |(weight, a, b)| (*a, *b, *weight), 30);
        assert!(numbered(&mut at_once) == numbered(&mut one_by_one), "{n} vertices, small ones joined");
    }
}

#[test]
fn large_components_accept_less() {
    let mut components = Components::new(12, 3.0);
    assert!(components.join_if_similar(10, 11, 1.0));
    (0..9).for_each(|i| assert!(components.join_if_similar(i, i + 1, 0.0)));
    assert!(!components.join_if_similar(9, 10, 1.0));
    let root = components.root(0);
    assert_eq!(components.sizes()[root as usize], 10);
}
