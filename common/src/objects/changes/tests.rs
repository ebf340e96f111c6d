use super::*;

fn thing(id: u64, position: [f64; 3], size: [f64; 3], vector: [f64; 2]) -> Thing {
    let (position_in_world, half) = (DVec3::from(position), DVec3::from(size) * 0.5);
    Thing {
        id,
        n_gaussians: 1,
        position_in_world,
        box_in_world: Aabb { min: position_in_world - half, max: position_in_world + half },
        photo: "a.png".into(),
        vector: vector.to_vec(),
    }
}

fn all(old: Vec<Thing>, new: Vec<Thing>) -> Changes {
    changes(old, new, |_| true, |_| true)
}

const CHAIR: [f64; 2] = [1.0, 0.0];
const TABLE: [f64; 2] = [0.0, 1.0];

/// By hand: one of each kind.
#[test]
fn each_change_is_named() {
    let old = vec![
        thing(1, [0.0; 3], [1.0; 3], CHAIR),
        thing(2, [5.0, 0.0, 0.0], [1.0; 3], TABLE),
        thing(3, [10.0, 0.0, 0.0], [1.0, 2.0, 0.5], CHAIR),
        thing(4, [20.0, 0.0, 0.0], [1.0; 3], TABLE),
    ];
    let new = vec![
        thing(1, [0.0; 3], [1.0; 3], CHAIR),
        thing(5, [5.1, 0.0, 0.0], [1.1; 3], TABLE),
        // It turned: length and width have changed places.
        thing(6, [13.0, 4.0, 0.0], [2.0, 1.0, 0.5], CHAIR),
        thing(7, [20.0, 0.0, 0.0], [1.0; 3], CHAIR),
    ];
    let ids = |things: &[Thing]| things.iter().map(|thing| thing.id).collect::<Vec<_>>();
    let found = all(old, new);
    assert_eq!((found.n_same, found.n_stayed), (1, 1));
    assert_eq!((ids(&found.went), ids(&found.appeared)), (vec![4], vec![7]), "another thing in its place");
    let [moved] = &found.moved[..] else { panic!("{:?}", found.moved) };
    assert_eq!((moved.from.id, moved.to.id, moved.distance), (3, 6, 5.0));
}

/// By hand: a brick pile that stayed or moved, with another vector because its neighbour changed, is still the same
/// thing; orthogonal vectors or another number of Gaussians make it another.
#[test]
fn things_of_one_shape_need_less_likeness() {
    let brick = |id, x: f64, n_gaussians, vector| Thing {
        n_gaussians,
        ..thing(id, [x, 0.0, 0.0], [1.17, 0.95, 0.7], vector)
    };
    let (before, half) = (brick(1, 0.0, 5173, CHAIR), [0.6, 0.8]);
    for (new, expected) in [
        (brick(2, 0.0, 5036, half), (1, 0, 0)),
        (brick(2, 0.01, 5036, half), (1, 0, 0)),
        (brick(2, 0.0, 5036, TABLE), (0, 0, 1)),
        (brick(2, 0.0, 2000, half), (0, 0, 1)),
        (brick(2, 4.0, 5036, [0.8, 0.6]), (0, 1, 0)),
        (brick(2, 4.0, 5036, half), (0, 0, 1)),
        (brick(2, 4.0, 5036, TABLE), (0, 0, 1)),
        (brick(2, 4.0, 2000, [0.8, 0.6]), (0, 0, 1)),
    ] {
        let found = all(vec![before.clone()], vec![new.clone()]);
        assert_eq!((found.n_stayed, found.moved.len(), found.went.len()), expected, "{new:?}");
    }
}

/// By hand: what masks cut off a thing that stayed, with few Gaussians for its size, is no thing of its own; a bottle on
/// it, or the same elsewhere, is.
#[test]
fn sparse_pieces_are_not_compared() {
    let of = |id, position, size, n_gaussians| Thing { n_gaussians, ..thing(id, position, size, CHAIR) };
    let barrow = of(1, [0.0; 3], [1.2, 0.8, 0.3], 3400);
    let leg = |x| of(2, [x, -0.3, -0.2], [0.6, 0.2, 0.3], 66);
    let bottle = of(2, [0.0, 0.0, 0.3], [0.1, 0.1, 0.3], 160);
    for (alone, expected) in [(leg(0.0), (1, 0)), (leg(3.0), (0, 1)), (bottle, (0, 1))] {
        let (with, without) = (vec![barrow.clone(), alone], vec![barrow.clone()]);
        let (went, appeared) = (all(with.clone(), without.clone()), all(without, with));
        assert_eq!((went.n_not_compared, went.went.len()), expected, "{went:?}");
        assert_eq!((appeared.n_not_compared, appeared.appeared.len()), expected, "{appeared:?}");
    }
}

/// Of two similar objects, each matches the nearer place; one of another size matches neither.
#[test]
fn a_thing_is_matched_once_and_to_the_nearest() {
    let at = |id, x: f64, size: f64| thing(id, [x, 0.0, 0.0], [size; 3], CHAIR);
    let found = all(vec![at(1, 0.0, 1.0), at(2, 10.0, 1.0)], vec![at(3, 13.0, 1.0), at(4, 12.0, 3.0)]);
    assert_eq!(found.moved.iter().map(|m| (m.from.id, m.to.id)).collect::<Vec<_>>(), [(2, 3)]);
    assert_eq!((found.went[0].id, found.appeared[0].id), (1, 4));
}

/// Boxes of 1 with margins of 0.05 sqrt(3) are 1.17 wide; half a unit apart they share 0.67 of 1.67 (by hand
/// 0.402).
#[test]
fn overlaps_by_hand() {
    let of = |x: f64, thickness: f64| thing(1, [x, 0.0, 0.0], [1.0, 1.0, thickness], CHAIR).box_in_world;
    assert!((overlap(&of(0.0, 1.0), &of(0.5, 1.0)) - 0.402).abs() < 2e-3);
    assert!((overlap(&of(0.0, 0.0), &of(0.0, 0.0)) - 1.0).abs() < 1e-12, "a flat thing");
    assert_eq!(overlap(&of(0.0, 1.0), &of(3.0, 1.0)), 0.0);
}

/// Both lists end at x = 10, the earlier one at x = 0 as well. By hand: an object that only one can know is neither
/// new nor gone, one across the border that changed a little stays, and none moves to a place unknown before.
#[test]
fn what_one_list_cannot_know_is_not_compared() {
    let at = |id, x: f64| thing(id, [x, 0.0, 0.0], [1.0; 3], CHAIR);
    let old_knows = |of: &Thing| of.box_in_world.min.x >= 0.0 && of.box_in_world.max.x <= 10.0;
    let new_knows = |of: &Thing| of.box_in_world.max.x <= 10.0;
    let old = vec![at(1, 10.0), at(2, 20.0), at(3, 5.0)];
    let new = vec![at(4, 10.1), at(5, -5.0), at(6, 7.0)];
    let found = changes(old, new, new_knows, old_knows);
    assert_eq!((found.n_same, found.n_stayed, found.n_not_compared), (0, 1, 2));
    assert!(found.went.is_empty() && found.appeared.is_empty(), "{found:?}");
    assert_eq!(found.moved.iter().map(|m| (m.from.id, m.to.id)).collect::<Vec<_>>(), [(3, 6)]);
}

/// A hundred similar objects moved by one: each is matched, though each has more candidates than are kept.
#[test]
fn many_alike_things_are_all_matched() {
    let row = |first: u64, shift: f64| -> Vec<Thing> {
        let at = |n: u64| thing(first + n, [10.0 * n as f64 + shift, 0.0, 0.0], [1.0; 3], CHAIR);
        (0..100).map(at).collect()
    };
    let found = all(row(0, 0.0), row(1000, 3.0));
    assert_eq!((found.moved.len(), found.went.len(), found.appeared.len()), (100, 0, 0));
    assert!(found.moved.iter().all(|moved| moved.to.id == moved.from.id + 1000));
    assert!(found.moved.is_sorted_by_key(|moved| moved.from.id));
}

/// Ids are those of answers; records of earlier versions have their digits alone.
#[test]
fn ids_in_json_are_those_of_answers() {
    let lamp = thing(0x2d8c, [0.0; 3], [1.0; 3], CHAIR);
    let mut json = serde_json::to_value(&lamp).expect("numbers and text become JSON");
    assert_eq!(json["id"], "o0000000000002d8c");
    for id in ["o0000000000002d8c", "0000000000002d8c"] {
        json["id"] = id.into();
        let read: Thing = serde_json::from_value(json.clone()).expect("an id");
        assert_eq!(read.id, lamp.id);
    }
}
