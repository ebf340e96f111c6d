//! A slow link: passes bytes between a robot and a store's service on loopback at a limited rate and with a delay.

use std::io::{self, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Bytes that are passed on at a time.
const CHUNK: usize = 8 << 10;
/// Pause between looks for a new connection.
const POLL: Duration = Duration::from_millis(1);
/// A connection without traffic for this long ends.
const SILENCE: Duration = Duration::from_secs(30);

/// Rate and delay of a link.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct LinkSpeed {
    /// Bits per second towards the robot, all connections together.
    pub bits_per_s: f64,
    /// Delay of a request, in milliseconds: a round trip.
    pub delay_ms: u64,
}

/// A link that is open until it is dropped.
pub(super) struct Link {
    /// Address for the robot.
    pub(super) url: String,
    is_closed: Arc<AtomicBool>,
    accepting: Option<JoinHandle<()>>,
}

/// The moment at which the link is free again.
type Free = Arc<Mutex<Instant>>;

impl Link {
    /// Opens a link to `http://ADDRESS`.
    pub(super) fn open(url: &str, speed: LinkSpeed) -> io::Result<Self> {
        let address = url.trim_start_matches("http://").trim_end_matches('/');
        let address: SocketAddr = address.parse().map_err(io::Error::other)?;
        let listener = TcpListener::bind("127.0.0.1:0")?;
        listener.set_nonblocking(true)?;
        let url = format!("http://{}", listener.local_addr()?);
        let is_closed = Arc::new(AtomicBool::new(false));
        let (until, free) = (is_closed.clone(), Arc::new(Mutex::new(Instant::now())));
        let accepting = std::thread::spawn(move || {
            while !until.load(Ordering::Relaxed) {
                match listener.accept() {
                    // A connection that cannot be passed on is closed; the robot reports it.
                    Ok((robot, _)) => drop(pass(robot, address, speed, &free)),
                    Err(_) => std::thread::sleep(POLL),
                }
            }
        });
        Ok(Self { url, is_closed, accepting: Some(accepting) })
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        self.is_closed.store(true, Ordering::Relaxed);
        if let Some(accepting) = self.accepting.take() {
            let _ = accepting.join();
        }
    }
}

/// Starts to pass bytes between a robot's connection and a new one to the service.
fn pass(robot: TcpStream, address: SocketAddr, speed: LinkSpeed, free: &Free) -> io::Result<()> {
    robot.set_nonblocking(false)?;
    let service = TcpStream::connect(address)?;
    for stream in [&robot, &service] {
        stream.set_read_timeout(Some(SILENCE))?;
        stream.set_nodelay(true)?;
    }
    let (mut up_from, mut up_to) = (robot.try_clone()?, service.try_clone()?);
    let delay = Duration::from_millis(speed.delay_ms);
    std::thread::spawn(move || copy(&mut up_from, &mut up_to, |_| std::thread::sleep(delay)));
    let (mut down_from, mut down_to, free) = (service, robot, free.clone());
    std::thread::spawn(move || {
        copy(&mut down_from, &mut down_to, |n| {
            let takes = Duration::from_secs_f64(n as f64 * 8.0 / speed.bits_per_s);
            let done = {
                let mut free = free.lock().unwrap_or_else(PoisonError::into_inner);
                *free = (*free).max(Instant::now()) + takes;
                *free
            };
            std::thread::sleep(done.saturating_duration_since(Instant::now()));
        });
    });
    Ok(())
}

/// Copies until one side ends; `wait` is called with the length of each piece before it is passed on.
fn copy(from: &mut TcpStream, to: &mut TcpStream, wait: impl Fn(usize)) {
    let mut piece = vec![0; CHUNK];
    while let Ok(n) = from.read(&mut piece) {
        if n == 0 {
            break;
        }
        wait(n);
        if to.write_all(&piece[..n]).is_err() {
            break;
        }
    }
    let _ = to.shutdown(Shutdown::Write);
}
