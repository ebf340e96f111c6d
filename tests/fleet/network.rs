//! The network between a worker and the queue, as a proxy on loopback: delay, loss and partitions. As with TCP, a
//! lost packet becomes a wait for its retransmission, and a partition silence until it ends.

use super::*;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex, PoisonError};

/// Least retransmission timeout of TCP (RFC 6298 as in Linux).
const RETRANSMISSION: Duration = Duration::from_millis(200);

#[derive(Clone, Copy, Debug, Default)]
pub struct Weather {
    /// Delay of each piece of data.
    pub delay: Duration,
    /// Share of pieces that are lost and sent again.
    pub loss: f64,
    /// Whether nothing passes.
    pub is_cut: bool,
}

/// A separate network between a port of this machine and another.
pub struct Network {
    pub port: u16,
    weather: Arc<Mutex<Weather>>,
}

impl Network {
    /// `upstream`: a port; `seed`: of the losses.
    pub fn to(upstream: u16, seed: u64) -> Self {
        let listener = TcpListener::bind(("127.0.0.1", 0)).expect("binds");
        let port = listener.local_addr().expect("an address").port();
        let weather = Arc::new(Mutex::new(Weather::default()));
        let shared = Arc::clone(&weather);
        std::thread::spawn(move || {
            let mut random = Random::new(seed);
            for near in listener.incoming().flatten() {
                wait_for_calm(&shared);
                // A server that is away refuses; the peer sees its connection closed.
                let Ok(far) = TcpStream::connect(("127.0.0.1", upstream)) else { continue };
                let copies = near.try_clone().and_then(|copy| Ok((copy, far.try_clone()?)));
                let Ok((near_copy, far_copy)) = copies else { continue };
                for (from, to) in [(near, far_copy), (far, near_copy)] {
                    let (weather, random) = (Arc::clone(&shared), Random::new(random.bits()));
                    std::thread::spawn(move || carry(from, to, &weather, random));
                }
            }
        });
        Self { port, weather }
    }

    pub fn set(&self, weather: Weather) {
        *self.weather.lock().unwrap_or_else(PoisonError::into_inner) = weather;
    }
}

/// Waits for the end of a partition.
fn wait_for_calm(weather: &Mutex<Weather>) -> Weather {
    loop {
        let now = *weather.lock().unwrap_or_else(PoisonError::into_inner);
        if !now.is_cut {
            return now;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Copies data one way until an end is closed.
fn carry(mut from: TcpStream, mut to: TcpStream, weather: &Mutex<Weather>, mut random: Random) {
    let mut piece = vec![0; 1400];
    while let Ok(n @ 1..) = from.read(&mut piece) {
        let Weather { delay, loss, .. } = wait_for_calm(weather);
        let lost = random.unit() < loss;
        std::thread::sleep(delay + if lost { RETRANSMISSION } else { Duration::ZERO });
        if to.write_all(&piece[..n]).is_err() {
            break;
        }
    }
    // Ends the other direction, which may have ended before.
    let _ = to.shutdown(std::net::Shutdown::Both);
    let _ = from.shutdown(std::net::Shutdown::Both);
}
