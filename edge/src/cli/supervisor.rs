//! Tells systemd that the service is ready, alive or stopping: the protocol of sd_notify(3), a few words to a Unix socket.

use std::ffi::OsString;
use std::time::Duration;

/// Pulses in the time after which the supervisor takes a silent service for dead; systemd advises two.
const PULSES_PER_TIMEOUT: u32 = 3;

/// A supervisor that started this process and listens to it.
pub struct Supervisor {
    #[cfg(unix)]
    socket: std::os::unix::net::UnixDatagram,
    #[cfg(unix)]
    address: std::os::unix::net::SocketAddr,
    /// Time between pulses, if it expects any.
    pulse: Option<Duration>,
}

impl Supervisor {
    /// Returns the supervisor that the environment names (`NOTIFY_SOCKET`, `WATCHDOG_USEC`, `WATCHDOG_PID`), if any.
    #[cfg(unix)]
    pub fn of(variable: &dyn Fn(&str) -> Option<OsString>) -> Option<Self> {
        let named = variable("NOTIFY_SOCKET").filter(|name| !name.is_empty())?;
        let (socket, address) = match std::os::unix::net::UnixDatagram::unbound()
            .and_then(|socket| Ok((socket, address(&named)?)))
        {
            Ok(opened) => opened,
            Err(error) => {
                tracing::warn!("NOTIFY_SOCKET is {named:?}, which cannot be written to: {error}");
                return None;
            }
        };
        let number = |name| variable(name)?.to_str()?.parse::<u64>().ok();
        let is_for_us = number("WATCHDOG_PID").is_none_or(|pid| pid == u64::from(std::process::id()));
        let timeout = number("WATCHDOG_USEC").filter(|_| is_for_us).map(Duration::from_micros);
        let pulse = timeout.map(|timeout| timeout / PULSES_PER_TIMEOUT).filter(|pulse| !pulse.is_zero());
        Some(Self { socket, address, pulse })
    }

    /// Returns the supervisor that the environment names: there is none on this system.
    #[cfg(not(unix))]
    pub fn of(_: &dyn Fn(&str) -> Option<OsString>) -> Option<Self> {
        None
    }

    /// Says that requests are answered from now on.
    pub fn ready(&self) {
        self.send("READY=1");
    }

    /// Says that the service is about to end.
    pub fn stopping(&self) {
        self.send("STOPPING=1");
    }

    /// Says for ever that the service is alive, as long as `is_alive` says so in time.
    pub async fn pulse<A: Future<Output = bool>>(&self, is_alive: impl Fn() -> A) {
        let Some(pulse) = self.pulse else { return };
        loop {
            match tokio::time::timeout(pulse, is_alive()).await {
                Ok(true) => self.send("WATCHDOG=1"),
                _ => tracing::error!("the service does not answer itself; its supervisor may end it"),
            }
            tokio::time::sleep(pulse).await;
        }
    }

    #[cfg(unix)]
    fn send(&self, word: &str) {
        if let Err(error) = self.socket.send_to_addr(word.as_bytes(), &self.address) {
            tracing::warn!("the supervisor was not told {word}: {error}");
        }
    }

    #[cfg(not(unix))]
    fn send(&self, _: &str) {}
}

/// Returns the address of a path, or of a name in Linux's abstract space, which begins with an @.
#[cfg(unix)]
fn address(named: &std::ffi::OsStr) -> std::io::Result<std::os::unix::net::SocketAddr> {
    use std::os::unix::ffi::OsStrExt;
    use std::os::unix::net::SocketAddr;

    match named.as_bytes().split_first() {
        #[cfg(target_os = "linux")]
        Some((b'@', name)) => <SocketAddr as std::os::linux::net::SocketAddrExt>::from_abstract_name(name),
        _ => SocketAddr::from_pathname(named),
    }
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use std::os::linux::net::SocketAddrExt;
    use std::os::unix::net::{SocketAddr, UnixDatagram};

    use super::*;

    fn heard(socket: &UnixDatagram) -> String {
        let mut bytes = [0; 64];
        let n = socket.recv(&mut bytes).expect("a word");
        String::from_utf8_lossy(&bytes[..n]).into_owned()
    }

    fn of(pairs: &[(&str, String)]) -> Option<Supervisor> {
        Supervisor::of(&|name| Some(pairs.iter().find(|(known, _)| *known == name)?.1.clone().into()))
    }

    #[tokio::test]
    async fn a_supervisor_hears_of_start_life_and_stop() {
        let name = format!("slag-supervisor-{}", std::process::id());
        let abstract_name = SocketAddr::from_abstract_name(&name).expect("a name");
        let socket = UnixDatagram::bind_addr(&abstract_name).expect("binds");
        let named = ("NOTIFY_SOCKET", format!("@{name}"));
        let supervisor = of(&[named.clone(), ("WATCHDOG_USEC", "3000".into())]).expect("named");
        supervisor.ready();
        supervisor.stopping();
        assert_eq!([heard(&socket), heard(&socket)], ["READY=1", "STOPPING=1"]);
        // A service that does not answer itself is silent.
        let n_asked = std::cell::Cell::new(0);
        let check = || {
            n_asked.set(n_asked.get() + 1);
            std::future::ready(n_asked.get() == 3)
        };
        tokio::select! {
            () = supervisor.pulse(check) => panic!("it ends only with the service"),
            () = async { while n_asked.get() < 4 { tokio::task::yield_now().await } } => {}
        }
        assert_eq!(heard(&socket), "WATCHDOG=1");
        socket.set_nonblocking(true).expect("set");
        assert!(socket.recv(&mut [0; 8]).is_err(), "one answer of all was yes");
        // Without a watchdog, or with another process's, there is no pulse.
        of(std::slice::from_ref(&named))
            .expect("named")
            .pulse(|| -> std::future::Ready<bool> { panic!("not asked") })
            .await;
        let of_another = [named, ("WATCHDOG_USEC", "3000".into()), ("WATCHDOG_PID", "1".into())];
        of(&of_another).expect("named").pulse(|| -> std::future::Ready<bool> { panic!("not asked") }).await;
        assert!(of(&[]).is_none());
    }
}
