//! What a run prints: data on stdout, all else on stderr.

use std::io::{self, Write};

use glam::DVec3;
use serde::Serialize;
use slag_edge::query::{Answers, Format, Found, QueryError, Reply, Status, ThresholdSource};

use super::Exit;

/// Why a run ends early.
pub enum Failure {
    /// Asked for something that cannot be.
    Usage(anyhow::Error),
    /// Failed; `kind` is for programs.
    Failed(&'static str, anyhow::Error),
    /// A signal came.
    Interrupted(anyhow::Error),
    /// Nobody reads stdout any more.
    BrokenPipe,
}

impl Failure {
    /// Wraps an error with its kind.
    pub fn of(kind: &'static str) -> impl Fn(anyhow::Error) -> Self {
        move |error| Self::Failed(kind, error)
    }

    /// Tells the error, as JSON on stdout where that was asked for, and returns the exit code.
    pub fn report(self, json: bool) -> Exit {
        let (exit, kind, error) = match self {
            Self::BrokenPipe => return Exit::Done,
            Self::Usage(error) => (Exit::Usage, "usage", error),
            Self::Failed(kind, error) => (Exit::Failed, kind, error),
            Self::Interrupted(error) => (Exit::Interrupted, "interrupted", error),
        };
        let detail = slag_edge::error_line(&*error);
        // Nothing is left to do if even this cannot be written.
        let _ = match json {
            true => writeln!(
                io::stdout(),
                "{}",
                serde_json::json!({ "error": { "kind": kind, "detail": detail } })
            ),
            false => writeln!(io::stderr(), "error: {}", visible(&detail)),
        };
        exit
    }
}

impl From<io::Error> for Failure {
    fn from(error: io::Error) -> Self {
        match error.kind() {
            io::ErrorKind::BrokenPipe => Self::BrokenPipe,
            _ => Self::Failed("io", error.into()),
        }
    }
}

impl From<QueryError> for Failure {
    fn from(error: QueryError) -> Self {
        match error {
            QueryError::Request(error) => Self::Usage(error.into()),
            other => Self::Failed(other.kind(), other.into()),
        }
    }
}

/// Prints one JSON object.
pub fn print_json(value: &impl Serialize) -> Result<(), Failure> {
    let text = serde_json::to_string(value).map_err(|e| Failure::Failed("json", e.into()))?;
    Ok(writeln!(io::stdout(), "{text}")?)
}

/// Prints `name  value` lines.
pub fn print_pairs(pairs: &[(&str, String)]) -> Result<(), Failure> {
    let width = pairs.iter().map(|(name, _)| name.len()).max().unwrap_or(0);
    let mut out = io::stdout().lock();
    for (name, value) in pairs {
        writeln!(out, "{name:width$}  {}", visible(value))?;
    }
    Ok(())
}

/// Prints a reply as one JSON object, piece by piece.
pub fn write_json(reply: Reply) -> Result<(), Failure> {
    let mut out = io::stdout().lock();
    for piece in reply.pieces(Format::Json) {
        out.write_all(&piece?)?;
    }
    Ok(writeln!(out)?)
}

/// Prints a reply's answers as tables, and what is to be known about them on stderr.
pub fn print_reply(reply: &Reply) -> Result<(), Failure> {
    reply.answers.iter().try_for_each(|answers| print_answers(reply, answers))
}

fn print_answers(reply: &Reply, answers: &Answers) -> Result<(), Failure> {
    if let Some(reason) = &answers.reason {
        writeln!(io::stderr(), "{}", reason.detail)?;
        return Ok(());
    }
    let exactness = match answers.is_exact {
        true => "exactly".to_owned(),
        false => match answers.score_error_p999 {
            Some(p999) => {
                format!("999 of 1,000 scores within ±{p999:.3}, all within ±{:.3}", answers.score_error_bound)
            }
            None => format!("scores within ±{:.3}", answers.score_error_bound),
        },
    };
    let (n, threshold) = (answers.n_matching, answers.threshold);
    let source = match answers.threshold_source {
        ThresholdSource::Request => "as asked",
        ThresholdSource::Scene => "calibrated on the scene",
        ThresholdSource::Encoder => "the encoder's default",
        ThresholdSource::Relevancy => "nearer than any negative",
    };
    let searched = answers.n_searched;
    writeln!(io::stderr(), "{n} Gaussians of {searched} reach {threshold}, {source} ({exactness})")?;
    if answers.area_fetched == Some(false) {
        writeln!(io::stderr(), "part of that area is not on board: fetch it for a full answer")?;
    }
    let rows: Vec<Vec<String>> = match &answers.answers {
        Found::Clusters(clusters) => clusters
            .iter()
            .map(|c| {
                let size = format!("{:.2} x {:.2} x {:.2}", c.size.x, c.size.y, c.size.z);
                let (score, n) = (format!("{:.3}", c.score), c.n_gaussians.to_string());
                vec![
                    c.rank.to_string(),
                    distance(c.distance),
                    point(c.position_in_world),
                    size,
                    score,
                    n,
                    match &c.evidence {
                        Some(evidence) => format!("{} in {}", c.id, visible(&evidence.photo)),
                        None => c.id.clone(),
                    },
                ]
            })
            .collect(),
        Found::Gaussians(_) => reply
            .gaussians(answers)
            .into_iter()
            .map(|g| {
                let (score, id) = (format!("{:.3}", g.score), format!("{}-{}", g.cell_id, g.index));
                vec![
                    g.rank.to_string(),
                    distance(g.distance),
                    point(g.position_in_world),
                    "-".into(),
                    score,
                    "1".into(),
                    id,
                ]
            })
            .collect(),
    };
    let unit = answers.unit;
    let head = [
        "rank",
        &format!("distance [{unit}]"),
        &format!("position [{unit}]"),
        &format!("size [{unit}]"),
        "score",
        "count",
        "id",
    ];
    Ok(write!(io::stdout(), "{}", table(&head, &rows))?)
}

/// Prints what is on board.
pub fn print_status(status: &Status) -> Result<(), Failure> {
    let unit = if status.metric { "m" } else { "world units" };
    print_pairs(&[
        ("scene", status.scene.clone()),
        ("generation", status.generation.to_string()),
        ("encoder", format!("{} ({})", status.encoder_name, status.encoder_id)),
        ("threshold", status.default_threshold.to_string()),
        ("profile", status.profile.to_string()),
        ("fetched", format!("{} {unit} around {}", status.radius, point(status.centre_in_world))),
        ("shards", format!("{} of {} cells", status.shards.len(), status.n_cells_in_scene)),
        ("Gaussians", status.n_gaussians.to_string()),
        ("bytes", status.len_bytes.to_string()),
        ("signed by", status.key.to_string()),
    ])
}

fn point(p: DVec3) -> String {
    format!("{:.2}, {:.2}, {:.2}", p.x, p.y, p.z)
}

fn distance(distance: Option<f64>) -> String {
    distance.map_or_else(|| "-".to_owned(), |d| format!("{d:.2}"))
}

/// Lays rows out in right-aligned columns under a head.
fn table(head: &[&str], rows: &[Vec<String>]) -> String {
    let width_of = |column: usize| {
        let cells = rows.iter().map(|row| row[column].chars().count());
        cells.chain([head[column].chars().count()]).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..head.len()).map(width_of).collect();
    let line = |cells: &mut dyn Iterator<Item = &str>| {
        let padded: Vec<String> = cells.zip(&widths).map(|(cell, width)| format!("{cell:>width$}")).collect();
        padded.join("  ") + "\n"
    };
    let mut text = line(&mut head.iter().copied());
    text.extend(rows.iter().map(|row| line(&mut row.iter().map(String::as_str))));
    text
}

/// Escapes control characters: names come from files, and terminals obey them.
fn visible(text: &str) -> String {
    text.chars()
        .flat_map(|c| if c.is_control() { c.escape_default().collect::<Vec<_>>() } else { vec![c] })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_align_and_control_bytes_show() {
        let text = table(
            &["a", "long head"],
            &[vec!["12".into(), "é".into()], vec!["3".into(), "long content".into()]],
        );
        assert_eq!(text, " a     long head\n12             é\n 3  long content\n");
        assert_eq!(visible("yard\u{1b}[2J\n"), "yard\\u{1b}[2J\\n");
    }

    #[test]
    fn causes_are_told_once() {
        let io = io::Error::new(io::ErrorKind::NotFound, "no such file");
        let error = anyhow::Error::from(io).context("a: no such file; look").context("b");
        assert_eq!(slag_edge::error_line(&*error), "b: a: no such file; look");
    }

    #[test]
    fn failures_have_their_exit_codes() {
        let error = || anyhow::anyhow!("x");
        assert_eq!(Failure::Usage(error()).report(false), Exit::Usage);
        assert_eq!(Failure::Failed("io", error()).report(false), Exit::Failed);
        assert_eq!(Failure::Interrupted(error()).report(false), Exit::Interrupted);
        assert_eq!(Failure::from(io::Error::from(io::ErrorKind::BrokenPipe)).report(false), Exit::Done);
        assert_eq!(
            [Exit::Done as u8, Exit::Failed as u8, Exit::Usage as u8, Exit::Interrupted as u8],
            [0, 1, 2, 130]
        );
    }
}
