//! The paper's figures for its four configurations.
//!
//! Source: Szilagyi, Engelmann, Bohg, "SLAG: Scalable Language-Augmented Gaussian Splatting", IEEE RA-L 2025, the table
//! of configurations on ScanNet scene0000_00 with 16 A100: mIoU over 19 classes and seconds.

use serde::Serialize;

/// One row of the table.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PaperRow {
    /// Points along a side of SAM's grid, and every how many images one is used.
    pub configuration: &'static str,
    /// Mean IoU over 19 classes, percent.
    pub miou_percent: f64,
    /// Seconds.
    pub seconds: f64,
}

/// The table.
pub const PAPER: [PaperRow; 4] = [
    PaperRow { configuration: "16/20", miou_percent: 28.67, seconds: 129.0 },
    PaperRow { configuration: "32/20", miou_percent: 28.86, seconds: 309.0 },
    PaperRow { configuration: "16/2", miou_percent: 31.02, seconds: 1328.0 },
    PaperRow { configuration: "32/2", miou_percent: 31.31, seconds: 3026.0 },
];
