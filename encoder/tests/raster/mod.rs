//! The rasteriser and the scene check against recorded data and a brute-force oracle.

mod backends;
mod brute_force;
mod check;
mod extremes;
mod fixtures;
mod frames;
mod gpu;
mod gsplat;
mod oracle;
mod rejected;
mod scenes;
mod table;
