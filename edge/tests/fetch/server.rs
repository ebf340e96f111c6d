//! A small HTTP/1.1 server that serves a published scene and misbehaves on demand.

use super::*;
use std::io::{BufRead, BufReader, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};

#[derive(Clone, Debug, PartialEq)]
pub enum Fault {
    None,
    /// Closes the connection after this many body bytes.
    Cut(usize),
    /// Flips a bit of this byte of the body.
    Corrupt(usize),
    /// Ignores the range and answers with the whole body.
    IgnoreRange,
    Status(u16),
    /// `Retry-After` in seconds.
    RetryAfter(u16, u64),
    Delay(Duration),
    Redirect(String),
    /// Sends the body, then continues for ever, in chunks.
    Endless,
    /// Announces this many bytes more than it sends.
    Length(i64),
    /// Answers with a range that begins this many bytes later.
    ShiftedRange(usize),
    /// Answers a range as if it were the whole file, with status 200.
    Slice,
    Instead(Vec<u8>),
    Stall,
}

#[derive(Clone, Debug)]
pub struct Seen {
    pub path: String,
    pub range_start: Option<usize>,
    pub status: u16,
    pub body_bytes: usize,
}

type Chooser = dyn FnMut(&Seen) -> Fault + Send;

struct Shared {
    published: Mutex<Published>,
    chooser: Mutex<Box<Chooser>>,
    seen: Mutex<Vec<Seen>>,
}

pub struct Server {
    shared: Arc<Shared>,
    address: SocketAddr,
}

impl Server {
    pub fn start(published: Published) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = listener.local_addr().expect("bound");
        let shared = Arc::new(Shared {
            published: Mutex::new(published),
            chooser: Mutex::new(Box::new(|_| Fault::None)),
            seen: Mutex::default(),
        });
        let served = shared.clone();
        std::thread::spawn(move || {
            for stream in listener.incoming() {
                let shared = served.clone();
                // A client that leaves mid-answer is expected.
                std::thread::spawn(move || stream.map(|stream| answer(&shared, stream)));
            }
        });
        Self { shared, address }
    }

    pub fn url(&self) -> String {
        format!("http://{}", self.address)
    }

    pub fn publish(&self, published: Published) {
        *self.shared.published.lock().expect("sound") = published;
    }

    pub fn faults(&self, chooser: impl FnMut(&Seen) -> Fault + Send + 'static) {
        *self.shared.chooser.lock().expect("sound") = Box::new(chooser);
    }

    /// Answers requests with `part` in their path with this fault.
    pub fn fault_at(&self, part: &'static str, fault: Fault) {
        self.faults(move |seen| if seen.path.contains(part) { fault.clone() } else { Fault::None });
    }

    pub fn take_seen(&self) -> Vec<Seen> {
        std::mem::take(&mut self.shared.seen.lock().expect("sound"))
    }

    pub fn take_objects(&self) -> Vec<Seen> {
        self.take_seen().into_iter().filter(|seen| seen.path.contains("objects")).collect()
    }
}

fn answer(shared: &Shared, mut stream: TcpStream) -> std::io::Result<()> {
    let mut reader = BufReader::new(stream.try_clone()?);
    let mut request_line = String::new();
    reader.read_line(&mut request_line)?;
    let (mut range_start, mut if_range, mut if_none_match) = (None, None, None);
    loop {
        let mut line = String::new();
        if reader.read_line(&mut line)? <= 2 {
            break;
        }
        let Some((name, value)) = line.trim_end().split_once(": ") else { continue };
        match name.to_ascii_lowercase().as_str() {
            "range" => {
                range_start =
                    value.strip_prefix("bytes=").and_then(|v| v.strip_suffix('-')?.parse::<usize>().ok());
            }
            "if-range" => if_range = Some(value.to_owned()),
            "if-none-match" => if_none_match = Some(value.to_owned()),
            _ => {}
        }
    }
    let path = request_line.split(' ').nth(1).unwrap_or_default().to_owned();
    let content = {
        let published = shared.published.lock().expect("sound");
        match path.strip_prefix("/v1/").and_then(|path| path.split_once('/')) {
            Some(("objects", hash)) => {
                hash.parse().ok().and_then(|hash: Hash32| published.objects.get(&hash).cloned())
            }
            Some(("metadata", name)) => published.metadata.get(name).cloned(),
            Some(("targets", name)) => {
                let expected = TargetFile::of(&published.listed).file_name(manifest::TARGET);
                (expected.as_deref() == Ok(name)).then(|| published.listed.clone())
            }
            _ => None,
        }
    };
    let mut seen = Seen { path, range_start, status: 0, body_bytes: 0 };
    let fault = shared.chooser.lock().expect("sound")(&seen);
    let mut body = content.unwrap_or_default();
    let etag = format!("\"{}\"", Hash32::of(&body));
    let mut head = String::new();
    seen.status = match (&fault, range_start) {
        (Fault::Status(status), _) => {
            body.clear();
            *status
        }
        (Fault::RetryAfter(status, seconds), _) => {
            body.clear();
            head += &format!("Retry-After: {seconds}\r\n");
            *status
        }
        (Fault::Redirect(location), _) => {
            head += &format!("Location: {location}\r\n");
            302
        }
        _ if body.is_empty() => 404,
        _ if if_none_match.as_ref() == Some(&etag) => {
            body.clear();
            304
        }
        (Fault::IgnoreRange, _) | (_, None) => 200,
        (Fault::Slice, Some(start)) if start < body.len() => {
            head += &format!("Content-Range: bytes {start}-{}/{}\r\n", body.len() - 1, body.len());
            body.drain(..start);
            200
        }
        (_, Some(_)) if if_range.as_ref() != Some(&etag) => 200,
        (_, Some(start)) if start >= body.len() => {
            body.clear();
            416
        }
        (_, Some(start)) => {
            let by = if let Fault::ShiftedRange(by) = fault { by } else { 0 };
            let start = (start + by).min(body.len() - 1);
            head += &format!("Content-Range: bytes {start}-{}/{}\r\n", body.len() - 1, body.len());
            body.drain(..start);
            206
        }
    };
    let mut stated = body.len() as i64;
    let mut sent = body.len();
    match &fault {
        Fault::Cut(at) => sent = sent.min(*at),
        Fault::Corrupt(at) if !body.is_empty() => {
            let at = at % body.len();
            body[at] ^= 0x40;
        }
        Fault::Length(by) => stated += by,
        Fault::Instead(other) if seen.status == 200 => {
            body = other.clone();
            (stated, sent) = (body.len() as i64, body.len());
        }
        _ => {}
    }
    seen.body_bytes = sent;
    let status = seen.status;
    shared.seen.lock().expect("sound").push(seen);
    if let Fault::Delay(by) = fault {
        std::thread::sleep(by);
    }
    if fault == Fault::Stall {
        return reader.read_line(&mut String::new()).map(drop);
    }
    let is_endless = fault == Fault::Endless && status < 300;
    let framing = match is_endless {
        true => "Transfer-Encoding: chunked".to_owned(),
        false => format!("Content-Length: {stated}"),
    };
    write!(stream, "HTTP/1.1 {status} X\r\nConnection: close\r\nETag: {etag}\r\n{head}{framing}\r\n\r\n")?;
    if !is_endless {
        return stream.write_all(&body[..sent]);
    }
    write!(stream, "{:x}\r\n", body.len())?;
    stream.write_all(&body)?;
    loop {
        stream.write_all(b"\r\n10000\r\n")?;
        stream.write_all(&[b'x'; 0x10000])?;
    }
}
