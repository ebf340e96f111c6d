//! Settings of every engine's graph.

/// Edges of a node.
pub const EDGES: usize = 16;
/// Candidates while the graph is built.
pub const CANDIDATES: usize = 100;
