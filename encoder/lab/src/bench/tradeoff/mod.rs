//! `bench tradeoff`: cost and accuracy of each choice of settings, on labelled scenes.
//!
//! For each point of a [`grid`], the programs encode, evaluate and query the scene as a user runs them, each in its own
//! process, so that threads and memory are those of the flags. A point leaves one JSON file; points with a file are not
//! measured again. Points with the same contributions share a store: the seconds of the views are those of the first
//! point, all other seconds are each point's own.

mod costs;
mod error;
mod figures;
mod front;
pub mod grid;
mod means;
mod measure;
mod paper;
mod picture;
mod prediction;
mod programs;
mod report;
#[cfg(test)]
mod tests;

pub use error::TradeoffError;
pub use figures::Figures;
pub use grid::{Equipment, Grid, LabelledScene, Point};
pub use measure::{TradeoffSettings, run};
pub use programs::Programs;
pub use report::TradeoffReport;
