//! Changes between a robot's generations, whatever happens in between.

use super::*;

use slag_api::changes::{ChangedThing, ChangesReply};
use slag_edge::query::{ChangesRequest, QueryError};
use slag_edge::score::Budget;
use slag_edge::store::history;

use super::scene::TestThing;

fn thing(id: u64, x: f64, axis: usize) -> TestThing {
    TestThing { cell_id: (x / 10.0) as u32, id, x, axis }
}

/// Seven cells; the robot at x = 5 holds three.
fn published(generation: u64, things: &[TestThing]) -> Published {
    Published::new(generation, &[generation; 7], 20).with_things(things)
}

fn before() -> Published {
    published(1, &[thing(1, 2.0, 0), thing(2, 12.0, 1), thing(3, 25.0, 2), thing(9, 55.0, 0)])
}

/// By hand: 1 stays, 2 goes, 3 moves to x = 5, 5 appears. Beyond the robot's cells, 9 goes and 10 appears.
fn after() -> Published {
    published(2, &[thing(1, 2.0, 0), thing(4, 5.0, 2), thing(5, 18.0, 3), thing(10, 45.0, 3)])
}

fn changes(robot: &Robot, from: Option<u64>) -> Result<ChangesReply, QueryError> {
    let engine = Engine::new(robot.cache.clone(), text_service());
    engine.reload().expect("a whole generation");
    engine.changes(&ChangesRequest { from, ..ChangesRequest::default() }, &Budget::default())
}

/// Returns the ids that appeared, that went, and the earlier and later ids of those that moved.
fn ids(reply: &ChangesReply) -> (Vec<u64>, Vec<u64>, Vec<(u64, u64)>) {
    let id = |text: &str| u64::from_str_radix(&text[1..], 16).expect("hex digits");
    let of = |things: &[ChangedThing]| things.iter().map(|thing| id(&thing.id)).collect();
    let moved = reply.moved.iter().map(|moved| (id(&moved.from.id), id(&moved.to.id))).collect();
    (of(&reply.appeared), of(&reply.went), moved)
}

fn assert_changed(robot: &Robot, context: &str) {
    let reply = changes(robot, None).unwrap_or_else(|e| panic!("{context}: {e}"));
    assert_eq!(ids(&reply), (vec![5], vec![2], vec![(3, 4)]), "{context}: {reply:?}");
    assert_eq!((reply.n_same, reply.moved[0].distance), (1, 20.0), "{context}");
}

#[test]
fn changes_are_told_where_both_generations_are_known() {
    let (server, mut robot) = Robot::fetched(before());
    let reply = changes(&robot, None).expect("a reply");
    assert!(reply.none.is_some_and(|none| none.kind == "no-earlier-generation"));
    server.publish(after());
    robot.fetch().expect("works");
    assert_changed(&robot, "after the fetch");
    // After it leaves, what it knew of both generations is still compared; what it knew of one alone is not.
    robot.go(55.0, 14.0, &after(), 4..7);
    robot.fetch().expect("works");
    assert_eq!(cells(&robot.snapshot()), [4, 5, 6], "the cells left behind are gone");
    assert_changed(&robot, "from elsewhere");
    assert_eq!(changes(&robot, Some(1)).expect("a reply").n_not_compared, 1, "10");
    // Generations that it never had are refused by name.
    let refused = changes(&robot, Some(0)).expect_err("refused");
    assert_eq!(refused.kind(), "no-such-generation");
    assert_eq!(refused.to_string(), "generation 0 is not remembered; those that are: 1, 2");
    assert_eq!(changes(&robot, Some(2)).expect_err("refused").kind(), "bad-parameter");
    // Vectors of other models do not compare.
    let path = history::path(&robot.cache, 1);
    let record = history::read(&robot.cache, &after().manifest.scene, 1).expect("there");
    let mut of_others = record.clone();
    of_others.encoder_id = Hash32::of(b"other models");
    fs_err::write(&path, of_others.to_bytes()).expect("writes");
    assert_eq!(changes(&robot, Some(1)).expect_err("refused").kind(), "encoders-differ");
    fs_err::write(&path, record.to_bytes()).expect("writes");
    // A damaged record counts as missing.
    let mut bytes = fs_err::read(&path).expect("there");
    bytes[200] ^= 1;
    fs_err::write(&path, bytes).expect("writes");
    let reply = changes(&robot, None).expect("a reply");
    assert!(reply.none.is_some_and(|none| none.kind == "no-earlier-generation"));
}

/// The earlier generation alone had the places of 1, 2 and 3 on board, the later one alone that of 10.
#[test]
fn what_is_left_behind_has_not_gone() {
    let (server, mut robot) = Robot::fetched(before());
    server.publish(after());
    robot.go(55.0, 14.0, &after(), 4..7);
    robot.fetch().expect("works");
    let reply = changes(&robot, None).expect("a reply");
    assert_eq!(ids(&reply), (vec![], vec![], vec![]), "{reply:?}");
    assert_eq!(reply.n_not_compared, 4, "{reply:?}");
}

/// With the same splat, another outline is neither an added nor a removed thing.
#[test]
fn where_the_splat_is_the_same_nothing_changed() {
    let of = |generation, things: &[TestThing]| Published::new(generation, &[0; 7], 20).with_things(things);
    let (server, robot) = Robot::fetched(of(1, &[thing(1, 2.0, 0), thing(2, 12.0, 1)]));
    server.publish(of(2, &[thing(1, 2.0, 0), thing(5, 18.0, 3)]));
    robot.fetch().expect("works");
    let reply = changes(&robot, None).expect("a reply");
    assert_eq!(ids(&reply), (vec![], vec![], vec![]), "{reply:?}");
    assert_eq!((reply.n_same, reply.n_not_compared), (1, 2), "{reply:?}");
}

/// The records are written before removals: whenever the power fails, they are there after the next fetch.
#[test]
fn a_power_cut_loses_no_history() {
    let dir = tempfile::tempdir().expect("temporary folder");
    let server = Server::start(before());
    let files = Arc::new(SimFiles::default());
    Robot::on_sim(dir.path(), Arc::clone(&files), &server.url()).fetch().expect("works");
    let start = files.fork(None, 0);
    server.publish(after());
    let fetch = |files: &Arc<SimFiles>| {
        let robot = Robot::on_sim(dir.path(), Arc::clone(files), &server.url());
        (robot.fetch(), robot)
    };
    let whole = Arc::new(start.fork(None, 0));
    fetch(&whole).0.expect("works");
    for step in 1..=whole.n_steps() {
        for seed in step * 100..step * 100 + 3 {
            let cut = Arc::new(start.fork(Some(step), seed));
            let _ = fetch(&cut);
            let (fetched, robot) = fetch(&Arc::new(cut.after_power_cut(seed)));
            fetched.unwrap_or_else(|e| panic!("step {step} seed {seed}: {e}"));
            assert_changed(&robot, &format!("step {step} seed {seed}"));
        }
    }
}

#[test]
fn history_is_bounded_and_of_one_scene() {
    let (server, mut robot) = Robot::fetched(before());
    for generation in 2..=12 {
        server.publish(published(generation, &[thing(1, 2.0, 0), thing(generation, 12.0, 1)]));
        robot.fetch().expect("works");
    }
    assert_eq!(history::generations(&robot.cache), (4..=11).collect::<Vec<u64>>());
    let reply = changes(&robot, Some(7)).expect("a reply");
    assert_eq!((reply.n_same, reply.n_stayed), (1, 1), "{reply:?}");
    let newest = changes(&robot, None).expect("a reply").from.map(|from| from.generation);
    assert_eq!(newest, Some(11), "without a number the newest before");
    // Another scene: its generations are not these.
    server.publish(published(13, &[thing(1, 2.0, 0)]).edited(|manifest| manifest.scene = "house".into()));
    robot.request.scene = Some("house".into());
    robot.fetch().expect("works");
    assert_eq!(changes(&robot, None).expect("a reply").generations, [13]);
}
