//! `query`.

use std::io::{self, Write};
use std::path::PathBuf;
use std::sync::Arc;

use crate::query::{
    AnswerKind, Answers, ClusterAnswer, DEFAULT_MIN_COUNT, Format, Found, GaussianAnswer, Negatives,
    QueryRequest, Reply, Searched, ThresholdSource, parse_box, parse_point,
};
use crate::score::{Ball, Budget, Precision, Region};
use clap::Args;
use glam::DVec3;
use slag_api::coverage::BadCellAnswer;
use slag_common::frames::Aabb;
use slag_common::{durable, files, note};

use super::args::{EngineArgs, named};
use super::failure::Failure;
use super::text::{table, visible};

const EXAMPLES: &str = "Examples:\n\
    \x20 slag-edge query chair\n\
    \x20 slag-edge query \"mug on the table\" --near 12.5,-3,0\n\
    \x20 slag-edge query chair --near 12.5,-3,0 --radius 10 --json\n";

#[derive(Debug, Args)]
#[command(before_help = EXAMPLES)]
pub struct QueryArgs {
    /// Text to look for.
    pub text: String,
    /// Negative prompts: none, canonical (object, things, stuff, texture), or phrases A,B,C.
    #[arg(long, default_value = "none")]
    pub negatives: Negatives,
    /// Position of the asker, world frame: answers carry their distance from it, and nearer ones rank higher.
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_point, allow_hyphen_values = true)]
    pub near: Option<DVec3>,
    /// Where the asker looks, for questions such as "chair left of me": radians from the world's x axis towards y.
    #[arg(long, value_name = "RAD", requires = "near", allow_negative_numbers = true)]
    pub heading_rad: Option<f64>,
    /// Search only within this distance of --near, world units.
    #[arg(long, requires = "near")]
    pub radius: Option<f64>,
    /// Search only within the box between two corners, world frame.
    #[arg(long = "box", value_name = "X,Y,Z,X,Y,Z", value_parser = parse_box, allow_hyphen_values = true)]
    pub bounds: Option<Aabb>,
    /// Most answers [default: 10].
    #[arg(long)]
    pub limit: Option<usize>,
    /// Least score of a match: a cosine, or with negatives a relevancy [default: the scene's; 0.5].
    #[arg(long, allow_hyphen_values = true)]
    pub threshold: Option<f32>,
    /// Kind of answers: objects, clusters or gaussians [default: objects, and clusters for what no object
    /// answers].
    #[arg(long, value_parser = named::<AnswerKind>)]
    pub kind: Option<AnswerKind>,
    /// Edge of the voxels used for clustering, world units [default: 0.25 m, or the scene's].
    #[arg(long)]
    pub voxel: Option<f64>,
    /// Least Gaussians of a cluster; smaller ones are only counted.
    #[arg(long, default_value_t = DEFAULT_MIN_COUNT)]
    pub min_count: u64,
    /// Data that scores come from: centroids, measured (embeddings only where the measured errors of their
    /// codes do not decide) or exact.
    #[arg(long, value_name = "NAME", default_value_t = Precision::Exact)]
    pub precision: Precision,
    #[command(flatten)]
    pub engine: EngineArgs,
    /// Write the Gaussians that answered to a PLY of points: position, score, rank of their answer, and index in
    /// the input splat file where the shards know it.
    #[arg(long, value_name = "FILE")]
    pub ply: Option<PathBuf>,
    /// Print the answers as JSON.
    #[arg(long)]
    pub json: bool,
}

pub fn run(args: QueryArgs) -> Result<(), Failure> {
    let around = args.near.zip(args.radius);
    let ball = around.map(|(centre_in_world, radius)| Ball { centre_in_world, radius });
    let request = QueryRequest {
        negatives: args.negatives,
        limit: args.limit,
        threshold: args.threshold,
        near: args.near,
        heading_rad: args.heading_rad,
        region: Region { ball, bounds: args.bounds, polygon: None },
        kind: args.kind,
        voxel: args.voxel,
        min_count: args.min_count,
        precision: args.precision,
        members: args.ply.is_some(),
        ..QueryRequest::new(args.text)
    };
    request.check()?;
    args.ply.iter().try_for_each(|path| files::check_writable(path))?;
    let engine = args.engine.open()?;
    let reply = Arc::new(engine.on_board()?.answer(request, &Budget::default())?);
    if let Some(path) = &args.ply {
        durable::write_result(path, |file| write(Arc::clone(&reply), Format::Ply, file))?;
    }
    match args.json {
        true => {
            let mut out = io::stdout().lock();
            write(reply, Format::Json, &mut out)?;
            Ok(writeln!(out)?)
        }
        false => reply.answers.iter().try_for_each(|answers| print_answers(&reply, answers)),
    }
}

fn write(reply: Arc<Reply>, format: Format, mut to: impl Write) -> io::Result<()> {
    reply.pieces(format).try_for_each(|piece| to.write_all(&piece?))
}

fn print_answers(reply: &Reply, answers: &Answers) -> Result<(), Failure> {
    for (word, asked) in &answers.asked_as {
        note(format_args!("{word}: asked as {asked}"));
    }
    if let Some(reason) = &answers.reason {
        note(&reason.detail);
        return Ok(());
    }
    note(notes(answers).trim_end());
    let row = |rank: usize, at: DVec3, of: [String; 4], from: Option<f64>| {
        let [size, score, count, id] = of;
        let distance = from.map_or_else(|| "-".to_owned(), |d| format!("{d:.2}"));
        let position = format!("{:.2}, {:.2}, {:.2}", at.x, at.y, at.z);
        vec![rank.to_string(), distance, position, size, score, count, id]
    };
    let cluster = |c: &ClusterAnswer| {
        let size = format!("{:.2} x {:.2} x {:.2}", c.size.x, c.size.y, c.size.z);
        let shown = c.evidence.as_ref().map(|evidence| format!(" in {}", visible(&evidence.photo)));
        let id = c.id.clone() + &shown.unwrap_or_default();
        let of = [size, format!("{:.3}", c.score), c.n_gaussians.to_string(), id];
        row(c.rank, c.position_in_world, of, c.distance)
    };
    let gaussian = |g: GaussianAnswer| {
        let of = ["-".into(), format!("{:.3}", g.score), "1".into(), format!("{}-{}", g.cell_id, g.index)];
        row(g.rank, g.position_in_world, of, g.distance)
    };
    let rows: Vec<Vec<String>> = match &answers.answers {
        Found::Clusters(clusters) => clusters.iter().map(cluster).collect(),
        Found::Gaussians(_) => reply.gaussians(answers).into_iter().map(gaussian).collect(),
    };
    let [distance, position, size] =
        ["distance", "position", "size"].map(|name| format!("{name} [{}]", answers.unit));
    let head = ["rank", &distance, &position, &size, "score", "count", "id"];
    Ok(write!(io::stdout(), "{}", table(&head, &rows))?)
}

fn notes(answers: &Answers) -> String {
    let found = &answers.searched;
    let exactness = match found.score_error_likely.filter(|_| !found.is_exact) {
        Some(likely) => format!("; 99 of 100 scores within ±{likely:.3}"),
        None => String::new(),
    };
    let source = match found.threshold_source {
        ThresholdSource::Request => "as requested",
        ThresholdSource::Scene => "calibrated on the scene",
        ThresholdSource::Encoder => "the encoder's default",
        ThresholdSource::Relevancy => "closer than any negative",
    };
    let Searched { n_matching, n_searched, threshold, .. } = found;
    let counted = match (&answers.related, answers.kind) {
        (Some(related), _) => {
            let parts = related.parts.iter().map(|part| {
                format!("{} {:?} from {:.3}", part.n_found, visible(&part.thing), part.threshold)
            });
            format!("on board: {}", parts.collect::<Vec<_>>().join(", "))
        }
        (None, kind) => {
            let of = if kind == AnswerKind::Objects { "objects with " } else { "" };
            format!("{of}{n_matching} Gaussians of {n_searched} reach {threshold:.3}, {source}{exactness}")
        }
    };
    let mut notes = format!("{counted}\n");
    if let Some(missing) = answers.coverage.missing() {
        notes += &format!("{missing}\n");
    }
    for BadCellAnswer { cell_id, generation } in &answers.coverage.bad_cells {
        if let Some(old) = generation {
            notes += &format!("cell {cell_id} could not be fetched; generation {old} answers for it\n");
        }
    }
    notes
}
