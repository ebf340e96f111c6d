//! A robot's answers as tools of the Model Context Protocol, for language models.
//!
//! The tools query `slag-edge serve` over HTTP and change nothing there.

mod args;
mod changes;
mod find;
pub mod http;
mod list;
mod locate;
mod place;
mod stand;
mod tools;

pub use args::Args;
pub use tools::Tools;
