//! A moving robot: cells on board around it, and the number of fetches.

use super::*;

use slag_edge::fetch::follow::{Decision, Follower, follow};
use slag_edge::fetch::last_position;

use super::scene::bounds;

const N_CELLS: usize = 30;

/// Follows a position at a second; returns whether it fetched.
fn drive(robot: &mut Robot, follower: &mut Follower, second: u64, x: f64) -> bool {
    let (now, at) = (Duration::from_secs(second), DVec3::new(x, 0.0, 105.0));
    if follower.decide(now, Some(at)) != Decision::Fetch {
        return false;
    }
    robot.request.at = Some(Position::World(at));
    robot.request.radius = follower.fetch_radius();
    follower.fetched(now, robot.fetch().expect("works").centre_in_world);
    true
}

fn settings() -> FollowSettings {
    let min_interval = Duration::from_secs(1);
    FollowSettings { radius: 12.0, margin: 6.0, min_interval, refresh: None, ..FollowSettings::default() }
}

#[test]
fn going_to_and_fro_over_an_edge_costs_one_fetch() {
    let (server, mut robot) = Robot::started(Published::new(1, &[0; N_CELLS], 20));
    // Cells end at multiples of ten. For the first fetch the critical edge is also at 100 + 18 = 118: there every
    // step changes the set of cells in reach.
    for edge in [100.0, 102.0] {
        let mut follower = Follower::new(settings());
        let x = |second: u64| edge + if second.is_multiple_of(2) { -2.5 } else { 0.4 };
        server.take_seen();
        let fetched_at = (0..200).filter(|second| drive(&mut robot, &mut follower, *second, x(*second)));
        assert_eq!(fetched_at.collect::<Vec<_>>(), [0], "edge at {edge}");
        let seen = server.take_seen();
        assert_eq!(seen.iter().filter(|seen| seen.path.contains("timestamp")).count(), 1, "{seen:?}");
    }
}

/// Oracle: the cells' boxes, by brute force, at every position.
#[test]
fn a_drive_always_has_what_is_around() {
    let scene = Published::new(1, &[0; N_CELLS], 20);
    let (server, mut robot) = Robot::started(scene.clone());
    // Room for six cells: 12 + 6 to either side reach five or six at most.
    let budget_bytes = scene.bytes(0..6);
    robot.request.max_bytes = Some(budget_bytes);
    let mut follower = Follower::new(settings());
    let mut n_fetches = 0;
    for step in 0..500u32 {
        let x = 5.0 + f64::from(step) * 0.5;
        let at = DVec3::new(x, 0.0, 105.0);
        if drive(&mut robot, &mut follower, step.into(), x) {
            n_fetches += 1;
            let on_board: u64 = robot.shards().iter().map(|hash| scene.objects[hash].len() as u64).sum();
            assert!(on_board <= budget_bytes, "{on_board}");
        }
        let on_board = cells(&robot.snapshot());
        for cell_id in 0..N_CELLS as u32 {
            if bounds(cell_id).distance_to(at) <= 12.0 {
                assert!(on_board.contains(&cell_id), "cell {cell_id} at {x}");
            }
        }
    }
    // 250 m, and a new centre after more than 3: 3.5 at this pace.
    assert_eq!(n_fetches, 72);
    let objects = server.take_objects();
    assert_eq!(objects.len(), (0..N_CELLS as u32).filter(|id| bounds(*id).min.x <= 254.5 + 18.0).count());
}

/// The loop over real sockets: network faults, no network, a new generation, and the end.
#[test]
fn following_survives_the_loss_of_the_network() {
    let scene = Published::new(1, &[0; N_CELLS], 20);
    let (server, mut robot) = Robot::started(scene.clone());
    robot.limits.attempts = 1;
    let settings = FollowSettings {
        radius: 4.0,
        margin: 4.0,
        min_interval: Duration::from_millis(1),
        backoff: Backoff { first: Duration::from_millis(5), longest: Duration::from_millis(20) },
        refresh: None,
    };
    let place = |x: f64| Position::World(DVec3::new(x, 0.0, 105.0));
    let earth = |x: f64| {
        let point = DVec3::new(x, 0.0, 105.0);
        let geo = scene.manifest.geo_reference.expect("given").geographic_from_world(point);
        let (latitude_deg, longitude_deg) = (geo.latitude_deg, geo.longitude_deg);
        Position::Geographic { latitude_deg, longitude_deg, height_m: None }
    };
    let (following, cancel) = (Following::default(), AtomicBool::new(false));
    following.post(place(5.0));
    let mut outcomes = Vec::new();
    let mut step = 0;
    let result = follow(
        &robot.cache,
        &robot.request,
        settings,
        &following,
        FollowEnvironment {
            fetch: &mut |request| {
                let robot = Robot { request: request.clone(), cache: robot.cache.clone(), ..robot.clone() };
                robot.fetch()
            },
            report: &mut |outcome| {
                outcomes.push(outcome.as_ref().map(|report| report.n_cells).map_err(|e| e.to_string()));
                step += 1;
                match step {
                    // On board; the robot moves on, and the network is down.
                    1 => {
                        assert_holds(&robot.snapshot(), &scene, 0..2);
                        server.faults(|_| Fault::Cut(0));
                        following.post(place(35.0));
                    }
                    // Three failures: the last generation stays. Then the network is back.
                    2 | 3 => assert_holds(&robot.snapshot(), &scene, 0..2),
                    4 => server.faults(|_| Fault::None),
                    // The same place in another form costs nothing; a distant geographic position does.
                    5 => {
                        following.post(earth(35.5));
                        following.post(earth(75.0));
                    }
                    _ => following.close(),
                }
            },
            random: &|| 0.5,
            cancel: &cancel,
        },
    );
    result.expect("the last position is served");
    assert!(outcomes[1..4].iter().all(Result::is_err), "{outcomes:?}");
    assert_eq!((outcomes.len(), &outcomes[4], &outcomes[5]), (6, &Ok(3), &Ok(3)), "{outcomes:?}");
    assert_holds(&robot.snapshot(), &scene, 6..9);
    let status = following.status();
    assert_eq!((status.n_fetches, status.n_failures, status.last_error), (3, 3, None));
    assert_eq!(robot.snapshot().shards.len(), 3);
    assert_eq!(scene.hash(6, Profile::Compact), robot.snapshot().current.cells[0].hash);
}

/// Without trust it retries when the robot moves or a root is added; the pause after failures would be an hour.
#[test]
fn a_follower_waits_for_trust_and_not_for_time() {
    let scene = Published::new(1, &[0; 3], 20);
    let (_server, mut robot) = Robot::started(scene.clone());
    robot.request.trust_first = false;
    let pause = Duration::from_secs(3600);
    let settings = FollowSettings {
        min_interval: Duration::ZERO,
        backoff: Backoff { first: pause, longest: pause },
        ..FollowSettings::default()
    };
    let following = Following::default();
    following.post(at(5.0));
    let mut n_outcomes = 0;
    let mut report = |outcome: &Result<FetchReport, FetchError>| {
        n_outcomes += 1;
        match (n_outcomes, outcome) {
            (1, Err(FetchError::NoTrust { .. })) => following.post(at(6.0)),
            (2, Err(FetchError::NoTrust { .. })) => {
                let root = FirstRoot::Bytes(scene.first_root());
                assert!(robot.add_root(&root, false).expect("added").is_new);
            }
            (3, Ok(_)) => following.close(),
            (n, outcome) => panic!("{n}: {:?}", outcome.as_ref().err()),
        }
    };
    let (fetch, cancel) = (&mut |_: &FetchRequest| robot.fetch(), &AtomicBool::new(false));
    let environment = FollowEnvironment { fetch, report: &mut report, random: &|| 0.5, cancel };
    follow(&robot.cache, &robot.request, settings, &following, environment).expect("served");
    assert_eq!(last_position(&robot.cache), Some(at(5.0)), "where it begins when it is started again");
}

/// Positions end while a fetch is due and fails: the error is returned.
#[test]
fn the_end_tells_whether_the_last_position_was_served() {
    let (server, mut robot) = Robot::started(Published::new(1, &[0; 3], 20));
    robot.limits.attempts = 1;
    server.faults(|_| Fault::Status(404));
    let (following, cancel) = (Following::default(), AtomicBool::new(false));
    let run = |following: &Following, cancel: &AtomicBool| {
        follow(
            &robot.cache,
            &robot.request,
            FollowSettings::default(),
            following,
            FollowEnvironment { fetch: &mut |_| robot.fetch(), report: &mut |_| {}, random: &|| 0.5, cancel },
        )
    };
    following.close();
    run(&following, &cancel).expect("no position, no fetch");
    following.post(Position::World(DVec3::ZERO));
    assert!(matches!(run(&following, &cancel), Err(FetchError::Tuf(TufError::Missing { .. }))));
    cancel.store(true, std::sync::atomic::Ordering::Relaxed);
    assert!(matches!(run(&following, &cancel), Err(FetchError::Cancelled)));
}
