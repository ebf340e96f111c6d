//! `bench lift`: from files of contributions to embeddings, on a synthetic scene of any size.

mod measure;
mod options;
mod plain;
mod report;

pub use measure::{clean, run};
pub use options::LiftOptions;
pub use report::{EmbeddingModel, LiftReport, Plan, Step};
