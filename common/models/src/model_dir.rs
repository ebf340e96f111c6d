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
    description::{self, Description, DescriptionError, FILE_NAME, FileRef, TextDescription},
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
    source: Source,
}

#[derive(Clone, Debug)]
enum Source {
    Colours,
    Files { files: Files, description: Box<Documented>, batch: Arc<Mutex<Option<usize>>> },
}

#[derive(Clone, Debug)]
struct Documented {
    /// TOML; empty for a model from a store, which cannot encode images.
    document: String,
    description: Description,
}

impl std::ops::Deref for Documented {
    type Target = Description;

    fn deref(&self) -> &Description {
        &self.description
    }
}

#[derive(Clone, Debug)]
enum Files {
    Embedded,
    Folder(PathBuf),
}

impl Files {
    /// Returns a file, checked against its hash if recorded; `embedded`: its compiled-in bytes.
    fn open(&self, file: &FileRef, embedded: &'static [u8]) -> Result<ModelFile, DescriptionError> {
        match self {
            Self::Embedded => Ok(ModelFile::embedded(&file.path, embedded)),
            Self::Folder(root) => Ok(checked(root, file)?.into()),
        }
    }

    /// Returns the path of a file that embedded models do not have.
    fn on_disk(&self, file: &FileRef) -> Result<PathBuf, DescriptionError> {
        match self {
            Self::Embedded => Ok(file.path.clone()),
            Self::Folder(root) => checked(root, file),
        }
    }
}

impl ModelDir {
    /// Opens a directory with a [`description`](crate::description) in `model.toml`. Files with a recorded hash
    /// are read and checked only when an encoder needs them.
    pub fn open(path: &Path) -> Result<Self, ModelError> {
        let file = path.join(FILE_NAME);
        let document = description::read_text(&file)?;
        let description = Description::parse(&file, &document)?;
        let files_root = path.join(&description.files_root);
        Self::with(Documented { document, description }, Files::Folder(files_root))
    }

    /// The embedded encoders: trained on generated scenes, poor on real photos (`embedded/CARD.md`); need ONNX Runtime.
    pub fn embedded() -> Result<Self, ModelError> {
        let description = Description::parse(Path::new("(embedded)/model.toml"), embedded::DESCRIPTION)?;
        Self::with(Documented { document: embedded::DESCRIPTION.to_owned(), description }, Files::Embedded)
    }

    /// Opens the text side from a store. `description`: [`TextSide::description`]; `path`: of the description, for
    /// messages; `folder`: has its files, named by hash. Their content is checked when the encoder is opened.
    pub fn carried(description: &[u8], path: &Path, folder: &Path) -> Result<Self, ModelError> {
        let description = Description::from_json(path, description)?;
        let described = Documented { document: String::new(), description };
        Self::with(described, Files::Folder(folder.to_owned()))
    }

    pub fn text_side(&self) -> Result<TextSide, TextSideError> {
        let built_in = || TextSideError::BuiltIn { model: self.id.name.clone() };
        let Source::Files { files: files @ Files::Folder(root), description, .. } = &self.source else {
            return Err(built_in());
        };
        let hashed = hashed(&description.description, root)?;
        TextSide::new(&self.id, &description.document, &hashed, |file| files.open(file, &[]))
    }

    fn with(description: Documented, files: Files) -> Result<Self, ModelError> {
        let root = match &files {
            Files::Folder(root) => root,
            // Unused: the embedded description records every hash.
            Files::Embedded => Path::new(""),
        };
        let id = hashed(&description.description, root)?.encoder_id();
        let source = Source::Files { files, description: Box::new(description), batch: Arc::default() };
        Ok(Self { id, source })
    }

    /// The stand-in for colours and shapes, which needs no files and no ONNX Runtime.
    pub fn colours() -> Self {
        let id =
            EncoderId { name: colours::NAME.to_owned(), dim: colours::DIM as u32, definition: String::new() };
        Self { id, source: Source::Colours }
    }

    pub fn encoder_id(&self) -> &EncoderId {
        &self.id
    }

    pub fn dim(&self) -> usize {
        self.id.dim as usize
    }

    /// What the model can recognise and what not, for people.
    pub fn about(&self) -> &str {
        match &self.source {
            Source::Colours => colours::ABOUT,
            Source::Files { description, .. } => &description.about,
        }
    }

    /// Least cosine of a match, if the model states one.
    pub fn threshold(&self) -> Option<f32> {
        match &self.source {
            Source::Colours => Some(colours::THRESHOLD),
            Source::Files { description, .. } => description.score.as_ref()?.threshold(),
        }
    }

    /// Steps from a crop to the image encoder's square, which has the same vector; `None` if any size is accepted.
    pub fn preprocess(&self) -> Option<Preprocess> {
        match &self.source {
            Source::Colours => None,
            Source::Files { description, .. } => Some(description.image.preprocess()),
        }
    }

    /// Patches with vectors along each side of a photo; `None` without any.
    pub fn patches_per_side(&self) -> Option<u32> {
        match &self.source {
            Source::Colours => None,
            Source::Files { description, .. } => description.image.patches_per_side(),
        }
    }

    /// Sizes of windows of a photo that masks take a share of; empty if the model should see objects alone.
    pub fn windows(&self) -> &[u8] {
        match &self.source {
            Source::Colours => &[],
            Source::Files { description, .. } => &description.image.windows,
        }
    }

    pub fn image_encoder(&self, options: &SessionOptions) -> Result<Box<dyn ImageEncoder>, ModelError> {
        let Source::Files { files, description, batch } = &self.source else {
            return Ok(Box::new(colours::ColourShape));
        };
        let image = &description.image;
        let file = files.open(&image.file, embedded::IMAGE)?;
        let mut encoder = OnnxImageEncoder::open(&description.name, self.dim(), &file, image, options)?;
        // One encoder measures while others wait, because parallel runs would disturb the timing.
        encoder.settle_batch(&mut batch.lock().unwrap_or_else(PoisonError::into_inner))?;
        Ok(Box::new(encoder))
    }

    /// Loads ONNX Runtime only if the text side is ONNX.
    pub fn text_encoder(&self, options: &SessionOptions) -> Result<Box<dyn TextEncoder>, ModelError> {
        let Source::Files { files, description, .. } = &self.source else {
            return Ok(Box::new(colours::ColourShape));
        };
        let (name, dim) = (&description.name, self.dim());
        let centre = match &description.text_centre {
            None => None,
            Some(centre) => Some(tensors::read(&files.on_disk(&centre.file)?, &centre.tensor, None, dim)?),
        };
        Ok(match &description.text {
            TextDescription::Onnx(text) => {
                let model = files.open(&text.file, embedded::TEXT)?;
                let tokenizer = files.open(&text.tokenizer, embedded::TOKENIZER)?;
                let encoder = OnnxTextEncoder::open(name, dim, [&model, &tokenizer], text, centre, options)?;
                Box::new(match files {
                    Files::Embedded => encoder.with_words(embedded::NOUNS.lines(), embedded::KINDS.lines()),
                    _ => encoder,
                })
            }
            TextDescription::Phrases(text) => {
                let (phrases, vectors) = (files.on_disk(&text.file)?, files.on_disk(&text.vectors)?);
                Box::new(PhraseEncoder::open(dim, &phrases, (&vectors, &text.tensor), centre)?)
            }
        })
    }
}

fn hashed(description: &Description, root: &Path) -> Result<Description, DescriptionError> {
    let mut hashed = description.clone();
    for file in hashed.files_mut() {
        file.for_each_part(|part| {
            part.sha256 = Some(crate::description::Sha256(sha256_of(root, part)?));
            Ok::<_, DescriptionError>(())
        })?;
    }
    Ok(hashed)
}

/// Returns the recorded hash, or computes it.
pub(crate) fn sha256_of(files_root: &Path, file: &FileRef) -> Result<[u8; 32], DescriptionError> {
    let path = files_root.join(&file.path);
    match file.sha256 {
        Some(sha256) => Ok(sha256.0),
        None => hash_file(&path).map_err(|cause| match cause.kind() {
            io::ErrorKind::NotFound => DescriptionError::NoHash { path },
            _ => DescriptionError::Read { cause },
        }),
    }
}

/// Returns the path of `file`, checked with its weights against recorded hashes.
pub(crate) fn checked(files_root: &Path, file: &FileRef) -> Result<PathBuf, DescriptionError> {
    for part in file.parts() {
        let path = files_root.join(&part.path);
        let Some(expected) = part.sha256 else { continue };
        let found = hash_file(&path).map_err(|cause| DescriptionError::Read { cause })?;
        if found != expected.0 {
            let (expected, found) = (hex::encode(expected.0), hex::encode(found));
            return Err(DescriptionError::Hash { path, expected, found });
        }
    }
    Ok(files_root.join(&file.path))
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
        let described = Documented { document: String::new(), description };
        ModelDir::with(described, Files::Embedded).expect("every hash is recorded").encoder_id().hash()
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
