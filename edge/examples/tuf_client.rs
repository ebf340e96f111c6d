//! The robot's client of The Update Framework alone, with the command line of the public conformance suite
//! (github.com/theupdateframework/tuf-conformance): `init`, `refresh` and `download`.
//!
//!     pytest tuf_conformance --entrypoint "target/debug/examples/tuf_client"
//!
//! The suite signs with ECDSA keys by default; our repositories have Ed25519 keys, so its `new_signer` must choose
//! those.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use anyhow::{Context, anyhow};
use slag_common::tuf::{Kept, Source, Trusted, refresh};

const MAX_FILE_BYTES: u64 = 16 << 20;

fn main() -> anyhow::Result<()> {
    let mut flags = BTreeMap::<String, Vec<String>>::new();
    let mut words = Vec::new();
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        match arg.strip_prefix("--") {
            Some(name) => flags.entry(name.to_owned()).or_default().push(args.next().context("a value")?),
            None => words.push(arg),
        }
    }
    let flag = |name: &str| flags.get(name).and_then(|values| values.last()).context(name.to_owned());
    let dir = PathBuf::from(flag("metadata-dir")?);
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    match words[..] {
        ["init", root] => Ok(fs_err::write(dir.join("root.json"), fs_err::read(root)?)?),
        ["refresh"] => update(&dir, flag("metadata-url")?, |_| Ok(())),
        ["download"] => update(&dir, flag("metadata-url")?, |trusted| {
            for path in flags.get("target-name").into_iter().flatten() {
                let target = trusted.target(path).context("it is not listed")?;
                let into = Path::new(flag("target-dir")?).join(encoded(path));
                if fs_err::read(&into).is_ok_and(|held| target.check(path, &held).is_ok()) {
                    continue;
                }
                let base = flag("target-base-url")?.trim_end_matches('/');
                let url = format!("{base}/{}", target.file_name(path)?);
                let bytes = get(&url, target.length.min(MAX_FILE_BYTES))?.context("404")?;
                target.check(path, &bytes)?;
                fs_err::write(into, bytes)?;
            }
            Ok(())
        }),
        _ => Err(anyhow!("expected init, refresh or download")),
    }
}

/// Loads the kept metadata, runs `work` on it, and saves the accepted metadata, also after an error.
fn update(dir: &Path, url: &str, work: impl FnOnce(&Trusted) -> anyhow::Result<()>) -> anyhow::Result<()> {
    let mut kept = Kept::from_root(&fs_err::read(dir.join("root.json"))?)?;
    let read = |name: &str| fs_err::read_to_string(dir.join(name)).ok();
    (kept.timestamp, kept.snapshot) = (read("timestamp.json"), read("snapshot.json"));
    kept.targets = read("targets.json");
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH)?.as_secs();
    let mut source = Repository(url.to_owned());
    let done =
        refresh(&mut kept, &mut source, now).map_err(anyhow::Error::from).and_then(|trusted| work(&trusted));
    let files = [
        ("root", Some(kept.root)),
        ("timestamp", kept.timestamp),
        ("snapshot", kept.snapshot),
        ("targets", kept.targets),
    ];
    for (role, text) in files {
        let path = dir.join(format!("{role}.json"));
        match text {
            Some(text) => fs_err::write(path, text)?,
            None if path.exists() => fs_err::remove_file(path)?,
            None => {}
        }
    }
    done
}

/// Returns a name that is one file's, whatever it holds.
fn encoded(name: &str) -> String {
    let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_".contains(&byte);
    name.bytes()
        .map(|byte| if is_plain(byte) { char::from(byte).to_string() } else { format!("%{byte:02X}") })
        .collect()
}

/// A repository's metadata at an address.
struct Repository(String);

impl Source for Repository {
    fn metadata(&mut self, name: &str, max_bytes: u64) -> Result<Option<Vec<u8>>, String> {
        get(&format!("{}/{name}", self.0.trim_end_matches('/')), max_bytes + 1).map_err(|e| e.to_string())
    }
}

/// Reads at most `max_bytes`; `None` for 404.
fn get(url: &str, max_bytes: u64) -> anyhow::Result<Option<Vec<u8>>> {
    use std::io::Read;

    let agent = ureq::Agent::config_builder().http_status_as_error(false).build().new_agent();
    let response = agent.get(url).call()?;
    match response.status().as_u16() {
        // What the specification says of a missing root; stores of objects often answer 403.
        403 | 404 => Ok(None),
        200 => {
            let mut bytes = Vec::new();
            response.into_body().into_reader().take(max_bytes).read_to_end(&mut bytes)?;
            Ok(Some(bytes))
        }
        status => Err(anyhow!("{url}: status {status}")),
    }
}
