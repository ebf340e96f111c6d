//! A bad or missing cell costs that cell only.

use super::*;

fn at_cells(scene: &Published, ids: &[usize], fault: &Fault) -> impl FnMut(&Seen) -> Fault + Send + 'static {
    let shards = ids.iter().map(|cell| scene.manifest.cells[*cell].shards[&Profile::Compact].hash);
    let bad: Vec<String> = shards.map(|hash| format!("/v1/objects/{hash}")).collect();
    let fault = fault.clone();
    move |seen| if bad.contains(&seen.path) { fault.clone() } else { Fault::None }
}

/// Returns the answering cells, with the hash of each shard's content.
pub fn answering(snapshot: &Snapshot) -> Vec<(u32, Hash32)> {
    let hash = |shard: &slag_edge::store::OpenShard| {
        let view = shard.view();
        let positions = (0..view.header.n_gaussians as usize).map(|i| view.position_in_world(i).to_string());
        (shard.cell.cell_id, Hash32::of(positions.collect::<String>().as_bytes()))
    };
    snapshot.shards.iter().map(|shard| hash(shard)).collect()
}

/// Oracle: the same of whole scenes fetched without faults.
fn whole(scene: &Published) -> Vec<(u32, Hash32)> {
    let (_server, robot) = Robot::fetched(scene.clone());
    answering(&robot.snapshot())
}

fn bad_cell(report: &[BadCell], cell_id: u32) -> &BadCell {
    report.iter().find(|bad| bad.cell_id == cell_id).expect("named")
}

#[test]
fn a_bad_cell_costs_that_cell_only() {
    let (first, second) = (Published::new(1, &[0; 3], 40), Published::new(2, &[7, 7, 0], 40));
    let (old, new) = (whole(&first), whole(&second));
    let longer = Fault::Instead(vec![b'x'; 9]);
    for (fault, expected) in [
        (Fault::Status(404), CellFault::Missing),
        (Fault::Status(500), CellFault::Missing),
        (Fault::Corrupt(900), CellFault::Damaged),
        (longer, CellFault::Damaged),
    ] {
        let (server, mut robot) = Robot::started(first.clone());

        // Nothing older is on board: the others answer.
        server.faults(at_cells(&first, &[1], &fault));
        let report = robot.fetch().expect("the others are good");
        assert_eq!((report.n_cells, report.downloaded.n_shards, report.bad_cells.len()), (3, 2, 1));
        assert_eq!(report.bad_cells, [BadCell { cell_id: 1, fault: expected, old: None }], "{fault:?}");
        assert_eq!(answering(&robot.snapshot()), [old[0], old[2]]);
        assert_eq!(robot.snapshot().bad_cells, report.bad_cells);
        server.faults(|_| Fault::None);
        assert_eq!(robot.fetch().expect("heals").bad_cells, []);
        assert_eq!(answering(&robot.snapshot()), old);

        // The old copy of the bad cell answers beside the new ones of the others.
        server.publish(second.clone());
        server.faults(at_cells(&second, &[1], &fault));
        for _ in 0..2 {
            let report = robot.fetch().expect("the others are good");
            let bad = bad_cell(&report.bad_cells, 1);
            assert_eq!((report.generation, report.bad_cells.len(), bad.fault), (2, 1, expected));
            assert_eq!(bad.old.map(|old| old.generation), Some(1), "{fault:?}");
            assert_eq!(answering(&robot.snapshot()), [new[0], old[1], new[2]], "{fault:?}");
        }
        // Another generation, in which it is still bad.
        let third = Published::new(3, &[7, 8, 0], 40);
        server.publish(third.clone());
        server.faults(at_cells(&third, &[1], &fault));
        let report = robot.fetch().expect("the others are good");
        assert_eq!(bad_cell(&report.bad_cells, 1).old.map(|old| old.generation), Some(1), "{fault:?}");
        assert_eq!(answering(&robot.snapshot()), [new[0], old[1], new[2]]);
        server.faults(|_| Fault::None);
        assert_eq!(robot.fetch().expect("heals").bad_cells, []);
        assert_eq!(answering(&robot.snapshot()), whole(&third));
        let manifests = robot.cache.files().list(&robot.cache.dir().join("manifests")).expect("there");
        assert_eq!(manifests, [Hash32::of(&third.listed).to_string()], "the old manifest is gone");

        // A scene without a good cell changes nothing.
        let fourth = Published::new(4, &[9; 3], 40);
        server.publish(fourth.clone());
        server.faults(at_cells(&fourth, &[0, 1, 2], &fault));
        let error = robot.fetch().expect_err("nothing is good");
        assert!(matches!(error, FetchError::Download { .. }), "{error}");
        assert_eq!(answering(&robot.snapshot()), whole(&third));
        server.faults(|_| Fault::None);
        robot.request.radius = 5.0;
        robot.fetch().expect("heals");
    }
}

/// An old copy does not answer for other Gaussians, another frame or another embedding space.
#[test]
fn an_old_copy_answers_only_where_it_belongs() {
    type Edit = fn(&mut slag_common::manifest::Manifest);
    let edits: [(&str, Edit); 3] = [
        ("the cell's box", |manifest| manifest.cells[1].bounds.max.x += 0.5),
        ("the frame", |manifest| manifest.metric = false),
        ("the frame on the earth", |manifest| manifest.geo_reference = None),
    ];
    for (name, edit) in edits {
        let first = Published::new(1, &[0; 3], 40);
        let (server, robot) = Robot::fetched(first.clone());
        let second = Published::new(2, &[0, 7, 0], 40).edited(edit);
        server.publish(second.clone());
        server.faults(at_cells(&second, &[1], &Fault::Status(404)));
        let report = robot.fetch().expect("the others are good");
        assert_eq!(bad_cell(&report.bad_cells, 1).old, None, "{name}");
        let old = answering(&robot.snapshot());
        assert_eq!(old.iter().map(|(id, _)| *id).collect::<Vec<_>>(), [0, 2], "{name}");
    }
}

/// A failing network is no bad cell: the old generation stays, and arrived bytes are kept.
#[test]
fn a_network_that_fails_publishes_nothing() {
    let (first, second) = (Published::new(1, &[0; 3], 40), Published::new(2, &[7; 3], 40));
    let (server, robot) = Robot::fetched(first.clone());
    let before = answering(&robot.snapshot());
    server.publish(second.clone());
    for fault in [Fault::Cut(0), Fault::Status(503)] {
        server.faults(at_cells(&second, &[1], &fault));
        let error = robot.fetch().expect_err("unreachable");
        let is_network = matches!(
            error,
            FetchError::Download {
                failure: DownloadFailure::Cut { .. }
                    | DownloadFailure::Transport(_)
                    | DownloadFailure::Status { .. },
                ..
            }
        );
        assert!(is_network, "{error}");
        assert_eq!(answering(&robot.snapshot()), before);
    }
}

/// The pointer to the generation on board is read strictly.
#[test]
fn a_cell_is_either_on_board_or_bad() {
    let scene = Published::new(1, &[0; 3], 40);
    let (server, robot) = Robot::started(scene.clone());
    server.faults(at_cells(&scene, &[1], &Fault::Status(404)));
    robot.fetch().expect("the others are good");
    let path = robot.cache.current_path();
    let text = fs_err::read_to_string(&path).expect("there");
    let twice = text.replace("\"bad_cells\":[{\"cell_id\":1", "\"bad_cells\":[{\"cell_id\":2");
    assert_ne!(twice, text);
    fs_err::write(&path, twice).expect("written");
    assert!(Snapshot::open(&robot.cache).expect_err("refused").to_string().contains("on board and bad"));
    server.faults(|_| Fault::None);
    assert_eq!(robot.fetch().expect("heals").bad_cells, []);
}
