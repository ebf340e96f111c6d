//! A fleet whose queue, bucket, coordinator and workers are hosts of their own, with a network between them that
//! delays and loses packets and is cut: `hosts.py`.

use std::io::{BufRead, BufReader, Read, Write};
use std::process::{Child, ChildStdout, Command, Stdio};

use super::support::*;
use slag_tests::*;

/// Seconds for which a worker is cut off: the queue waits a third of it for work that it handed out.
const CUT_SECS: u64 = 3;

/// The hosts, which are gone when this is dropped.
struct Hosts {
    network: Child,
    answers: BufReader<ChildStdout>,
    prefix: String,
}

/// The way to and from a host: seconds for each direction, share of packets lost, whether nothing comes through.
struct Way(f64, f64, bool);

impl Hosts {
    /// Makes `n` hosts, or says why this machine cannot.
    fn new(n: usize) -> Result<Self, String> {
        let prefix = format!("slag{}h", std::process::id());
        let mut command = Command::new(python_with("tests/fleet"));
        command.arg(root().join("tests/fleet/hosts.py")).args([&prefix, &n.to_string()]);
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut network = command.spawn().expect("starts");
        let answers = BufReader::new(network.stdout.take().expect("piped"));
        let mut hosts = Self { network, answers, prefix };
        if hosts.answer() == "ready" {
            return Ok(hosts);
        }
        let mut errors = String::new();
        hosts.network.stderr.take().expect("piped").read_to_string(&mut errors).expect("text");
        Err(errors.lines().last().unwrap_or_default().to_owned())
    }

    fn answer(&mut self) -> String {
        let mut line = String::new();
        self.answers.read_line(&mut line).expect("text");
        line.trim().to_owned()
    }

    /// Sets the way to a host; returns the packets carried and lost so far.
    fn set(&mut self, host: usize, Way(secs, loss, is_cut): Way) -> [u64; 2] {
        let stdin = self.network.stdin.as_mut().expect("piped");
        writeln!(stdin, "{host} {secs} {loss} {}", u8::from(is_cut)).expect("it listens");
        let answer = self.answer();
        let mut counts = answer.split(' ').map(|count| count.parse().expect("a number"));
        [(); 2].map(|()| counts.next().expect("two numbers"))
    }

    /// Returns a command that runs on a host.
    fn on(&self, host: usize, command: &Command) -> Command {
        let mut there = Command::new("ip");
        there.args(["netns", "exec", &format!("{}{host}", self.prefix)]);
        there.arg(command.get_program()).args(command.get_args());
        there.envs(command.get_envs().map(|(name, value)| (name, value.expect("set"))));
        there
    }

    /// Runs a line of Python on a host and returns what it prints, or `None` if it fails.
    fn python(&self, host: usize, line: &str) -> Option<String> {
        let mut command = Command::new(python_with("tests/fleet"));
        command.args(["-c", &format!("from urllib.request import *; {line}")]);
        let output = self.on(host, &command).output().expect("starts");
        output.status.success().then(|| String::from_utf8_lossy(&output.stdout).trim().to_owned())
    }
}

impl Drop for Hosts {
    fn drop(&mut self) {
        drop(self.network.stdin.take());
        let _ = self.network.wait();
    }
}

/// Real TCP, packet by packet: all ways are slow and lose packets, one worker is cut off for longer than the queue
/// waits for it, and the bytes are those of one process.
#[nightly("starts servers, and fails parts of a fleet")]
#[test]
fn slow_lossy_and_cut_networks_between_hosts_give_the_same_bytes() {
    let [queue, bucket, coordinator_host, first, second] = [0, 1, 2, 3, 4];
    let mut hosts = match Hosts::new(5) {
        Ok(hosts) => hosts,
        Err(reason) => return println!("not run: hosts need Linux's namespaces and devices: {reason}"),
    };
    let scene = Scene::new();
    let server = |name: &str| Command::new(python_with("tests/fleet").with_file_name(name));
    let mut nats = server("nats-server");
    nats.args(["--jetstream", "--store_dir", text(&scene.path("nats"))]);
    let _queue = Running::start_quiet(&mut hosts.on(queue, &nats));
    let mut moto = server("moto_server");
    moto.args(["--host", "0.0.0.0", "--port", "5000"]);
    let _bucket = Running::start_quiet(&mut hosts.on(bucket, &moto));
    let made = "urlopen(Request('http://10.77.0.2:5000/scenes', method='PUT'))";
    wait_until("a bucket", || hosts.python(bucket, made).is_some());
    let listed = "http://10.77.0.2:5000/scenes?list-type=2&prefix=room/views/";
    let count = format!("print(urlopen('{listed}').read().count(b'<Key>'))");
    let n_views = |hosts: &Hosts| -> usize {
        hosts.python(bucket, &count).expect("it answers").parse().expect("a number")
    };
    for host in [queue, bucket, coordinator_host, first, second] {
        hosts.set(host, Way(0.002, 0.01, false));
    }

    let start = |hosts: &Hosts, host: usize, mut command: Command| {
        let settings = [
            ("AWS_ENDPOINT", "http://10.77.0.2:5000"),
            ("AWS_ALLOW_HTTP", "true"),
            ("AWS_ACCESS_KEY_ID", "robot"),
            ("AWS_SECRET_ACCESS_KEY", "secret"),
            ("AWS_REGION", "us-east-1"),
        ];
        command.envs(settings).args(["--fleet", "nats://10.77.0.1:4222", "--ack-wait", "1"]);
        Running::start(hosts.on(host, command.args(["--max-deliver", "100"])).stdin(Stdio::null()))
    };
    let mut encode = scene.encode("store");
    encode.args(["--blobs", "s3://scenes/room"]);
    let coordinator = start(&hosts, coordinator_host, encode);
    let work = |hosts: &Hosts, host| {
        let mut worker = worker("s3://scenes/room");
        worker.args(["--threads", "1"]);
        start(hosts, host, worker)
    };
    let workers = [first, second].map(|host| work(&hosts, host));
    wait_until("a first view", || n_views(&hosts) > 0);
    let [n_carried, n_lost] = hosts.set(first, Way(0.0, 0.0, true));
    assert!(n_lost > 0 && n_carried > n_lost, "{n_carried} carried, {n_lost} lost");
    assert!(n_views(&hosts) < N_VIEWS, "the cut came too late");
    std::thread::sleep(std::time::Duration::from_secs(CUT_SECS));
    let [_, n_lost_since] = hosts.set(first, Way(0.005, 0.02, false));
    assert!(n_lost_since > n_lost, "nothing was cut");
    let summary = coordinator.json();
    assert_eq!((&summary["n_views"], &summary["skipped_views"]), (&N_VIEWS.into(), &serde_json::json!([])));
    for worker in workers {
        worker.json();
    }
    scene.assert_same("store");
}
