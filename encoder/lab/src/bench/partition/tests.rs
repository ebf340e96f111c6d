use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::time::Instant;

use super::link::{Link, LinkSpeed};
use super::report::{FetchFigures, StoreFigures};
use super::site::Site;
use super::*;
use crate::bench::machine::Machine;

/// 50 kB at 1 Mbit/s take 0.4 s, a request 50 ms before; two connections share the rate.
#[test]
fn links_limit_rate_and_delay_requests() {
    let service = TcpListener::bind("127.0.0.1:0").expect("binds");
    let url = format!("http://{}", service.local_addr().expect("an address"));
    let serving = std::thread::spawn(move || {
        for _ in 0..2 {
            let (mut robot, _) = service.accept().expect("a robot");
            std::thread::spawn(move || {
                let mut request = [0; 5];
                robot.read_exact(&mut request).expect("a request");
                robot.write_all(&vec![7; 50_000]).expect("an answer");
            });
        }
    });
    let link = Link::open(&url, LinkSpeed { bits_per_s: 1e6, delay_ms: 50 }).expect("opens");
    let address = link.url.trim_start_matches("http://").to_owned();
    let start = Instant::now();
    let robots: Vec<_> = (0..2)
        .map(|_| {
            let address = address.clone();
            std::thread::spawn(move || {
                let mut stream = TcpStream::connect(address).expect("connects");
                stream.write_all(b"hello").expect("asks");
                let mut answer = Vec::new();
                stream.read_to_end(&mut answer).expect("an answer");
                assert_eq!(answer, vec![7; 50_000]);
            })
        })
        .collect();
    robots.into_iter().for_each(|robot| robot.join().expect("is answered"));
    let seconds = start.elapsed().as_secs_f64();
    // Upper bound: a loaded machine is slow, but not this slow.
    assert!((0.85..10.0).contains(&seconds), "{seconds}");
    serving.join().expect("serves");
}

#[test]
fn sites_fill_their_square_and_circles_lie_within() {
    let site = Site::new(5_000, 8, 40.0);
    assert_eq!((site.scene.len(), site.embeddings.len()), (5_000, 40_000));
    let mut quarters = [0; 4];
    for mean in &site.scene.means_in_world {
        assert!((0.0..=40.0).contains(&mean.x) && (0.0..=40.0).contains(&mean.y), "{mean}");
        quarters[usize::from(mean.x > 20.0) + 2 * usize::from(mean.y > 20.0)] += 1;
    }
    assert_eq!(quarters, [1_250; 4], "a thing in each quarter");
    for (radius, least, most) in [(5.0, 5.0, 35.0), (20.0, 20.0, 20.0), (90.0, 20.0, 20.0)] {
        for place in site.places(7, radius) {
            for v in [place.x, place.y] {
                assert!((least..=most).contains(&v), "{radius}: {place}");
            }
        }
    }
    let middle = site.places(1, 90.0)[0];
    assert_eq!(site.n_within(middle, 90.0), 5_000);
    let share = site.n_within(middle, 10.0) as f64 / 5_000.0;
    let expected = std::f64::consts::PI * 100.0 / 1_600.0;
    assert!((share / expected - 1.0).abs() < 0.1, "{share} {expected}");
}

#[test]
fn reports_name_the_best_width_for_each_radius() {
    let fetch = |cell_width_m: f64, radius_m: f64, bytes: f64, seconds: f64| FetchFigures {
        cell_width_m,
        radius_m,
        n_cells: 4.0,
        bytes,
        share_within: 0.5,
        seconds,
    };
    let store = |cell_width_m| StoreFigures {
        cell_width_m,
        n_cells: 9,
        bytes_per_gaussian: 6.5,
        manifest_bytes: 1234,
    };
    let report = PartitionReport {
        machine: Machine::here(),
        n_gaussians: 1_000_000,
        site_width_m: 400.0,
        link: LinkSpeed { bits_per_s: 2e7, delay_ms: 20 },
        n_places: 5,
        load_1min: None,
        stores: vec![store(10.0), store(50.0)],
        fetches: vec![
            fetch(10.0, 10.0, 1e4, 0.3),
            fetch(10.0, 100.0, 9e5, 0.9),
            fetch(50.0, 10.0, 5e4, 0.2),
            fetch(50.0, 100.0, 8e5, 0.8),
        ],
    };
    let dir = tempfile::tempdir().expect("a folder");
    report.write(dir.path()).expect("writes");
    let read = |name: &str| fs_err::read_to_string(dir.path().join(name)).expect("reads");
    let table = read("partition.txt");
    assert!(table.contains("fewest bytes: cells of 10 m for radius 10 m, 50 m for radius 100 m"), "{table}");
    assert!(table.contains("least time: cells of 50 m for radius 10 m, 50 m for radius 100 m"), "{table}");
    for name in ["bytes.svg", "seconds.svg"] {
        assert_eq!(read(name).matches("<polyline").count(), 2, "a line a width");
    }
}
