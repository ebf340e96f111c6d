//! The whole system in one run: generate, encode, serve, fetch as a robot would, ask, compare with the truth.

mod picture;

use std::fmt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use anyhow::{Context, Result, anyhow};
use glam::DVec3;
use serde::{Deserialize, Serialize};
use slag_models::{ModelDir, SessionOptions};

use crate::embed::Background;
use crate::encode::{self, EncodeSettings, EncodeSummary, Masks, ViewOrder};
use crate::generate::grammar::{self, SceneKind};
use crate::generate::{Scene, TrueObject};
use slag_common::shard::Profile;

use crate::lift::Aggregation;
use crate::palette::PaletteSettings;
use crate::progress::Progress;
use crate::publish::serve::{self, Limits};
use crate::raster::{CpuRasterizer, WeightKind};
use crate::shard::ShardSettings;
use crate::shard::cells::CellLimits;
use crate::shard::positions::PositionError;
use crate::{query, store::StoreReader};

/// Photos of the room.
const N_VIEWS: u32 = 36;
/// Where the robot stands: the middle of the room.
const ROBOT_IN_WORLD: DVec3 = DVec3::new(3.5, 2.75, 0.0);
/// What the robot fetches around it.
const RADIUS_M: f64 = 50.0;
/// How far an answer's centre may lie outside the true box: a mask's edge takes in some of what is behind.
const TOLERANCE_M: f64 = 0.25;
/// Marks a folder as a demo's, which may be emptied.
const MARKER: &str = "demo.json";

/// What is asked, and the colour that the answer truly has. Nothing in the room is pink.
const QUESTIONS: [(&str, &str); 8] = [
    ("something red", "red"),
    ("blue", "blue"),
    ("the yellow one", "yellow"),
    ("green", "green"),
    ("a purple thing", "purple"),
    ("black", "black"),
    ("orange", "orange"),
    ("pink", "pink"),
];

/// How to run the demo.
pub struct DemoOptions {
    /// Folder to work in.
    pub out: PathBuf,
    /// Chooses the room.
    pub seed: u64,
    /// The robot's program.
    pub edge: PathBuf,
    /// Creation time to sign.
    pub created_unix_secs: u64,
}

/// A finished demo.
pub struct Demo {
    /// What came of it.
    pub report: DemoReport,
    edge: PathBuf,
    cache: PathBuf,
}

/// What came of a demo.
#[derive(Debug, Serialize)]
pub struct DemoReport {
    /// The answers, drawn.
    pub picture: PathBuf,
    /// What the encode did.
    pub encode: EncodeSummary,
    /// Bytes that the robot downloaded.
    pub downloaded_bytes: u64,
    /// The model's own words about itself.
    pub about_model: &'static str,
    /// The questions in turn.
    pub questions: Vec<Question>,
}

/// A question and its answer.
#[derive(Debug, Serialize)]
pub struct Question {
    /// What was asked.
    pub text: String,
    /// The best answer.
    pub answer: Option<EdgeAnswer>,
    /// Why there is none.
    pub reason: Option<serde_json::Value>,
    /// What truly is there: name, and the middle of its box.
    pub truth: Vec<(String, DVec3)>,
    /// Milliseconds, from the program's start to its end.
    pub process_ms: f64,
    /// Whether the answer is the truth.
    pub right: bool,
}

/// What `slag-edge query --json` prints, as far as the demo reads it.
#[derive(Debug, Deserialize)]
struct EdgeReply {
    answers: Vec<EdgeAnswer>,
    reason: Option<serde_json::Value>,
}

/// A cluster of matching Gaussians.
#[derive(Clone, Debug, Deserialize, Serialize)]
pub struct EdgeAnswer {
    /// Its place.
    pub position_in_world: DVec3,
    /// Edge lengths of its box.
    pub size: DVec3,
    /// Its score.
    pub score: f32,
    /// Its Gaussians.
    pub n_gaussians: u64,
    /// Distance from the robot.
    pub distance: Option<f64>,
}

#[derive(Deserialize)]
struct FetchReply {
    downloaded: Tally,
}

#[derive(Deserialize)]
struct Tally {
    bytes: u64,
}

impl DemoReport {
    /// Returns whether every answer is the truth.
    pub fn all_right(&self) -> bool {
        self.questions.iter().all(|q| q.right)
    }
}

impl Demo {
    /// Serves the robot's queries until it is stopped.
    ///
    /// # Errors
    /// If the program cannot be started.
    pub fn keep(&self) -> Result<()> {
        let status = Command::new(&self.edge).arg("serve").arg("--cache").arg(&self.cache).status();
        status.with_context(|| format!("cannot start {}", self.edge.display()))?;
        Ok(())
    }
}

/// Runs the demo.
///
/// # Errors
/// Whatever step fails, with its name.
pub async fn run(options: &DemoOptions, progress: &dyn Progress, cancel: &AtomicBool) -> Result<Demo> {
    if !options.edge.is_file() {
        return Err(anyhow!(
            "{} is not there; build it with: cargo build --release --bin slag-edge",
            options.edge.display()
        ));
    }
    clear(&options.out)?;
    let store = options.out.join("store");
    let cache = options.out.join("cache");

    let nouns = grammar::nouns(None).context("generate")?;
    let mut scene = Scene::new(&[SceneKind::Room], options.seed, N_VIEWS, &nouns);
    let written = tokio::task::block_in_place(|| scene.write(&options.out.join("scene"), progress))
        .context("generate")?;
    let models = ModelDir::builtin();
    let settings = EncodeSettings {
        scene: written.scene,
        views: written.views,
        images: None,
        masks: Masks::Auto,
        store: store.clone(),
        scene_name: "demo room".into(),
        metric: true,
        geo: None,
        views_limit: None,
        view_order: ViewOrder::Names,
        time_budget: None,
        raster_width_px: None,
        background: Background::White,
        min_mask_px: 200,
        weights: WeightKind::Blend,
        aggregation: Aggregation::REFINED,
        mask_noise: None,
        keep_views: false,
        threads: rayon::current_num_threads(),
        memory_bytes: 1 << 30,
        strict: true,
        restart: false,
        // Small cells, so that the demo has several.
        cells: CellLimits { max_gaussians: 16_384, max_width: Some(25.0) },
        shards: ShardSettings {
            profiles: Profile::ALL.to_vec(),
            palette: PaletteSettings::default(),
            position_error: PositionError::default_for(true),
        },
        created_unix_secs: options.created_unix_secs,
        expires_unix_secs: None,
    };
    // The built-in models need no runtime library.
    let session = SessionOptions::new(PathBuf::new());
    let summary = tokio::task::block_in_place(|| {
        encode::encode(&settings, &models, &session, &CpuRasterizer, progress, cancel)
    })
    .context("encode")?;

    let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
    let (listens, listening) = tokio::sync::oneshot::channel();
    let serving = tokio::spawn(async move {
        // Errors of the channels mean that the other end is gone: the demo failed and says why itself.
        let on_listening = |address| {
            let _ = listens.send(address);
        };
        let stopped = async {
            let _ = stopped.await;
        };
        serve::serve(&store, ([127, 0, 0, 1], 0).into(), Limits::default(), on_listening, stopped).await
    });
    let Ok(address) = listening.await else {
        serving.await.context("serve")?.context("serve")?;
        return Err(anyhow!("serve: ended before it listened"));
    };
    let url = format!("http://{address}");
    let at = format!("{},{},{}", ROBOT_IN_WORLD.x, ROBOT_IN_WORLD.y, ROBOT_IN_WORLD.z);
    let radius = RADIUS_M.to_string();
    let fetch = ["fetch", "--from", &url, "--at", &at, "--radius", &radius];
    let fetched: FetchReply = edge(options, &cache, &fetch).context("fetch")?;
    // From here on there is no network.
    let _ = stop.send(());
    serving.await.context("serve")?.context("serve")?;

    let mut questions = Vec::new();
    for (text, colour) in QUESTIONS {
        let start = Instant::now();
        let reply: EdgeReply = edge(options, &cache, &["query", text, "--near", &at]).context("query")?;
        let process_ms = start.elapsed().as_secs_f64() * 1e3;
        let truth: Vec<&TrueObject> = scene.objects.iter().filter(|o| o.colours.contains(&colour)).collect();
        let answer = reply.answers.into_iter().next();
        let right = match &answer {
            None => truth.is_empty(),
            Some(answer) => truth.iter().any(|object| {
                let (low, high) = (object.aabb_min - TOLERANCE_M, object.aabb_max + TOLERANCE_M);
                answer.position_in_world.cmpge(low).all() && answer.position_in_world.cmple(high).all()
            }),
        };
        let truth = truth.iter().map(|o| (o.category.clone(), (o.aabb_min + o.aabb_max) / 2.0)).collect();
        questions.push(Question {
            text: text.into(),
            answer,
            reason: reply.reason,
            truth,
            process_ms,
            right,
        });
    }
    let picture =
        tokio::task::block_in_place(|| draw_answers(options, &scene, &questions)).context("picture")?;
    let report = DemoReport {
        picture,
        encode: summary,
        downloaded_bytes: fetched.downloaded.bytes,
        about_model: slag_models::builtin::ABOUT,
        questions,
    };
    fs_err::write(options.out.join(MARKER), serde_json::to_vec_pretty(&report)?)?;
    Ok(Demo { report, edge: options.edge.clone(), cache })
}

/// Draws what was found, from the full-precision scores of the store.
fn draw_answers(options: &DemoOptions, scene: &Scene, questions: &[Question]) -> Result<PathBuf> {
    let reader = StoreReader::open(&options.out.join("store"))?;
    let mut text = ModelDir::builtin().text_encoder(&SessionOptions::new(PathBuf::new()))?;
    let threshold = reader.manifest().encoder.default_threshold;
    let mut panels = Vec::new();
    for question in questions {
        if let Some(answer) = &question.answer {
            let cosines = query::scores(&reader, &text.encode(&question.text)?)?.cosines;
            panels.push(picture::Panel { answer, cosines, threshold });
        }
    }
    let path = options.out.join("answers.png");
    picture::draw(&scene.gaussians, &scene.views, &panels)?.save(&path)?;
    Ok(path)
}

/// Empties the folder of an earlier demo; refuses a folder that holds anything else.
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

/// Runs the robot's program on its cache and reads what it prints.
fn edge<T: for<'a> Deserialize<'a>>(options: &DemoOptions, cache: &Path, args: &[&str]) -> Result<T> {
    let mut command = Command::new(&options.edge);
    command
        .args(args)
        .arg("--cache")
        .arg(cache)
        .args(["--json", "--quiet"])
        .stdin(Stdio::null())
        .stderr(Stdio::inherit());
    let output = tokio::task::block_in_place(|| command.output())
        .with_context(|| format!("cannot start {}", options.edge.display()))?;
    let text = String::from_utf8_lossy(&output.stdout);
    if !output.status.success() {
        return Err(anyhow!("slag-edge {}: {}", args.join(" "), text.trim()));
    }
    serde_json::from_str(&text).with_context(|| format!("slag-edge {}: {}", args.join(" "), text.trim()))
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
        writeln!(f, "{:<16} {:<44} {:<32} right", "question", "answer of the robot, offline", "truth")?;
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
            let truth = truth.reduce(|a, b| a + ", " + &b).unwrap_or_else(|| "none in the room".into());
            writeln!(f, "{:<16} {answer:<44} {truth:<32} {}", q.text, if q.right { "yes" } else { "NO" })?;
        }
        writeln!(f, "\nmodel: {}", self.about_model)?;
        writeln!(f, "picture: {}", self.picture.display())
    }
}
