//! `eval` and `bench`.

use anyhow::Result;
use clap::Subcommand;
use serde::Serialize;
use slag_encoder::cli::Exit;
use slag_encoder::cli::common::{print, text_encoder_of};
use slag_encoder::progress::Progress;
use slag_encoder::store::StoreReader;
use std::fmt::Display;

use crate::bench::{query, raster, robot, tradeoff};
use crate::eval::{
    all, defaults, encoder, goal, judge, lerf, locate, masks, names, relations, run, scannet, splat_only,
};

/// `eval`.
#[derive(Debug, Subcommand)]
pub(crate) enum EvalCommand {
    /// Evaluates a store of a scene with a label for every Gaussian, such as those of `generate scene`.
    Labelled(judge::LabelledArgs),
    /// Prints the tables of `defaults` and `masks` on labelled scenes, of `relations` and `goal` on generated ones.
    All(run::ScenesArgs),
    /// Compares the plain average with the default on labelled scenes, with true and automatic masks.
    Defaults(run::ScenesArgs),
    /// Compares drawings of planned views with as many photos on labelled scenes, with automatic masks.
    SplatOnly(run::ScenesArgs),
    /// Judges segmenters without words: by labelled photos, by coverage, and by agreement between views.
    Masks(masks::MasksArgs),
    /// Judges the names of objects and their confidences by labels.
    Names(names::NamesArgs),
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

pub(super) fn eval(command: &EvalCommand, progress: &dyn Progress, json: bool) -> Result<Exit> {
    match command {
        EvalCommand::Labelled(args) => {
            let reader = StoreReader::open(&args.store)?;
            let mut encoder = text_encoder_of(&reader, &args.models)?;
            let truth = run::truth_of(&reader, &args.truth)?;
            show(json, &judge::judge(&reader, &truth, &mut *encoder, &args.judge)?, true)
        }
        EvalCommand::All(args) => show(json, &all::run(args, progress)?, true),
        EvalCommand::Defaults(args) => show(json, &defaults::run(args, progress)?, true),
        EvalCommand::SplatOnly(args) => show(json, &splat_only::run(args, progress)?, true),
        EvalCommand::Masks(args) => show(json, &masks::run(args, progress)?, true),
        EvalCommand::Names(args) => show(json, &names::run(args)?, true),
        EvalCommand::Lerf(args) => {
            let report = lerf::run(args)?;
            show(json, &report, report.is_complete())
        }
        EvalCommand::Scannet(args) => {
            let report = scannet::run(args)?;
            show(json, &report, report.is_complete())
        }
        EvalCommand::Encoder(args) => show(json, &encoder::run(args, progress)?, true),
        EvalCommand::Goal(args) => show(json, &goal::run(args, progress)?, true),
        EvalCommand::Locate(args) => show(json, &locate::run(args, progress)?, true),
        EvalCommand::Relations(args) => show(json, &relations::run(args, progress)?, true),
    }
}

/// Prints a result; the exit code says whether it is complete.
fn show(json: bool, result: &(impl Serialize + Display), is_complete: bool) -> Result<Exit> {
    print(json, result, result)?;
    Ok(if is_complete { Exit::Done } else { Exit::Partly })
}

/// `bench`.
#[derive(Debug, Subcommand)]
pub(crate) enum BenchCommand {
    /// Times answers of the robot's engine from a cache, without text model and HTTP; prints JSON.
    Query(query::QueryArgs),
    /// Times a text model; prints JSON.
    Text(query::TextArgs),
    /// Fills the paper's table of query times on the robot, with other engines on the same vectors beside it.
    Robot(robot::RobotArgs),
    /// Times the weights of a view: each device on generated scenes, or on one of yours.
    Raster(raster::RasterArgs),
    /// Measures cost and accuracy of settings of `encode` on labelled scenes: table and Pareto front.
    Tradeoff(tradeoff::TradeoffArgs),
}

pub(super) fn bench(command: &BenchCommand, progress: &dyn Progress, json: bool) -> Result<Exit> {
    match command {
        BenchCommand::Query(args) => print_json(&query::run(args)?),
        BenchCommand::Text(args) => print_json(&query::time_texts(args)?),
        BenchCommand::Robot(args) => {
            let report = robot::run(args, progress)?;
            show(json, &report, report.not_run.is_empty())
        }
        BenchCommand::Raster(args) => show(json, &raster::run(args, progress)?, true),
        BenchCommand::Tradeoff(args) => {
            let report = tradeoff::run(args, progress)?;
            show(json, &report, report.left_out.is_empty())
        }
    }
}

fn print_json(report: &impl Serialize) -> Result<Exit> {
    print(true, report, "")?;
    Ok(Exit::Done)
}
