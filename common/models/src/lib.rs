//! Model directories: image and text encoders that share one embedding space.
//!
//! A [`ModelDir`] is described by one TOML file ([`description`]). Its image side turns crops into vectors
//! ([`ImageEncoder`]); its text side turns queries into vectors of the same space ([`TextEncoder`]). Both use ONNX
//! Runtime ([`session`]), a list of phrases ([`phrases`]) or colours ([`colours`]). [`ModelDir::embedded`] opens the
//! encoders that are part of the program. [`EncoderId`] identifies the space, so that a robot can refuse vectors of
//! another one. [`sam`] proposes masks; [`boundaries`] predicts where objects end.
//!
//! [`hub`] pulls public models; [`commands`] is its command line, shared by both programs.
//!
//! Nothing here prints, reads the environment or starts threads, except [`restart`] and the prompt of
//! [`commands::ask`].

mod bound;
pub mod boundaries;
pub mod clean;
pub mod colours;
pub mod commands;
pub mod description;
pub mod download;
mod encoder;
mod error;
mod file_ref;
mod floats;
pub mod gpus;
pub mod help;
pub mod hub;
pub mod image;
mod levels;
mod model_dir;
pub mod names;
pub mod phrases;
mod placement;
pub mod preprocess;
mod provider;
pub mod question;
pub mod restart;
pub mod sam;
pub mod session;
mod synonyms;
pub mod tensors;
pub mod text;
mod text_side;
mod words;

pub use description::EncoderId;
pub use encoder::{Crop, ImageEncoder, TextEncoder};
pub use error::{InferenceError, ModelError};
pub use file_ref::ModelFile;
pub use floats::Floats;
pub use model_dir::ModelDir;
pub use placement::Placement;
pub use provider::Provider;
pub use question::{one_to_find, words_to_find};
pub use session::{SessionOptions, find_runtime};
pub use synonyms::KnownPhrases;
pub use text_side::{TextSide, TextSideError};
pub use words::{everyday_nouns, everyday_texts, words};
