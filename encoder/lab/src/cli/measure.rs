//! `eval` and `bench`.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::{Args, Subcommand};
use serde::Serialize;
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::{print, text_encoder_of};
use slag_encoder::html::Page;
use slag_encoder::progress::Progress;
use slag_encoder::store::StoreReader;

use crate::bench::{load, query, raster, robot, tradeoff};
use crate::eval::{defaults, encoder, goal, judge, lerf, locate, masks, relations, run, scannet};

/// `eval`.
#[derive(Debug, Args)]
pub(crate) struct EvalArgs {
    /// Writes the result as one HTML file, too.
    #[arg(long, global = true, value_name = "FILE")]
    html: Option<PathBuf>,
    #[command(subcommand)]
    command: EvalCommand,
}

#[derive(Debug, Subcommand)]
enum EvalCommand {
    /// Evaluates a store of a scene with a label for every Gaussian, such as those of `generate scene`.
    Labelled(judge::LabelledArgs),
    /// Compares the plain average with the default on labelled scenes, with true and automatic masks.
    Defaults(run::ScenesArgs),
    /// Judges segmenters without words: by labelled photos, by coverage, and by agreement between views.
    Masks(masks::MasksArgs),
    /// Evaluates a store on LangSplat's labels of LERF scenes (LERF-OVS).
    Lerf(lerf::LerfArgs),
    /// Evaluates stores on ScanNet's labelled meshes with OpenGaussian's protocol.
    Scannet(scannet::ScannetArgs),
    /// Evaluates an encoder on crops of generated things: noun, colour and material.
    Encoder(encoder::EncoderArgs),
    /// Asks the robot's program for places to stand near the things of generated scenes, and compares with their
    /// true surfaces.
    Goal(goal::GoalArgs),
    /// Finds the cameras of photos that a map of landmarks has not seen; photos of the other scenes must be lost.
    Locate(locate::LocateArgs),
    /// Asks the robot's program for things by their relations in generated scenes, beside the plain phrase and the
    /// noun.
    Relations(relations::RelationsArgs),
}

pub(super) fn eval(args: &EvalArgs, progress: &dyn Progress, json: bool) -> Result<Exit> {
    let output = Output { json, html: args.html.as_deref() };
    match &args.command {
        EvalCommand::Labelled(args) => {
            let reader = StoreReader::open(&args.store)?;
            let mut encoder = text_encoder_of(&reader, &args.models)?;
            let truth = run::truth_of(&reader, &args.truth)?;
            output.print(&judge::judge(&reader, &truth, &mut *encoder, &args.judge)?)
        }
        EvalCommand::Defaults(args) => output.print(&defaults::run(args, progress)?),
        EvalCommand::Masks(args) => output.print(&masks::run(args, progress)?),
        EvalCommand::Lerf(args) => {
            let report = lerf::run(args)?;
            output.print(&report)?;
            Ok(if report.is_complete() { Exit::Done } else { Exit::Partly })
        }
        EvalCommand::Scannet(args) => {
            let report = scannet::run(args)?;
            output.print(&report)?;
            Ok(if report.is_complete() { Exit::Done } else { Exit::Partly })
        }
        EvalCommand::Encoder(args) => output.print(&encoder::run(args, progress)?),
        EvalCommand::Goal(args) => output.print(&goal::run(args, progress)?),
        EvalCommand::Locate(args) => output.print(&locate::run(args, progress)?),
        EvalCommand::Relations(args) => output.print(&relations::run(args, progress)?),
    }
}

/// Where a result goes: the terminal, and a page.
struct Output<'a> {
    json: bool,
    html: Option<&'a Path>,
}

impl Output<'_> {
    fn print(&self, result: &(impl Serialize + Display)) -> Result<Exit> {
        if let Some(path) = self.html {
            let mut page = Page::new("Evaluation");
            page.plain(&result.to_string());
            page.value(&serde_json::to_value(result)?);
            fs_err::write(path, page.finish())?;
        }
        print(self.json, result, result)?;
        Ok(Exit::Done)
    }
}

/// `bench`.
#[derive(Debug, Subcommand)]
pub(crate) enum BenchCommand {
    /// Times answers of the robot's engine from a cache, without text model and HTTP; prints JSON.
    Query(query::QueryArgs),
    /// Times a text model; prints JSON.
    Text(query::TextArgs),
    /// Loads a robot's service with more queries than it can answer; prints JSON.
    Load(load::LoadArgs),
    /// Fills the paper's table of query times on the robot, with other engines on the same vectors beside it.
    Robot(robot::RobotArgs),
    /// Times the weights of a view: each device on generated scenes, or on one of yours.
    Raster(raster::RasterArgs),
    /// Measures cost and accuracy of settings of `encode` on labelled scenes: table, Pareto front and plots.
    Tradeoff(tradeoff::TradeoffArgs),
}

pub(super) fn bench(command: &BenchCommand, progress: &dyn Progress, json: bool) -> Result<Exit> {
    let done_unless = |is_partly| if is_partly { Exit::Partly } else { Exit::Done };
    match command {
        BenchCommand::Query(args) => print_json(&query::run(args)?),
        BenchCommand::Text(args) => print_json(&query::time_texts(args)?),
        BenchCommand::Load(args) => print_json(&load::run(args)?),
        BenchCommand::Robot(args) => {
            let report = robot::run(args, progress)?;
            print(json, &report, &report)?;
            Ok(done_unless(!report.not_run.is_empty()))
        }
        BenchCommand::Raster(args) => {
            let report = raster::run(args, progress)?;
            print(json, &report, &report)?;
            Ok(Exit::Done)
        }
        BenchCommand::Tradeoff(args) => {
            let report = tradeoff::run(args, progress)?;
            print(json, &report, &report)?;
            Ok(done_unless(!report.left_out.is_empty()))
        }
    }
}

fn print_json(report: &impl Serialize) -> Result<Exit> {
    print(true, report, "")?;
    Ok(Exit::Done)
}
