use std::{
    io,
    path::{Path, PathBuf},
    sync::{Arc, Mutex, PoisonError},
};

use sha2::{Digest, Sha256};

/// Files of `embedded/`, compiled in.
mod embedded {
    pub const DESCRIPTION: &str = include_str!("../embedded/model.toml");
    pub const IMAGE: &[u8] = include_bytes!("../embedded/image.onnx");
    pub const TEXT: &[u8] = include_bytes!("../embedded/text.onnx");
    pub const TOKENIZER: &[u8] = include_bytes!("../embedded/tokenizer.json");
    /// Nouns that the models learnt, one per line.
    pub const NOUNS: &str = include_str!("../embedded/nouns.txt");
    /// Words that they learnt for several nouns, one per line.
    pub const KINDS: &str = include_str!("../embedded/kinds.txt");
}

use crate::{
    EncoderId, ImageEncoder, ModelError, ModelFile, SessionOptions, TextEncoder, colours,
    description::{self, Description, FILE_NAME, FileRef, TextDescription},
    image::OnnxImageEncoder,
    phrases::PhraseEncoder,
    preprocess::Preprocess,
    tensors,
    text::OnnxTextEncoder,
    text_side::{TextSide, TextSideError},
};

/// A pair of image and text encoders: a described directory, or built in.
#[derive(Clone, Debug)]
pub struct ModelDir {
    id: EncoderId,
    /// `None` for the stand-in of colours.
    files: Option<Files>,
}

#[derive(Clone, Debug)]
struct Files {
    description: Description,
    /// Its TOML; empty for a model from a store, which cannot encode images.
    document: String,
    /// `None` for the embedded encoders.
    root: Option<PathBuf>,
    /// Batch size of images, once it is measured.
    batch: Arc<Mutex<Option<usize>>>,
}

impl Files {
    /// Returns a file, checked against its hash if recorded; `embedded`: its compiled-in bytes.
    fn open(&self, file: &FileRef, embedded: &'static [u8]) -> Result<ModelFile, ModelError> {
        match &self.root {
            None => Ok(ModelFile::embedded(&file.path, embedded)),
            Some(root) => Ok(checked(root, file)?.into()),
        }
    }

    /// Returns the path of a file that embedded models do not have.
    fn on_disk(&self, file: &FileRef) -> Result<PathBuf, ModelError> {
        self.root.as_ref().map_or(Ok(file.path.clone()), |root| checked(root, file))
    }

    /// The description with the hash of each file; the embedded one records them all.
    fn hashed(&self) -> Result<Description, ModelError> {
        let mut hashed = self.description.clone();
        let root = self.root.as_deref().unwrap_or(Path::new(""));
        for file in hashed.files_mut() {
            file.sha256 = Some(description::Sha256(sha256_of(root, file)?));
            if let Some(data) = &mut file.data {
                data.sha256 = Some(description::Sha256(sha256_of(root, data)?));
            }
        }
        Ok(hashed)
    }
}

impl ModelDir {
    /// Opens a directory with a [`description`](crate::description) in `model.toml`. Files with a recorded hash
    /// are read and checked only when an encoder needs them.
    pub fn open(path: &Path) -> Result<Self, ModelError> {
        let file = path.join(FILE_NAME);
        let document = description::read_text(&file)?;
        let description = Description::parse(&file, &document)?;
        let root = path.join(&description.files_root);
        Self::with(description, document, Some(root))
    }

    /// The embedded encoders: trained on generated scenes, poor on real photos (`embedded/CARD.md`); need ONNX Runtime.
    pub fn embedded() -> Result<Self, ModelError> {
        let description = Description::parse(Path::new("(embedded)/model.toml"), embedded::DESCRIPTION)?;
        Self::with(description, embedded::DESCRIPTION.to_owned(), None)
    }

    /// Opens the text side from a store. `description`: [`TextSide::description`]; `path`: of the description, for
    /// messages; `folder`: has its files, named by hash. Their content is checked when the encoder is opened.
    pub fn carried(description: &[u8], path: &Path, folder: &Path) -> Result<Self, ModelError> {
        Self::with(Description::from_json(path, description)?, String::new(), Some(folder.to_owned()))
    }

    pub fn text_side(&self) -> Result<TextSide, TextSideError> {
        let Some(files) = self.files.as_ref().filter(|files| files.root.is_some()) else {
            return Err(TextSideError(format!(
                "{} is part of every robot's program, so a store need not carry it; leave --text-model out",
                self.id.name
            )));
        };
        TextSide::new(&self.id, &files.document, &files.hashed()?, |file| files.open(file, &[]))
    }

    fn with(description: Description, document: String, root: Option<PathBuf>) -> Result<Self, ModelError> {
        let files = Files { description, document, root, batch: Arc::default() };
        Ok(Self { id: files.hashed()?.encoder_id(), files: Some(files) })
    }

    /// The stand-in for colours and shapes, which needs no files and no ONNX Runtime.
    pub fn colours() -> Self {
        let id =
            EncoderId { name: colours::NAME.to_owned(), dim: colours::DIM as u32, definition: String::new() };
        Self { id, files: None }
    }

    fn description(&self) -> Option<&Description> {
        self.files.as_ref().map(|files| &files.description)
    }

    pub fn encoder_id(&self) -> &EncoderId {
        &self.id
    }

    pub fn dim(&self) -> usize {
        self.id.dim as usize
    }

    /// What the model can recognise and what not, for people.
    pub fn about(&self) -> &str {
        self.description().map_or(colours::ABOUT, |description| &description.about)
    }

    /// Least cosine of a match, if the model states one.
    pub fn threshold(&self) -> Option<f32> {
        match self.description() {
            None => Some(colours::THRESHOLD),
            Some(description) => description.score.as_ref()?.threshold(),
        }
    }

    /// Steps from a crop to the image encoder's square, which has the same vector; `None` if any size is accepted.
    pub fn preprocess(&self) -> Option<Preprocess> {
        self.description().map(|description| description.image.preprocess())
    }

    /// Patches with vectors along each side of a photo; `None` without any.
    pub fn patches_per_side(&self) -> Option<u32> {
        self.description()?.image.patches_per_side()
    }

    /// Sizes of windows of a photo that masks take a share of; empty if the model should see objects alone.
    pub fn windows(&self) -> &[u8] {
        self.description().map_or(&[], |description| &description.image.windows)
    }

    pub fn image_encoder(&self, options: &SessionOptions) -> Result<Box<dyn ImageEncoder>, ModelError> {
        let Some(files) = &self.files else { return Ok(Box::new(colours::ColourShape)) };
        let Description { name, image, .. } = &files.description;
        let file = files.open(&image.file, embedded::IMAGE)?;
        let mut encoder = OnnxImageEncoder::open(name, self.dim(), &file, image, options)?;
        // One encoder measures while others wait, because parallel runs would disturb the timing.
        encoder.settle_batch(&mut files.batch.lock().unwrap_or_else(PoisonError::into_inner))?;
        Ok(Box::new(encoder))
    }

    /// Loads ONNX Runtime only if the text side is ONNX.
    pub fn text_encoder(&self, options: &SessionOptions) -> Result<Box<dyn TextEncoder>, ModelError> {
        let Some(files) = &self.files else { return Ok(Box::new(colours::ColourShape)) };
        let (description, dim) = (&files.description, self.dim());
        let name = &description.name;
        let centre = match &description.text_centre {
            None => None,
            Some(centre) => Some(tensors::read(&files.on_disk(&centre.file)?, &centre.tensor, None, dim)?),
        };
        Ok(match &description.text {
            TextDescription::Onnx(text) => {
                let model = files.open(&text.file, embedded::TEXT)?;
                let tokenizer = files.open(&text.tokenizer, embedded::TOKENIZER)?;
                let encoder = OnnxTextEncoder::open(name, dim, [&model, &tokenizer], text, centre, options)?;
                Box::new(match files.root {
                    None => encoder.with_words(embedded::NOUNS.lines(), embedded::KINDS.lines()),
                    Some(_) => encoder,
                })
            }
            TextDescription::Phrases(text) => {
                let (phrases, vectors) = (files.on_disk(&text.file)?, files.on_disk(&text.vectors)?);
                Box::new(PhraseEncoder::open(dim, &phrases, (&vectors, &text.tensor), centre)?)
            }
        })
    }
}

/// Returns the recorded hash, or computes it.
pub(crate) fn sha256_of(files_root: &Path, file: &FileRef) -> Result<[u8; 32], ModelError> {
    let path = files_root.join(&file.path);
    match file.sha256 {
        Some(sha256) => Ok(sha256.0),
        None => hash_file(&path).map_err(|cause| match cause.kind() {
            io::ErrorKind::NotFound => {
                let fault = format!("absent, and {FILE_NAME} records no sha256 for it");
                ModelError::at(&path, format_args!("{fault}; record it or put the file there"))
            }
            _ => ModelError::unreadable(&cause),
        }),
    }
}

/// Returns the path of `file`, checked with its weights against recorded hashes.
pub(crate) fn checked(files_root: &Path, file: &FileRef) -> Result<PathBuf, ModelError> {
    for part in file.parts() {
        let path = files_root.join(&part.path);
        let Some(expected) = part.sha256 else { continue };
        let found = hash_file(&path).map_err(|cause| ModelError::unreadable(&cause))?;
        if found != expected.0 {
            return Err(other_hash(&path, expected, description::Sha256(found)));
        }
    }
    Ok(files_root.join(&file.path))
}

pub(crate) fn other_hash(
    path: &Path,
    expected: description::Sha256,
    found: description::Sha256,
) -> ModelError {
    let advice = "fetch the file again or correct the description";
    ModelError::at(path, format_args!("SHA-256 is {found}, expected {expected}; {advice}"))
}

pub(crate) fn hash_file(path: &Path) -> io::Result<[u8; 32]> {
    let mut hasher = Sha256::new();
    io::copy(&mut fs_err::File::open(path)?, &mut hasher)?;
    Ok(hasher.finalize().into())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn id_of(description: &str) -> [u8; 32] {
        let description =
            Description::parse(Path::new("model.toml"), description).expect("a valid description");
        let model = ModelDir::with(description, String::new(), None);
        model.expect("every hash is recorded").encoder_id().hash()
    }

    /// The id depends on everything that affects vectors, and not on texts for people, paths or batch sizes.
    #[test]
    fn the_encoder_id_covers_the_description() {
        let text = embedded::DESCRIPTION;
        let id = id_of(text);
        for (from, to) in [
            ("resize = \"pad\"", "resize = \"stretch\""),
            ("filter = \"bicubic\"", "filter = \"bilinear\""),
            ("mean = [0.5,", "mean = [0.25,"),
            ("std = [0.5,", "std = [0.25,"),
            ("normalise = true", "normalise = false"),
            ("size_px = 64", "size_px = 65"),
            ("prompt = \"{}\"", "prompt = \"a {}\""),
            ("max_tokens = 16", "max_tokens = 15"),
        ] {
            assert!(text.contains(from), "{from}");
            assert_ne!(id_of(&text.replace(from, to)), id, "{to}");
        }
        let centre = |tensor: &str| {
            let sha256 = "0".repeat(64);
            format!(
                "{text}\n[text_centre]\nfile = {{ path = \"c\", sha256 = \"{sha256}\" }}\ntensor = \"{tensor}\"\n"
            )
        };
        assert_ne!(id_of(&centre("mean")), id_of(&centre("other")));
        assert_eq!(id_of(&text.replace("about = \"", "about = \"also: ")), id);
        assert_eq!(id_of(&text.replace("[text]", "batch = 3\n\n[text]")), id);
    }
}
