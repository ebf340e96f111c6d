//! `doctor`: checks whether this robot can answer.

use std::io::{self, Write};
use std::path::Path;

use anyhow::anyhow;
use clap::Args;
use serde::Serialize;
use slag_common::tuf::format_utc;
use slag_common::{ByteSize, files};

use super::args::{CacheArgs, ModelArgs, engine};
use super::failure::Failure;
use super::output::print_json;
use super::text::visible;
use crate::error_line;
use crate::fetch::accepted;
use crate::query::Status;
use crate::store::{EdgeCache, Snapshot, StoreError};

/// Free space below which a fetch may not fit.
const LITTLE_BYTES: u64 = 256 << 20;

/// Age of a scene beyond which the robot's clock is suspect.
const LONG_AGO_HOURS: f64 = 24.0 * 365.0;

const EXAMPLES: &str = "Examples:\n\
    \x20 slag-edge doctor\n\
    \x20 slag-edge doctor --json\n\
    \x20 slag-edge doctor --cache /var/lib/slag\n";

#[derive(Debug, Args)]
#[command(before_help = EXAMPLES)]
pub struct DoctorArgs {
    #[command(flatten)]
    cache: CacheArgs,
    #[command(flatten)]
    models: ModelArgs,
    /// Print the findings as JSON.
    #[arg(long)]
    pub json: bool,
}

/// How one thing stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum Verdict {
    Ok,
    /// It answers, but not all it could.
    Note,
    /// It cannot answer.
    Missing,
}

#[derive(Debug, Serialize)]
struct Finding {
    what: &'static str,
    verdict: Verdict,
    /// What was found; for what is missing, also what to do.
    text: String,
}

impl Verdict {
    fn on(self, what: &'static str, text: impl Into<String>) -> Finding {
        Finding { what, verdict: self, text: text.into() }
    }
}

pub fn run(args: DoctorArgs) -> Result<(), Failure> {
    let cache = args.cache.open()?;
    let mut findings = vec![disk(&cache), trust(&cache)];
    findings.extend(on_board(&cache));
    findings.push(text_model(&cache, &args.models));
    if args.json { print_json(&findings) } else { Ok(print(&findings)?) }?;
    match findings.iter().filter(|finding| finding.verdict == Verdict::Missing).count() {
        0 => Ok(()),
        n => Err(Failure::failed("doctor", anyhow!("this robot cannot answer yet: {n} missing"))),
    }
}

fn print(findings: &[Finding]) -> io::Result<()> {
    let mut out = io::stdout().lock();
    for Finding { what, verdict, text } in findings {
        let verdict = match verdict {
            Verdict::Ok => "ok",
            Verdict::Note => "note",
            Verdict::Missing => "MISSING",
        };
        writeln!(out, "{verdict:<8} {what:<11} {}", visible(text))?;
    }
    Ok(())
}

fn disk(cache: &EdgeCache) -> Finding {
    let dir = cache.dir();
    // No fetch has made the folder yet: use the disk of its nearest ancestor.
    let there = dir.ancestors().find(|dir| or_here(dir).is_dir()).map_or(dir, or_here);
    match cache.files().free_bytes(there) {
        Err(error) => Verdict::Missing.on("disk", format!("{error}; give another --cache")),
        Ok(free) => {
            if let (true, Err(error)) = (dir.is_dir(), files::check_writable(&dir.join("doctor"))) {
                return Verdict::Note
                    .on("disk", format!("{error}: it answers, but fetches cannot write there"));
            }
            let verdict = if free < LITTLE_BYTES { Verdict::Note } else { Verdict::Ok };
            verdict.on("disk", format!("{} free for {}", ByteSize(free), dir.display()))
        }
    }
}

fn or_here(dir: &Path) -> &Path {
    if dir.as_os_str().is_empty() { Path::new(".") } else { dir }
}

fn trust(cache: &EdgeCache) -> Finding {
    let accepted = match accepted(cache) {
        Ok(Some(accepted)) => accepted,
        Ok(None) => {
            let advice = "no store; the cloud's `slag-encoder serve` prints the line: slag-edge trust add URL --sha256 HEX";
            return Verdict::Missing.on("trust", advice);
        }
        Err(error) => return Verdict::Missing.on("trust", error_line(&error)),
    };
    let root = format!("root {} {}", accepted.root_version, accepted.root_sha256);
    match accepted.expires_unix_secs {
        Some(expires) if expires <= crate::now_unix_secs() => {
            let text = format!("{root}; its news ended {}: fetch again", format_utc(expires));
            Verdict::Note.on("trust", text)
        }
        expires => {
            let until = expires.map_or(String::new(), |at| format!(", current until {}", format_utc(at)));
            Verdict::Ok.on("trust", root + &until)
        }
    }
}

fn on_board(cache: &EdgeCache) -> Vec<Finding> {
    let snapshot = match Snapshot::open(cache) {
        Ok(snapshot) => snapshot,
        Err(StoreError::Empty { .. }) => {
            let advice = "nothing fetched yet: slag-edge fetch --from URL --at X,Y,Z --radius 50";
            return vec![Verdict::Missing.on("scene", advice)];
        }
        Err(error) => {
            let mut text = error_line(&error);
            if !text.contains("fetch again") {
                text += "; fetch again";
            }
            return vec![Verdict::Missing.on("scene", text)];
        }
    };
    let status = Status::of(&snapshot);
    let unit = if status.metric { "m" } else { "world units" };
    let (n, of) = (status.shards.len(), status.n_cells_in_scene);
    let mut scene = format!(
        "{}, generation {}, {n} of {of} cells, {} Gaussians, {}",
        status.scene,
        status.generation,
        status.n_gaussians,
        ByteSize(status.len_bytes)
    );
    let place = format!("{} {unit} around {:.2}", status.radius, status.centre_in_world);
    let verdict = if n > 0 { Verdict::Ok } else { Verdict::Missing };
    if n == 0 {
        scene += ": slag-edge fetch --at X,Y,Z --radius 50, at a place in the scene";
    }
    let mut findings = vec![verdict.on("scene", scene), Verdict::Ok.on("place", place)];
    if let Some(signed) = accepted(cache).ok().flatten().and_then(|accepted| accepted.signed_unix_secs) {
        findings.push(age(signed, crate::now_unix_secs()));
    }
    let mut note = |what, text: &str| findings.push(Verdict::Note.on(what, text));
    if !status.bad_cells.is_empty() {
        note("cells", &format!("{} could not be fetched; fetch again", status.bad_cells.len()));
    }
    if status.geo_reference.is_none() {
        note("latitude", "none: the scene has no geo-reference, so positions are in its world");
    }
    if n > 0 && snapshot.shards.iter().all(|shard| shard.additions().occupancy.is_none()) {
        note("goal", "no places to stand: the scene was encoded without --occupancy");
    }
    findings
}

fn age(signed_unix_secs: u64, now_unix_secs: u64) -> Finding {
    let Some(secs) = (now_unix_secs + 3600).checked_sub(signed_unix_secs) else {
        let [signed, now] = [signed_unix_secs, now_unix_secs].map(format_utc);
        let text = format!(
            "the store signed it at {signed}, this robot's clock says {now}: set the one that is wrong"
        );
        return Verdict::Note.on("age", text);
    };
    let hours = secs.saturating_sub(3600) as f64 / 3600.0;
    let text = format!("the store signed it {hours:.1} hours ago");
    if hours < LONG_AGO_HOURS {
        return Verdict::Ok.on("age", text);
    }
    let now = format_utc(now_unix_secs);
    let text = format!("{text}, if this robot's clock is right, which says {now}: fetch again, or set it");
    Verdict::Note.on("age", text)
}

fn text_model(cache: &EdgeCache, models: &ModelArgs) -> Finding {
    let opened = engine(cache.clone(), models).and_then(|engine| {
        match engine.reload() {
            // An empty cache has nothing to compare with.
            Err(StoreError::Empty { .. }) => return Ok("opens".to_owned()),
            other => other?,
        }
        let on_board = engine.on_board()?;
        on_board.check()?;
        Ok(format!("{} opens and fits the scene", Status::of(&on_board.snapshot).encoder_name))
    });
    match opened {
        Ok(text) => Verdict::Ok.on("text model", text),
        Err(failure) => Verdict::Missing.on("text model", failure.text()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// As `fetch --cache NAME` would create them, in the current folder or a new one below.
    #[test]
    fn a_cache_that_is_yet_to_be_made_has_a_disk() {
        for name in ["no-such-cache", "no-such-folder/cache"] {
            let found = disk(&EdgeCache::open(name));
            assert!(found.verdict != Verdict::Missing && found.text.ends_with(name), "{}", found.text);
        }
    }

    /// A wrong clock of robot or store is reported, not turned into an age of 0 hours or 8,000 years.
    #[test]
    fn a_signature_of_another_time_is_noted() {
        let at = |signed: u64| age(signed, 1_800_000_000);
        assert_eq!(at(1_800_000_000 - 5400).text, "the store signed it 1.5 hours ago");
        assert_eq!(at(1_800_000_060).text, "the store signed it 0.0 hours ago");
        let late = at(4_070_908_800);
        assert!(
            late.text.contains("2099-01-01") && late.text.contains("clock says 2027-01-15"),
            "{}",
            late.text
        );
        let early = age(1_800_000_000, u64::MAX - 3600);
        assert!(early.verdict == Verdict::Note && early.text.contains("says 9999-12-31"), "{}", early.text);
    }
}
