//! Measurements: each returns a report that describes the machine.

mod dump;
pub mod goal;
pub mod http;
pub mod load;
mod machine;
pub mod objects;
pub mod pause;
pub mod query;
pub mod robot;
mod scene;
pub mod text;
mod times;
mod timing;
mod vectors;

pub use dump::{DumpError, dump_ids, dump_vectors};
pub use machine::Machine;
pub use times::Percentiles;
pub use timing::{Kind, Settings, Timing};
pub use vectors::make_queries;
