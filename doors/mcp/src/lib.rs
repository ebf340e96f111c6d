//! A robot's answers as tools of the Model Context Protocol, for language models.
//!
//! The tools query `slag-edge serve` over HTTP and change nothing there.

mod args;
mod changes;
mod find;
pub mod http;
mod list;
mod locate;
mod picture;
mod place;
mod stand;
mod stdin;
mod tools;

pub use args::Args;
pub use locate::MAX_MESSAGE_BYTES;
pub use stdin::ShortTexts;
pub use tools::Tools;
