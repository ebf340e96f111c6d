//! The rasteriser and the scene check against recorded data and a brute-force oracle.

mod check;
mod fixtures;
mod gpu;
mod gsplat;
mod oracle;
