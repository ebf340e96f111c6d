//! `model.toml`, the description of a model directory: its files and their use.
//!
//! ```toml
//! name = "clip-vit-b32"            # names the space; part of the encoder id
//! about = "what it recognises, and what not"
//! dim = 512                        # components of a vector
//! licence = "MIT"
//! files_root = "."                 # folder of the files below, relative to this file's folder
//!
//! [image]
//! file = { path = "vision.onnx", sha256 = "..." }   # sha256 may be left out if the file is present; weights in a file
//!                                  # of their own: data = { path = "vision.onnx_data", sha256 = "..." }
//! input = "pixel_values"           # f32 or f16 [n,3,size_px,size_px], RGB; n may be fixed to 1
//! output = "image_embeds"          # f32 or f16 [n,dim]; default: the only output of that shape
//! size_px = 224
//! resize = "shortest-edge"         # and centre crop, as CLIPImageProcessor; or "stretch"
//! filter = "bicubic"
//! mean = [0.48, 0.46, 0.41]        # pixel value = (level / 255 - mean) / std
//! std = [0.27, 0.26, 0.28]
//! normalise = true                 # false: the model's vectors are of unit length already
//! batch = 16                       # crops in a run; default: measured (see `OnnxImageEncoder`)
//! windows = [3]                    # optional, for a model that learnt from whole photos: masks take a share of windows, a
//!                                  # third as wide and high as the photo, each overlapping the next by half
//! patches = { output = "patch_embeddings", patch_px = 14 }  # optional: a vector of the same space for each patch of the
//!                                  # square, f32 or f16 [n,(size_px/patch_px)^2,dim], row by row; photos are stretched
//!
//! [text]
//! kind = "onnx"
//! file = { path = "text.onnx" }
//! tokenizer = { path = "tokenizer.json" }
//! input_ids = "input_ids"          # i64 or i32 [1,tokens]
//! attention_mask = "attention_mask"  # left out if the model takes none
//! output = "text_embeds"           # f32 or f16 [1,dim]; default: the only output of that shape
//! max_tokens = 77
//! end_token_id = 49407             # left out if texts have no such token (TIPSv2)
//! padding = { n_tokens = 64, token_id = 1 }  # only if the model was trained on padded texts (SigLIP) or
//!                                  # takes exactly that many tokens; CLIP is faster without
//! prompt = "a photo of a {}"
//! lowercase = true                 # if the model was trained on lower case and its tokenizer keeps case (SigLIP 2)
//!
//! # alternatively, vectors of fixed phrases:
//! # [text]
//! # kind = "phrases"
//! # file = { path = "phrases.txt" }            # one a line
//! # vectors = { path = "vectors.safetensors" } # F16 or F32 [phrases,dim]
//! # tensor = "vectors"
//!
//! [text_centre]                    # optional: a text's vector is normalize(normalize(t) - centre)
//! file = { path = "vectors.safetensors" }
//! tensor = "mean"                  # F16 or F32 [dim]
//!
//! [score]
//! threshold = 0.25                 # cosine from which something counts as found; without [score],
//!                                  # every scene is calibrated by its own scores
//!
//! # alternatively, for models trained with a sigmoid: probability = 1 / (1 + exp(-(logit_scale * cosine + logit_bias)))
//! # [score]
//! # logit_scale = 117.33           # the factor itself, not its logarithm
//! # logit_bias = -12.93
//! # probability = 0.5              # from which something counts as found; default 0.5
//! ```
//!
//! Unknown fields are refused. On a robot, which has only the text files, the image file's `sha256` must be
//! recorded, because the encoder id covers both.

use std::fmt::{self, Debug};
use std::path::{Component, Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::Digest;
use slag_common::files;

use crate::ModelError;
use crate::preprocess::{Filter, Preprocess, Resize};

pub use crate::file_ref::{FileRef, Sha256};

pub const FILE_NAME: &str = "model.toml";

const MAX_PATCHES_PER_SIDE: u16 = 256;

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Description {
    pub name: String,
    /// What the model recognises and what not, for people.
    #[serde(default, skip_serializing)]
    pub about: String,
    pub dim: u32,
    #[serde(skip_serializing)]
    pub licence: String,
    /// Folder of the files, relative to the description's folder.
    #[serde(default = "here", skip_serializing)]
    pub files_root: PathBuf,
    pub image: ImageDescription,
    pub text: TextDescription,
    /// The mean subtracted from text vectors.
    pub text_centre: Option<CentreDescription>,
    #[serde(default, skip_serializing)]
    pub score: Option<ScoreDescription>,
}

pub(crate) fn here() -> PathBuf {
    ".".into()
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImageDescription {
    pub file: FileRef,
    /// The input, f32 or f16 `[n, 3, size_px, size_px]`.
    pub input: String,
    /// The output, f32 or f16 `[n, dim]`; default: the only one of that shape.
    pub output: Option<String>,
    /// Edge length of the model's input square, in pixels.
    pub size_px: u16,
    pub resize: Resize,
    #[serde(default)]
    pub filter: Filter,
    /// Subtracted from level / 255, per channel.
    pub mean: [f64; 3],
    /// Divisor after the subtraction, per channel.
    pub std: [f64; 3],
    /// Whether to scale the output to unit length.
    pub normalise: bool,
    /// Crops in a run; default: measured.
    #[serde(skip_serializing)]
    pub batch: Option<u16>,
    /// Sizes of the windows over a photo that masks take a share of, for a model that learnt from whole photos:
    /// the photo's edge over the window's. Not used where the model has patches.
    #[serde(default, skip_serializing)]
    pub windows: Vec<u8>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub patches: Option<PatchDescription>,
}

/// The vectors of an image model's patches, in the space of its texts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PatchDescription {
    /// The output, f32 or f16 `[n, per_side^2, dim]`, row by row.
    pub output: String,
    /// Edge length of a patch, in pixels of the square.
    pub patch_px: u16,
}

impl ImageDescription {
    pub fn patches_per_side(&self) -> Option<u32> {
        self.patches.as_ref().map(|patches| u32::from(self.size_px / patches.patch_px.max(1)))
    }

    pub fn preprocess(&self) -> Preprocess {
        Preprocess::new(u32::from(self.size_px), self.resize, self.filter, self.mean, self.std)
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case")]
pub enum TextDescription {
    Onnx(OnnxText),
    Phrases(PhrasesText),
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OnnxText {
    pub file: FileRef,
    /// The tokenizer, `tokenizer.json` of Hugging Face tokenizers.
    pub tokenizer: FileRef,
    /// The input for token ids, i64 or i32 `[1, tokens]`.
    pub input_ids: String,
    /// The input for the mask, i64 or i32 `[1, tokens]`, if there is one.
    pub attention_mask: Option<String>,
    /// The output, f32 or f16 `[1, dim]`; default: the only one of that shape.
    pub output: Option<String>,
    /// Length of the longest text in tokens, including begin and end tokens.
    pub max_tokens: u16,
    /// The token that ends a text; absent if texts have none (TIPSv2).
    pub end_token_id: Option<u32>,
    /// Padding after the end token, if any.
    pub padding: Option<Padding>,
    /// The encoded text, with `{}` in place of the query.
    pub prompt: String,
    /// Whether texts are turned to lower case before the tokenizer sees them.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub lowercase: bool,
}

/// Padding of texts to a fixed length.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Padding {
    /// Length of every text in tokens, including begin and end tokens.
    pub n_tokens: u16,
    pub token_id: u32,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PhrasesText {
    /// The phrases, UTF-8, one a line.
    pub file: FileRef,
    pub vectors: FileRef,
    /// The tensor in it, `[phrases][dim]`.
    pub tensor: String,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CentreDescription {
    pub file: FileRef,
    /// The tensor in it, `[dim]`.
    pub tensor: String,
}

impl Description {
    pub fn read(path: &Path) -> Result<Self, ModelError> {
        Self::parse(path, &read_text(path)?)
    }

    /// Parses and checks a description; `path` is for messages.
    pub(crate) fn parse(path: &Path, text: &str) -> Result<Self, ModelError> {
        let description: Self = parse_toml(path, text)?;
        description.check(path)?;
        Ok(description)
    }

    /// Parses and checks a description in JSON, as stores carry it; `path` is for messages.
    pub(crate) fn from_json(path: &Path, bytes: &[u8]) -> Result<Self, ModelError> {
        let advice = "use a robot program and an encoder of matching versions";
        let description: Self = serde_json::from_slice(bytes)
            .map_err(|cause| ModelError::at(path, format_args!("{cause}; {advice}")))?;
        description.check(path)?;
        Ok(description)
    }

    /// Files with their roles, image first; a weights file has its model's role.
    pub fn files(&self) -> Vec<(&'static str, &FileRef)> {
        let files = self.files_by_role().into_iter();
        files.flat_map(|(role, file)| file.parts().map(move |part| (role, part))).collect()
    }

    /// Files with their roles, image first, without weights files.
    pub(crate) fn files_by_role(&self) -> Vec<(&'static str, &FileRef)> {
        let mut files = vec![("image.model", &self.image.file)];
        match &self.text {
            TextDescription::Onnx(text) => {
                files.extend([("text.model", &text.file), ("text.tokenizer", &text.tokenizer)]);
            }
            TextDescription::Phrases(text) => {
                files.extend([("text.phrases", &text.file), ("text.vectors", &text.vectors)]);
            }
        }
        files.extend(self.text_centre.iter().map(|centre| ("text.centre", &centre.file)));
        files
    }

    pub(crate) fn files_mut(&mut self) -> Vec<&mut FileRef> {
        let mut files = vec![&mut self.image.file];
        match &mut self.text {
            TextDescription::Onnx(text) => files.extend([&mut text.file, &mut text.tokenizer]),
            TextDescription::Phrases(text) => files.extend([&mut text.file, &mut text.vectors]),
        }
        files.extend(self.text_centre.iter_mut().map(|centre| &mut centre.file));
        files
    }

    /// Identity of the space; every file must have a hash.
    pub(crate) fn encoder_id(&self) -> EncoderId {
        let definition = serde_json::to_string(self).expect("every file has its hash");
        EncoderId { name: self.name.clone(), dim: self.dim, definition }
    }

    fn check(&self, path: &Path) -> Result<(), ModelError> {
        check_common(path, &self.name, &self.files_root, &self.files())?;
        let require =
            |holds, field, found: &dyn Debug, expected| require(path, holds, field, found, expected);
        let image = &self.image;
        require((1..=1 << 16).contains(&self.dim), "dim", &self.dim, "1 to 65536")?;
        require((1..=2048).contains(&image.size_px), "image.size_px", &image.size_px, "1 to 2048")?;
        let batch = image.batch.unwrap_or(1);
        require((1..=1024).contains(&batch), "image.batch", &batch, "1 to 1024")?;
        let is_finite = image.mean.iter().all(|x| x.is_finite());
        require(is_finite, "image.mean", &image.mean, "three finite numbers")?;
        let is_positive = image.std.iter().all(|x| x.is_finite() && *x > 0.0);
        require(is_positive, "image.std", &image.std, "three numbers above 0")?;
        let fits = image.windows.len() <= 4 && image.windows.iter().all(|size| (1..=8).contains(size));
        require(fits, "image.windows", &image.windows, "at most 4 numbers from 1 to 8")?;
        if let Some(PatchDescription { patch_px, .. }) = image.patches {
            let fits = (1..=image.size_px).contains(&patch_px)
                && image.size_px.is_multiple_of(patch_px)
                && image.size_px / patch_px <= MAX_PATCHES_PER_SIDE;
            let expected = "a divisor of image.size_px that gives at most 256 patches a side";
            require(fits, "image.patches.patch_px", &patch_px, expected)?;
        }
        if let TextDescription::Onnx(text) = &self.text {
            let max_tokens = text.max_tokens;
            require(max_tokens >= 2, "text.max_tokens", &max_tokens, "2 or more")?;
            require(text.prompt.contains("{}"), "text.prompt", &text.prompt, "a text with {} in it")?;
            let n_padded = text.padding.map_or(max_tokens, |padding| padding.n_tokens);
            let expected = "text.max_tokens or more";
            require(n_padded >= max_tokens, "text.padding.n_tokens", &n_padded, expected)?;
        }
        let Some(score) = &self.score else { return Ok(()) };
        let expected = "a threshold alone, a cosine from -1 to 1, or logit_scale above 0 and logit_bias, with a \
                        probability between 0 and 1 that some cosine reaches";
        require(score.threshold().is_some(), "score", &format_args!("{{ {score} }}"), expected)
    }
}

pub(crate) fn read_toml<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, ModelError> {
    parse_toml(path, &read_text(path)?)
}

pub(crate) fn read_text(path: &Path) -> Result<String, ModelError> {
    let bytes = files::read(path).map_err(|cause| ModelError::unreadable(&cause))?;
    let text = files::text_of(&bytes).map_err(|cause| ModelError::at(path, cause))?;
    Ok(text.to_owned())
}

fn parse_toml<T: serde::de::DeserializeOwned>(path: &Path, text: &str) -> Result<T, ModelError> {
    let advice = format!("see the fields of {FILE_NAME} in its documentation");
    toml::from_str(text).map_err(|cause| ModelError::at(path, format_args!("{cause}; {advice}")))
}

/// Fails unless `holds`: field `field` is `found`, but should be `expected`.
pub(crate) fn require(
    path: &Path,
    holds: bool,
    field: &str,
    found: &dyn Debug,
    expected: &str,
) -> Result<(), ModelError> {
    match holds {
        true => Ok(()),
        false => {
            Err(ModelError::at(path, format_args!("{field} is {found:?}, expected {expected}; correct it")))
        }
    }
}

/// Checks what all descriptions have: a name, and files below a root.
pub(crate) fn check_common(
    path: &Path,
    name: &str,
    files_root: &Path,
    files: &[(&'static str, &FileRef)],
) -> Result<(), ModelError> {
    let plain_name = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    let is_plain = (1..=64).contains(&name.len()) && name.chars().all(plain_name);
    require(path, is_plain, "name", &name, "1 to 64 of A-Z a-z 0-9 - _ .")?;
    let is_relative = files_root
        .components()
        .all(|c| matches!(c, Component::Normal(_) | Component::CurDir | Component::ParentDir));
    require(path, is_relative, "files_root", &format_args!("{}", files_root.display()), "a relative path")?;
    for (role, file) in files {
        let mut components = file.path.components().peekable();
        let is_below = components.peek().is_some() && components.all(|c| matches!(c, Component::Normal(_)));
        require(
            path,
            is_below,
            role,
            &format_args!("{}", file.path.display()),
            "a relative path without ..",
        )?;
        let is_flat = file.data.as_ref().is_none_or(|data| data.data.is_none());
        require(path, is_flat, role, &format_args!("data of data"), "weights in one file")?;
    }
    Ok(())
}

/// Identifies an embedding space by everything that affects vectors, on the image and the text side.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EncoderId {
    pub name: String,
    pub dim: u32,
    /// The description of the model as JSON, with the SHA-256 of each file in place of its path and without the
    /// fields that do not affect vectors; empty for the built-in stand-in.
    pub definition: String,
}

impl EncoderId {
    /// SHA-256 of the canonical form: `slag-encoder-id 2`, a line feed, then the JSON array of name, dim and
    /// definition (a string) without spaces.
    pub fn hash(&self) -> [u8; 32] {
        let mut hasher = sha2::Sha256::new();
        hasher.update(b"slag-encoder-id 2\n");
        hasher.update(serde_json::json!([self.name, self.dim, self.definition]).to_string());
        hasher.finalize().into()
    }
}

/// Shows the name and the start of the hash.
impl fmt::Display for EncoderId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}@{}", self.name, hex::encode(&self.hash()[..6]))
    }
}

/// The interpretation of scores: as a cosine, or as the sigmoid of a scaled cosine.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScoreDescription {
    /// The cosine from which something counts as found, by default.
    threshold: Option<f32>,
    /// The factor from cosine to logit.
    logit_scale: Option<f64>,
    logit_bias: Option<f64>,
    /// The probability from which something counts as found, by default.
    probability: Option<f64>,
}

impl fmt::Display for ScoreDescription {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { threshold, logit_scale, logit_bias, probability } = *self;
        let given = [
            ("threshold", threshold.map(f64::from)),
            ("logit_scale", logit_scale),
            ("logit_bias", logit_bias),
            ("probability", probability),
        ];
        let given = given.into_iter().filter_map(|(name, value)| Some(format!("{name} = {}", value?)));
        f.write_str(&given.collect::<Vec<_>>().join(", "))
    }
}

impl ScoreDescription {
    /// Least cosine of a match: the threshold, or the solution of 1 / (1 + exp(-(scale * cosine + bias))) =
    /// probability (Zhai et al. 2023, equation 1). `None` unless the fields are those of exactly one of the two
    /// and give a cosine.
    pub fn threshold(&self) -> Option<f32> {
        let threshold = match *self {
            Self { threshold, logit_scale: None, logit_bias: None, probability: None } => {
                f64::from(threshold?)
            }
            Self { threshold: None, logit_scale, logit_bias, probability } => {
                let probability = probability.unwrap_or(0.5);
                ((probability / (1.0 - probability)).ln() - logit_bias?) / logit_scale.filter(|s| *s > 0.0)?
            }
            _ => return None,
        };
        (-1.0..=1.0).contains(&threshold).then_some(threshold as f32)
    }
}
