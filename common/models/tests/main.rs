//! Models of all kinds, but for the loading of ONNX Runtime.

mod bad_input;
mod clip;
mod colours;
mod common;
mod conse;
mod dense;
mod encoders;
mod hub;
mod sam;
mod sam2;
mod siglip2;
