//! Power cuts: encode and fetch are killed at random moments and restarted.

use super::*;

use slag_tests::*;

/// Runs a command and returns its output, or kills it after a while.
fn run_or_kill(command: &mut Command, after: Duration) -> Option<Vec<u8>> {
    // The output fits in the pipe's buffer, so it need not be read meanwhile.
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().expect("starts");
    let start = Instant::now();
    while start.elapsed() < after {
        if let Some(status) = child.try_wait().expect("waits") {
            assert!(status.success(), "{command:?}: {status}");
            return Some(child.wait_with_output().expect("waits").stdout);
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    child.kill().expect("kill -9");
    child.wait().expect("waits");
    None
}

/// A closed reader of a program's messages (`| head`) does not stop its work or change its results.
#[test]
fn programs_go_on_when_nobody_reads_what_they_say() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (store, cache) = (dir.path().join("store"), dir.path().join("cache"));
    let deaf = |command: &mut Command| {
        let piped = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = piped.spawn().expect("starts");
        drop(child.stderr.take());
        child.wait_with_output().expect("waits")
    };
    let encode = deaf(encode_quickly(&generated(&ROOM), &store).args(["--models", "colours"]));
    assert!(encode.status.success() && store.join("manifest").exists(), "{encode:?}");
    let service = Service::start(&mut encoder(&["serve", "--store", text(&store)]));
    assert!(deaf(&mut fetch(&service.url, &cache)).status.success());
    let query = ["query", "blue", "--models", "colours", "--cache", text(&cache)];
    let answers = deaf(&mut edge(&query));
    assert!(answers.status.success() && !answers.stdout.is_empty(), "{answers:?}");
    assert_eq!(deaf(&mut encoder(&["store", "ls", "--store", text(&cache)])).status.code(), Some(1));
    for program in [&mut encoder(&["completions", "bash"]), &mut edge(&["completions", "bash"])] {
        let mut child = program.stdout(Stdio::piped()).spawn().expect("starts");
        drop(child.stdout.take());
        assert!(child.wait().expect("waits").success(), "{program:?}");
    }
}

/// Under `nohup` an encode outlives its terminal; otherwise it stops as at ctrl-c.
#[test]
fn a_hangup_that_is_ignored_stops_nothing() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    for (trap, expected) in [("trap '' HUP; ", 0), ("", 130)] {
        let store = dir.path().join(format!("store{expected}"));
        let encode = encode_quickly(&generated(&ROOM), &store);
        let line = format!("{trap}exec \"$0\" \"$@\"");
        let mut command = Command::new("sh");
        command.args(["-c", &line]).arg(encode.get_program()).args(encode.get_args());
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("starts");
        while !store.join("job").exists() {
            assert!(child.try_wait().expect("waits").is_none(), "it ended before a view");
            std::thread::sleep(Duration::from_millis(1));
        }
        if !trap.is_empty() {
            refused(&mut encode_quickly(&generated(&ROOM), &store), "another slag-encoder");
        }
        let kill = Command::new("kill").args(["-HUP", &child.id().to_string()]).status();
        assert!(kill.expect("runs").success());
        assert_eq!(child.wait().expect("waits").code(), Some(expected));
    }
}

#[test]
fn killed_encodes_resume_and_show_nothing_half() {
    let n_wanted = trials(4, 100);
    let dir = tempfile::tempdir().expect("a temporary folder");
    let room = generated(&ROOM);
    let whole = dir.path().join("whole");
    let start = Instant::now();
    run(&mut encode_quickly(&room, &whole));
    let encode_time = start.elapsed();
    let expected = content(&whole);

    // Kills in the first half of the time, so that several hit each store. A finished store is replaced by a new one.
    let mut random = Random::new(7);
    let (mut n_kills, mut n_stores, mut n_resumed) = (0, 0, 0);
    while n_kills < n_wanted {
        let store = dir.path().join(format!("store{n_stores}"));
        let printed = loop {
            let enough = n_kills == n_wanted;
            let after = if enough { Duration::MAX } else { encode_time.mul_f64(0.5 * random.unit()) };
            match run_or_kill(&mut encode_quickly(&room, &store), after) {
                Some(printed) => break printed,
                None => n_kills += 1,
            }
            if store.join("manifest").exists() {
                assert_eq!(content(&store), expected, "a visible manifest is a whole one");
            }
        };
        let summary: Value = serde_json::from_slice(&printed).expect("a summary");
        n_resumed += summary["n_views_resumed"].as_u64().expect("a count");
        assert_eq!(content(&store), expected);
        n_stores += 1;
    }
    assert!(n_resumed > 0, "no killed encode was resumed");
    println!("encode: {n_kills} kills, {n_stores} stores, {n_resumed} views not done twice");
}

/// Kills a robot with generation 1 on board while it fetches generation 2, whose shards all differ.
#[test]
fn killed_fetches_leave_the_old_or_the_new_generation() {
    let n_wanted = trials(12, 2000);
    let dir = tempfile::tempdir().expect("a temporary folder");
    let (first, second) = (dir.path().join("first"), dir.path().join("second"));
    // The same key and scene, one generation on.
    encoded_into(&first, &ROOM, &SITE);
    copy_dir(&first, &second);
    run(encode_quickly(&generated(&ROOM), &second).args(SITE).args(["--compact-error", "0.4"]));
    let stores =
        [&first, &second].map(|store| Service::start(&mut encoder(&["serve", "--store", text(store)])));
    let ask = |cache: &Path| {
        let answers = run_json(&mut edge(&["query", "blue", "--models", "colours", "--cache", text(cache)]));
        (answers["generation"].as_u64().expect("a number"), answers["answers"].clone())
    };
    let (old, new) = (dir.path().join("old"), dir.path().join("new"));
    run(&mut fetch(&stores[0].url, &old));
    copy_dir(&old, &new);
    let start = Instant::now();
    run(&mut fetch(&stores[1].url, &new));
    let fetch_time = start.elapsed();
    let expected = [ask(&old), ask(&new)];
    assert_eq!(expected.each_ref().map(|(generation, _)| *generation), [1, 2]);
    assert!(expected.iter().all(|(_, answers)| !answers.as_array().expect("answers").is_empty()));

    let mut random = Random::new(11);
    let (mut n_kills, mut n_runs, mut n_new) = (0, 0, 0);
    while n_kills < n_wanted {
        let cache = dir.path().join(format!("cache{n_runs}"));
        copy_dir(&old, &cache);
        let is_killed =
            run_or_kill(&mut fetch(&stores[1].url, &cache), fetch_time.mul_f64(random.unit())).is_none();
        let found = ask(&cache);
        assert!(expected.contains(&found), "run {n_runs}: generation {} answers otherwise", found.0);
        assert!(is_killed || found.0 == 2, "run {n_runs}: a fetch that ended well is there");
        n_kills += usize::from(is_killed);
        n_new += u64::from(is_killed && found.0 == 2);
        // Often enough to show that leftovers of a kill do no harm.
        if n_runs % 4 == 0 {
            run(&mut fetch(&stores[1].url, &cache));
            assert_eq!(ask(&cache), expected[1], "run {n_runs}: the next fetch");
        }
        fs_err::remove_dir_all(&cache).expect("there");
        n_runs += 1;
    }
    println!(
        "fetch: {n_kills} kills in {n_runs} runs, {n_new} of them after the new generation was in place"
    );
}
