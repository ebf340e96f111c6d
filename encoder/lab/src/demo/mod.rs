//! The whole system in one run: generate, encode, serve, fetch as a robot does, ask, compare with the truth.

mod picture;
mod questions;

use std::fmt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

use anyhow::{Context, Result, anyhow};
use clap::Args;
use glam::DVec3;
use serde::{Deserialize, Serialize};
use slag_models::commands::RunArgs;
use slag_models::{ModelDir, TextEncoder};

pub use picture::EdgeAnswer;

use crate::generate::Scene;
use crate::generate::grammar::SceneKind;
use crate::programs::{fetch, json_of, sibling};
use slag_encoder::cells::CellLimits;
use slag_encoder::cli::common::{cancel_flag, now_unix_secs, session_options};
use slag_encoder::encode::{self, EncodeSettings, EncodeSummary, Engines};
use slag_encoder::progress::Progress;
use slag_encoder::query;
use slag_encoder::raster::CpuRasterizer;
use slag_encoder::store::StoreReader;

const KINDS: [SceneKind; 2] = [SceneKind::Room, SceneKind::Yard];
/// Photos of room and yard together.
const N_VIEWS: u32 = 72;
/// The photo in the yard that was taken where the robot stands.
const ROBOT_VIEW: usize = 1;
/// Radius around the robot to fetch, less than the scene.
const RADIUS_M: f64 = 9.0;
/// Distance by which a correct answer's centre may lie outside the true box: a mask's edge covers some background.
const TOLERANCE_M: f64 = 0.25;
/// Marks a folder as a demo's, so that the next demo may empty it.
const MARKER: &str = "demo.json";

#[derive(Debug, Args)]
pub(crate) struct DemoArgs {
    /// Working folder; an earlier demo in it is deleted.
    #[arg(long, value_name = "DIR", default_value = "target/demo")]
    out: PathBuf,
    /// Seed of room and yard.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Model runtime.
    #[command(flatten)]
    how: RunArgs,
    /// Keeps the services running until ctrl-c, for queries of your own.
    #[arg(long)]
    pub(crate) keep: bool,
}

#[derive(Debug, Serialize)]
pub struct DemoReport {
    /// A picture of each answer, and a map of the scene from above with the cells that the robot fetched.
    pub pictures: [PathBuf; 2],
    pub encode: EncodeSummary,
    pub downloaded_bytes: u64,
    pub about_model: String,
    pub questions: Vec<Question>,
}

#[derive(Debug, Serialize)]
pub struct Question {
    pub text: String,
    pub answer: Option<EdgeAnswer>,
    pub reason: Option<serde_json::Value>,
    /// The things that it asks for: name, and centre of the box.
    pub truth: Vec<(String, DVec3)>,
    /// Milliseconds from the start of `slag-edge query` to its end.
    pub process_ms: f64,
    pub right: bool,
}

/// What `slag-edge query --json` prints, as far as the demo reads it.
#[derive(Debug, Deserialize)]
struct EdgeReply {
    answers: Vec<EdgeAnswer>,
    reason: Option<serde_json::Value>,
}

impl DemoReport {
    pub fn all_right(&self) -> bool {
        self.questions.iter().all(|q| q.right)
    }

    /// Link to the robot's page with the first question; `None` for programs built without the page.
    fn link(&self) -> Option<String> {
        let question = self.questions.first().filter(|_| slag_view::is_built())?;
        Some(format!("http://127.0.0.1:7734/view#q={}", question.text.replace(' ', "+")))
    }
}

/// Serves the shards and the robot's queries until it is stopped.
pub(crate) fn keep(args: &DemoArgs, report: &DemoReport) -> Result<()> {
    let mut shards = Command::new(sibling("slag-encoder")?);
    shards.arg("serve").arg("--store").arg(args.out.join("store"));
    let mut shards = shards.spawn().context("cannot serve the store")?;
    println!("try: curl 'http://127.0.0.1:7734/query?text=chair'");
    if let Some(link) = report.link() {
        println!("see: {link}");
    }
    let edge = sibling("slag-edge")?;
    let status = Command::new(&edge).arg("serve").arg("--cache").arg(args.out.join("cache")).status();
    // It may have ended already: ctrl-c reaches all processes of the terminal.
    let _ = shards.kill();
    let _ = shards.wait();
    status.with_context(|| format!("cannot start {}", edge.display()))?;
    Ok(())
}

pub(crate) fn run(args: &DemoArgs, progress: &dyn Progress) -> Result<DemoReport> {
    // Before any work.
    let edge = sibling("slag-edge")?;
    clear(&args.out)?;
    let (store, cache) = (args.out.join("store"), args.out.join("cache"));
    let mut scene = Scene::new(&KINDS, args.seed, N_VIEWS);
    let (models, session) = (ModelDir::embedded()?, session_options(&args.how)?);
    let encode = encode(&args.out, &mut scene, &Engines::new(&models, &session, &CpuRasterizer), progress)?;
    let camera_in_world = scene.views[ROBOT_VIEW].camera_from_world.inverse().translation;
    let robot_in_world = DVec3::new(camera_in_world.x, camera_in_world.y, 0.0);
    let at = format!("{:.3},{:.3},{:.3}", robot_in_world.x, robot_in_world.y, robot_in_world.z);
    let radius = RADIUS_M.to_string();
    let fetched = fetch(&store, &cache, &["--at", &at, "--radius", &radius])?;
    let downloaded_bytes = fetched["downloaded"]["bytes"].as_u64().context("fetch: no downloaded bytes")?;
    // The robot is offline from here on.
    let questions = ask(&edge, &cache, &scene, (robot_in_world, &at))?;
    let mut encoder = models.text_encoder(&session)?;
    let pictures = draw(&args.out, &scene, &questions, &mut *encoder, robot_in_world).context("pictures")?;
    let about_model = models.about().to_owned();
    let report = DemoReport { pictures, encode, downloaded_bytes, about_model, questions };
    fs_err::write(args.out.join(MARKER), serde_json::to_vec_pretty(&report)?)?;
    Ok(report)
}

fn encode(
    out: &Path,
    scene: &mut Scene,
    engines: &Engines<'_>,
    progress: &dyn Progress,
) -> Result<EncodeSummary> {
    let written = scene.write(&out.join("scene"), progress).context("generate")?;
    let mut settings = EncodeSettings::new(written.scene, written.views, out.join("store"), true);
    settings.output.scene_name = "demo house and yard".into();
    settings.output.created_unix_secs = now_unix_secs()?;
    settings.run.memory_bytes = 1 << 30;
    settings.run.strict = true;
    // So that the robot's page shows colours, too.
    settings.cells.shards.compact_appearance = true;
    settings.cells.limits = CellLimits { max_gaussians: 16_384, ..settings.cells.limits };
    encode::encode(&settings, engines, progress, cancel_flag()?.as_ref()).context("encode")
}

/// Asks the robot, and compares its answers with the truth. `at`: the robot's position as a flag.
fn ask(
    edge: &Path,
    cache: &Path,
    scene: &Scene,
    (robot_in_world, at): (DVec3, &str),
) -> Result<Vec<Question>> {
    let mut questions = Vec::new();
    for asked in questions::questions(&scene.objects, robot_in_world, RADIUS_M) {
        let start = Instant::now();
        let mut query = Command::new(edge);
        query.args(["query", &asked.text, "--near", at, "--json", "--quiet", "--cache"]).arg(cache);
        let reply: EdgeReply = serde_json::from_value(json_of(&mut query)?).context("query")?;
        let process_ms = start.elapsed().as_secs_f64() * 1e3;
        let answer = reply.answers.into_iter().next();
        let right = match &answer {
            None => asked.truth.is_empty(),
            Some(answer) => asked.truth.iter().any(|object| {
                let (low, high) = (object.aabb_min - TOLERANCE_M, object.aabb_max + TOLERANCE_M);
                answer.position_in_world.cmpge(low).all() && answer.position_in_world.cmple(high).all()
            }),
        };
        let truth = asked.truth.iter().map(|o| (o.category.clone(), o.centre)).collect();
        questions.push(Question { text: asked.text, answer, reason: reply.reason, truth, process_ms, right });
    }
    Ok(questions)
}

/// Draws the answers, from the full-precision scores of the store, and the map.
fn draw(
    out: &Path,
    scene: &Scene,
    questions: &[Question],
    text: &mut dyn TextEncoder,
    robot_in_world: DVec3,
) -> Result<[PathBuf; 2]> {
    let reader = StoreReader::open(&out.join("store"))?;
    let threshold = reader.manifest().encoder.default_threshold;
    let mut panels = Vec::new();
    for question in questions {
        if let Some(answer) = &question.answer {
            let cosines = query::scores(&reader, &text.encode(&question.text)?)?.cosines;
            panels.push(picture::Panel { question: &question.text, answer, cosines, threshold });
        }
    }
    let paths = ["answers.png", "map.png"].map(|name| out.join(name));
    picture::answers(&scene.gaussians, &scene.views, &panels)?.save(&paths[0])?;
    let answers: Vec<DVec3> = panels.iter().map(|panel| panel.answer.position_in_world).collect();
    let cells: Vec<_> = reader.manifest().cells.iter().map(|cell| cell.bounds).collect();
    picture::map(&scene.gaussians, &cells, &answers, robot_in_world, RADIUS_M).save(&paths[1])?;
    Ok(paths)
}

/// Empties the folder of an earlier demo; refuses a folder with other files.
fn clear(out: &Path) -> Result<()> {
    if out.exists() {
        let foreign = fs_err::read_dir(out)?.next().is_some() && !out.join(MARKER).is_file();
        if foreign {
            return Err(anyhow!("{} holds other files; give an empty folder with --out", out.display()));
        }
        fs_err::remove_dir_all(out)?;
    }
    fs_err::create_dir_all(out)?;
    // Before any work, so that an interrupted demo can be started again.
    fs_err::write(out.join(MARKER), "{}")?;
    Ok(())
}

impl fmt::Display for DemoReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let encode = &self.encode;
        writeln!(
            f,
            "encoded {} Gaussians from {} photos ({} masks) in {:.1} s; the robot fetched {} kB in {} cells\n",
            encode.n_gaussians,
            encode.n_views,
            encode.n_masks,
            encode.wall_secs,
            self.downloaded_bytes / 1000,
            encode.n_cells
        )?;
        writeln!(
            f,
            "{:<24} {:<46} {:>7}  {:<7} truth",
            "question", "answer of the robot, offline", "ms", "right"
        )?;
        for q in &self.questions {
            let answer = match &q.answer {
                Some(a @ EdgeAnswer { position_in_world: p, .. }) => format!(
                    "{:.1} m away at {:.2} {:.2} {:.2}, score {:.2}",
                    a.distance.unwrap_or(f64::NAN),
                    p.x,
                    p.y,
                    p.z,
                    a.score
                ),
                None => "nothing found".into(),
            };
            let truth = q.truth.iter().map(|(name, p)| format!("{name} at {:.2} {:.2} {:.2}", p.x, p.y, p.z));
            let truth = truth.reduce(|a, b| a + ", " + &b).unwrap_or_else(|| "none".into());
            let right = if q.right { "yes" } else { "NO" };
            writeln!(f, "{:<24} {answer:<46} {:>7.0}  {right:<7} {truth}", q.text, q.process_ms)?;
        }
        writeln!(f, "\nmodel: {}", self.about_model)?;
        writeln!(f, "pictures: {}, {}", self.pictures[0].display(), self.pictures[1].display())?;
        match self.link() {
            Some(link) => writeln!(f, "page: with --keep, {link} shows the scene and asks it"),
            None => writeln!(
                f,
                "page: not in these programs; ./demo.sh builds it where Node.js and npm are installed"
            ),
        }
    }
}
