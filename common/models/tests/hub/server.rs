//! A hub on this machine that behaves like the real one, or worse, and offers a generated model.

use super::*;
use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use sha2::{Digest, Sha256};
use slag_models::hub::{HubOptions, Lock, Table};
use tempfile::TempDir;

use crate::common::made::{DESCRIPTION, TextKind, VOCABULARY, image_graph, text_graph, tokenizer};
use crate::common::onnx::{Element, model};

pub const COMMIT: &str = "0123456789abcdef0123456789abcdef01234567";

/// The made model at the hub: its tokenizer is small, so that the hub states no hash of it.
pub const MODEL: &str = r#"
[[model]]
name = "made"
about = "A made model."
layout = "made"
dim = 4
licence = "Example-1.0"
licence_note = "Not a real one."
licence_url = "https://licence.example/"
restricts_use = true
repository = "owner/made"
files = { image = "onnx/vision.onnx", text = "onnx/text.onnx", tokenizer = "tokenizer.json" }
"#;

pub fn table() -> String {
    let (_, layout) = DESCRIPTION.split_once("licence = \"none\"\n").expect("a head");
    let layout = [("vision.onnx", "IMAGE"), ("text.onnx", "TEXT"), ("tokenizer.json", "TOKENIZER")]
        .into_iter()
        .fold(layout.to_owned(), |layout, (file, placeholder)| layout.replace(file, placeholder));
    format!("hub = \"http://127.0.0.1:1\"\n[layout.made]\ndescription = '''{layout}'''\n{MODEL}")
}

pub fn sha256(bytes: &[u8]) -> String {
    hex::encode(Sha256::digest(bytes))
}

#[derive(Clone, Debug)]
pub struct Asked {
    pub method: String,
    pub path: String,
    pub headers: BTreeMap<String, String>,
}

pub struct Answer {
    pub status: u16,
    pub headers: Vec<(&'static str, String)>,
    pub body: Vec<u8>,
    /// How much of the body is sent before the connection breaks.
    pub sent_bytes: usize,
}

impl Answer {
    pub fn status(status: u16) -> Self {
        Self { status, headers: Vec::new(), body: Vec::new(), sent_bytes: usize::MAX }
    }
}

/// A hub whose answers can be changed while it runs.
pub struct Server {
    pub url: String,
    pub asked: Arc<Mutex<Vec<Asked>>>,
    pub files: Arc<Mutex<Files>>,
}

pub struct Files {
    pub bytes: BTreeMap<String, Vec<u8>>,
    pub commit: &'static str,
    /// False hashes that the hub advertises.
    pub stated: BTreeMap<String, String>,
    pub status: Option<u16>,
    /// Bytes after which every body breaks.
    pub cut_bytes: usize,
    /// Added to every length announced.
    pub extra_bytes: usize,
}

impl Files {
    pub fn answer(&self, asked: &Asked) -> Answer {
        if let Some(status) = self.status {
            return Answer::status(status);
        }
        if let Some(name) = asked.path.strip_prefix("/store/") {
            return self.stored(asked, &self.bytes[name], name);
        }
        let rest = asked.path.strip_prefix("/owner/made/resolve/").unwrap_or_default();
        let Some((_, name)) = rest.split_once('/') else { return Answer::status(404) };
        let Some(bytes) = self.bytes.get(name) else { return Answer::status(404) };
        let commit = ("X-Repo-Commit", self.commit.to_owned());
        if name == "tokenizer.json" {
            let mut answer = self.stored(asked, bytes, name);
            answer.headers.push(commit);
            return answer;
        }
        let stated = self.stated.get(name).cloned().unwrap_or_else(|| sha256(bytes));
        let headers = vec![
            commit,
            ("X-Linked-ETag", format!("\"{stated}\"")),
            ("X-Linked-Size", bytes.len().to_string()),
            ("Location", format!("/store/{name}")),
        ];
        Answer { headers, ..Answer::status(302) }
    }

    pub fn stored(&self, asked: &Asked, bytes: &[u8], name: &str) -> Answer {
        let etag = format!("\"{}-{}\"", name.len(), &sha256(bytes)[..8]);
        let mut answer = Answer { body: bytes.to_vec(), sent_bytes: self.cut_bytes, ..Answer::status(200) };
        if asked.headers.get("if-range") == Some(&etag)
            && let Some(range) = asked.headers.get("range").and_then(|range| range.strip_prefix("bytes="))
        {
            let first: usize = range.trim_end_matches('-').parse().expect("a range to the end");
            answer.status = 206;
            answer.body.drain(..first);
            let last = bytes.len() - 1;
            answer.headers.push(("Content-Range", format!("bytes {first}-{last}/{}", bytes.len())));
        }
        answer.headers.push(("ETag", etag));
        answer
    }
}

pub fn serve_one(stream: TcpStream, files: &Mutex<Files>, seen: &Mutex<Vec<Asked>>) -> std::io::Result<()> {
    let mut reader = BufReader::new(&stream);
    let mut line = String::new();
    reader.read_line(&mut line)?;
    let mut words = line.split(' ').map(str::to_owned);
    let (Some(method), Some(path)) = (words.next(), words.next()) else { return Ok(()) };
    let mut asked = Asked { method, path, headers: BTreeMap::new() };
    loop {
        let mut line = String::new();
        reader.read_line(&mut line)?;
        let Some((name, value)) = line.split_once(": ") else { break };
        asked.headers.insert(name.to_lowercase(), value.trim().to_owned());
    }
    let files = files.lock().expect("no panic");
    let answer = files.answer(&asked);
    seen.lock().expect("no panic").push(asked.clone());
    let mut head = format!("HTTP/1.1 {} X\r\nConnection: close\r\n", answer.status);
    head += &format!("Content-Length: {}\r\n", answer.body.len() + files.extra_bytes);
    for (name, value) in answer.headers {
        head += &format!("{name}: {value}\r\n");
    }
    (&stream).write_all((head + "\r\n").as_bytes())?;
    if asked.method == "GET" {
        (&stream).write_all(&answer.body[..answer.sent_bytes.min(answer.body.len())])?;
    }
    // Read the rest of the request; otherwise the client's kernel drops unread parts of the answer.
    stream.shutdown(std::net::Shutdown::Write)?;
    stream.set_read_timeout(Some(Duration::from_secs(5)))?;
    std::io::copy(&mut reader.take(1 << 16), &mut std::io::sink())?;
    Ok(())
}

impl Server {
    pub fn start() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let url = format!("http://{}", listener.local_addr().expect("an address"));
        let bytes = [
            ("onnx/vision.onnx", model(&image_graph(Element::F32, -1, false))),
            ("onnx/text.onnx", model(&text_graph(TextKind::default()))),
            ("tokenizer.json", tokenizer(&VOCABULARY).into_bytes()),
        ];
        let files = Files {
            bytes: bytes.into_iter().map(|(name, bytes)| (name.to_owned(), bytes)).collect(),
            commit: COMMIT,
            stated: BTreeMap::new(),
            status: None,
            cut_bytes: usize::MAX,
            extra_bytes: 0,
        };
        let server = Self { url, asked: Arc::default(), files: Arc::new(Mutex::new(files)) };
        let (asked, files) = (Arc::clone(&server.asked), Arc::clone(&server.files));
        std::thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                // A client that goes away is part of the game.
                drop(serve_one(stream, &files, &asked));
            }
        });
        server
    }

    pub fn change(&self, change: impl FnOnce(&mut Files)) {
        change(&mut self.files.lock().expect("no panic"));
    }

    pub fn bytes(&self, name: &str) -> Vec<u8> {
        self.files.lock().expect("no panic").bytes[name].clone()
    }

    /// Returns the requests since the last call.
    pub fn asked(&self) -> Vec<Asked> {
        std::mem::take(&mut self.asked.lock().expect("no panic"))
    }
}

pub fn hub_of(table: &str, url: &str, root: &Path) -> Hub {
    let (hub, first_backoff) = (Some(url.to_owned()), Duration::from_millis(1));
    let timeout = Duration::from_secs(5);
    let options = HubOptions { hub, first_backoff, timeout, ..HubOptions::new(root.to_owned()) };
    Hub::with_table(toml::from_str::<Table>(table).expect("a table"), options)
}

pub fn setting() -> (Server, TempDir, Hub) {
    let (server, root) = (Server::start(), tempfile::tempdir().expect("a folder"));
    let hub = hub_of(&table(), &server.url, root.path());
    (server, root, hub)
}

/// The table with the hash of the text model known.
pub fn pinned(server: &Server) -> String {
    let text = server.bytes("onnx/text.onnx");
    let known = "[model.known.\"onnx/text.onnx\"]";
    format!("{}{known}\nlen_bytes = {}\nsha256 = \"{}\"\n", table(), text.len(), sha256(&text))
}

pub fn lock_of(root: &Path) -> serde_json::Value {
    serde_json::to_value(Lock::read(root).expect("a lock")).expect("it serialises")
}

/// All files below a folder, but for the lock and the pulls' own.
pub fn files_below(root: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut folders = vec![root.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs_err::read_dir(folder).expect("it is readable") {
            let path = entry.expect("it is readable").path();
            match path.is_dir() {
                true => folders.push(path),
                false => found.push(path.strip_prefix(root).expect("below").to_owned()),
            }
        }
    }
    found.retain(|path| !["models.lock", ".pull"].contains(&path.to_str().expect("UTF-8")));
    found.sort();
    found
}
