//! Connection limits, in all and per peer, with some connections reserved for health checks.

use std::collections::{HashMap, VecDeque};
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::oneshot::{Receiver, Sender, channel};

/// Paths open to connections beyond the limits.
pub(crate) const HEALTH_PATHS: [&str; 3] = ["/healthz", "/readyz", "/metrics"];

/// Marks requests on a connection beyond the limits: only [`HEALTH_PATHS`] are answered.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Reserved;

pub(crate) struct Permits {
    n_connections: usize,
    n_per_peer: usize,
    n_reserved: usize,
    open: Mutex<Open>,
}

#[derive(Default)]
struct Open {
    n_ordinary: usize,
    by_peer: HashMap<IpAddr, usize>,
    reserved: VecDeque<ReservedPlace>,
    n_numbered: u64,
}

struct ReservedPlace {
    number: u64,
    peer: Option<IpAddr>,
    _end: Sender<()>,
}

/// A place for a connection, until dropped.
pub(crate) struct Permit {
    permits: Arc<Permits>,
    peer: Option<IpAddr>,
    /// Number and end of a connection beyond the limits.
    reserved: Option<(u64, Receiver<()>)>,
}

impl Permits {
    pub fn new(n_connections: usize, n_per_peer: usize, n_reserved: usize) -> Arc<Self> {
        Arc::new(Self { n_connections, n_per_peer, n_reserved: n_reserved.max(1), open: Mutex::default() })
    }

    fn open(&self) -> MutexGuard<'_, Open> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Admits a connection: as an ordinary one within the limits, else for health checks only. If these are too many,
    /// the oldest of the same peer ends, or else the oldest of all.
    pub fn admit(self: &Arc<Self>, peer: Option<IpAddr>) -> Permit {
        let peer = peer.map(network);
        let mut open = self.open();
        let of_peer = peer.and_then(|peer| open.by_peer.get(&peer).copied()).unwrap_or(0);
        if open.n_ordinary < self.n_connections && of_peer < self.n_per_peer {
            open.n_ordinary += 1;
            if let Some(peer) = peer {
                open.by_peer.insert(peer, of_peer + 1);
            }
            return Permit { permits: Arc::clone(self), peer, reserved: None };
        }
        if open.reserved.len() >= self.n_reserved {
            let oldest = open.reserved.iter().position(|place| place.peer == peer).unwrap_or(0);
            open.reserved.remove(oldest);
        }
        open.n_numbered += 1;
        let (number, (end, ended)) = (open.n_numbered, channel());
        open.reserved.push_back(ReservedPlace { number, peer, _end: end });
        Permit { permits: Arc::clone(self), peer, reserved: Some((number, ended)) }
    }
}

impl Permit {
    pub fn is_reserved(&self) -> bool {
        self.reserved.is_some()
    }

    /// Resolves when the connection must make room for another.
    pub async fn ended(&mut self) {
        match &mut self.reserved {
            // An error is the signal: the other end was dropped.
            Some((_, ended)) => drop(ended.await),
            None => std::future::pending().await,
        }
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        let mut open = self.permits.open();
        if let Some((number, _)) = &self.reserved {
            open.reserved.retain(|place| place.number != *number);
            return;
        }
        open.n_ordinary -= 1;
        if let Some(peer) = self.peer
            && let Some(n) = open.by_peer.get_mut(&peer)
        {
            *n -= 1;
            if *n == 0 {
                open.by_peer.remove(&peer);
            }
        }
    }
}

/// Returns the peer: an IPv4 address, or the /64 network of an IPv6 host.
fn network(peer: IpAddr) -> IpAddr {
    match peer.to_canonical() {
        IpAddr::V6(address) => {
            let mut segments = address.segments();
            segments[4..].fill(0);
            IpAddr::V6(Ipv6Addr::from(segments))
        }
        peer => peer,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn peer(text: &str) -> Option<IpAddr> {
        Some(text.parse().expect("an address"))
    }

    #[tokio::test]
    async fn peers_have_their_share_and_the_rest_is_for_health() {
        let permits = Permits::new(4, 2, 2);
        let (a, b) = (peer("10.0.0.1"), peer("10.0.0.2"));
        let first = [permits.admit(a), permits.admit(a)];
        assert!(first.iter().all(|permit| !permit.is_reserved()));
        assert!(permits.admit(a).is_reserved(), "beyond the peer's share");
        let local = [permits.admit(None), permits.admit(b)];
        assert!(local.iter().all(|permit| !permit.is_reserved()));
        assert!(permits.admit(b).is_reserved(), "beyond the total");
        // Reserved ones make room: the oldest of the same peer first.
        let (mut of_a, mut of_b, mut later) = (permits.admit(a), permits.admit(b), permits.admit(b));
        of_b.ended().await;
        let quiet = tokio::time::timeout(std::time::Duration::from_millis(5), async {
            tokio::select! { () = of_a.ended() => {}, () = later.ended() => {} }
        });
        assert!(quiet.await.is_err());
        let _other = permits.admit(peer("10.0.0.3"));
        of_a.ended().await;
        drop((first, local, of_a, of_b, later));
        assert!(!permits.admit(a).is_reserved());
        assert!(permits.open().by_peer.is_empty() && permits.open().n_ordinary == 0);
    }

    #[test]
    fn a_network_is_one_peer() {
        let of = |text: &str| network(text.parse().expect("an address")).to_string();
        assert_eq!(of("2001:db8:1:2:3:4:5:6"), "2001:db8:1:2::");
        assert_eq!(of("::ffff:10.0.0.1"), "10.0.0.1");
        assert_eq!(of("10.0.0.1"), "10.0.0.1");
    }
}
