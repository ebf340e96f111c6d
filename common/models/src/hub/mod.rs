//! Public models in the user's cache: pulled once, checked, described for [`ModelDir`].
//!
//! A file counts when its SHA-256 is the one of the [`Table`], else the one that the [`Lock`] has accepted
//! before, else the one that the hub advertises. Where nobody states one (small files), what comes first over
//! the connection to the pinned commit is accepted and locked, and said to be so.

mod download;
mod lock;
mod table;

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::Serialize;
use slag_common::durable;

pub use download::Failure;
pub use lock::{Accepted, Lock, LockedFile, Source};
pub use table::{Entry, Known, Table};

use crate::description::{self, Description, DescriptionError, Sha256};
use crate::{ModelError, model_dir::hash_file};
use download::{Advertised, Client, discard};

/// No file of a model is larger: ONNX files of 2 GiB and more are split.
pub const MAX_FILE_BYTES: u64 = 2 << 30;

/// Says why a model is not here.
#[derive(Debug, thiserror::Error)]
pub enum HubError {
    /// The table has no such model.
    #[error("no model {name:?} is known, there are {}; choose one, or give the folder of your own", known.join(", "))]
    Unknown {
        /// The name asked for.
        name: String,
        /// The names there are.
        known: Vec<String>,
    },
    /// The licence has not been accepted.
    #[error(
        "{name} is under {licence} ({url}){}; pull it with --accept-licence if you accept that",
        if note.is_empty() { String::new() } else { format!("; note: {}", note.trim_end_matches('.')) }
    )]
    Licence {
        /// The model.
        name: String,
        /// Its licence.
        licence: String,
        /// Where that stands.
        url: String,
        /// What else is to be known.
        note: String,
    },
    /// The hub does not give the files.
    #[error("{url}: {failure}; to do without the hub, put there from elsewhere: {}", wanted.iter().map(Wanted::to_string).collect::<Vec<_>>().join("; "))]
    Unreachable {
        /// What was asked for.
        url: String,
        /// What happened.
        failure: Box<Failure>,
        /// The model's files that are not here.
        wanted: Vec<Wanted>,
    },
    /// The model is of the table, but not here.
    #[error("{name} is not pulled yet; run `models pull {name}`, or give the folder of a model of your own")]
    NotPulled {
        /// The model.
        name: String,
    },
    /// There is no folder for models.
    #[error("neither XDG_CACHE_HOME nor HOME is an absolute path, so models have no place; set one")]
    NoFolder,
    /// The proxy cannot be used.
    #[error("the proxy that HTTPS_PROXY names: {0}; correct or unset it")]
    Proxy(#[from] Failure),
    /// A file is not the expected one.
    #[error("{}: SHA-256 is {found}, expected {expected} ({}); {advice}", path.display(), source_of(*by))]
    Hash {
        /// The file.
        path: PathBuf,
        /// Its hash.
        found: Sha256,
        /// The hash expected.
        expected: Sha256,
        /// Who expects it.
        by: Source,
        /// What to do.
        advice: &'static str,
    },
    /// The hub now advertises another file.
    #[error(
        "{url}: the hub advertises SHA-256 {advertised}, expected {expected} ({}); do not use it, or take the \
         model out of models.lock if you trust the new one", source_of(*by)
    )]
    Advertised {
        /// The file.
        url: String,
        /// The hash advertised.
        advertised: Sha256,
        /// The hash expected.
        expected: Sha256,
        /// Who expects it.
        by: Source,
    },
    /// The hub answers for another commit.
    #[error("{url}: the hub answers for commit {found}, expected {expected}; give another --hub")]
    Revision {
        /// The file.
        url: String,
        /// The commit answered for.
        found: String,
        /// The commit asked for.
        expected: String,
    },
    /// The image model's hash is not known, though its space's name needs it.
    #[error(
        "{url}: the hub advertises no SHA-256 of the image model; pull the whole model with slag-encoder"
    )]
    NoImageHash {
        /// The image model.
        url: String,
    },
    /// The lock cannot be read.
    #[error("{}: {cause}; correct it, or remove it and pull again", path.display())]
    Lock {
        /// The lock.
        path: PathBuf,
        /// What is wrong.
        cause: serde_json::Error,
    },
    /// The program's own table cannot be read.
    #[error("the program's table of models: {0}; this is our mistake, please report it")]
    Table(#[from] Box<toml::de::Error>),
    /// A model here is not as described.
    #[error(transparent)]
    Description(#[from] DescriptionError),
    /// The same.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A file of this machine fails.
    #[error("{0}; make room, or choose another folder with XDG_CACHE_HOME")]
    Io(#[from] io::Error),
}

fn source_of(by: Source) -> &'static str {
    match by {
        Source::Table => "known to this program",
        Source::Hub => "advertised by the hub",
        Source::FirstPull => "as pulled first, see models.lock",
        Source::PlacedByHand => "as placed by hand, see models.lock",
    }
}

/// A file that is not here.
#[derive(Clone, Debug, PartialEq)]
pub struct Wanted {
    url: String,
    path: PathBuf,
    sha256: Option<Sha256>,
}

impl std::fmt::Display for Wanted {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { url, path, sha256 } = self;
        let hash = sha256.map_or("unknown".to_owned(), |sha256| sha256.to_string());
        write!(f, "{url} as {} (SHA-256 {hash})", path.display())
    }
}

/// How the hub is reached, and where its models are kept.
#[derive(Clone, Debug)]
pub struct HubOptions {
    /// Folder of the models, [`models_folder`].
    pub root: PathBuf,
    /// Address of the hub; the table's if absent.
    pub hub: Option<String>,
    /// Proxy, as `HTTPS_PROXY` gives it.
    pub proxy: Option<String>,
    /// How long the hub may be silent.
    pub timeout: Duration,
    /// What is waited before the second attempt; doubled before each other.
    pub first_backoff: Duration,
}

impl HubOptions {
    /// Returns the usual ones.
    pub fn new(root: PathBuf) -> Self {
        let (timeout, first_backoff) = (Duration::from_secs(30), Duration::from_millis(500));
        Self { root, hub: None, proxy: None, timeout, first_backoff }
    }
}

/// Returns the folder of the user's caches: `$XDG_CACHE_HOME/slag`, else `~/.cache/slag`; `variable` looks the
/// environment up.
pub fn cache_folder(variable: impl Fn(&str) -> Option<std::ffi::OsString>) -> Option<PathBuf> {
    // The base directory specification has relative paths ignored.
    let absolute = |name: &str| variable(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let base = absolute("XDG_CACHE_HOME").or_else(|| Some(absolute("HOME")?.join(".cache")))?;
    Some(base.join("slag"))
}

/// Returns the folder of pulled models within that of the user's caches.
pub fn models_folder(cache_folder: &Path) -> PathBuf {
    cache_folder.join("models")
}

/// Which files of a model are pulled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// Those that turn texts into vectors.
    Text,
    /// All.
    Both,
}

/// What of a model is here.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Here {
    /// Nothing that can be used.
    No,
    /// What texts need.
    Text,
    /// All.
    All,
}

/// A file, pulled or found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PulledFile {
    /// Its path below the model's folder.
    pub path: String,
    /// Its SHA-256.
    pub sha256: Sha256,
    /// Whose word that is.
    pub on_the_word_of: Source,
    /// Whether it was here before.
    pub was_here: bool,
}

/// The models of the table and those in a folder.
#[derive(Debug)]
pub struct Hub {
    table: Table,
    options: HubOptions,
}

impl Hub {
    /// Returns the hub's table over the folder of `options`.
    /// # Errors
    /// [`HubError::Table`], which a test rules out.
    pub fn new(options: HubOptions) -> Result<Self, HubError> {
        Ok(Self { table: Table::embedded()?, options })
    }

    /// Returns the same with another table.
    pub fn with_table(table: Table, options: HubOptions) -> Self {
        Self { table, options }
    }

    /// Returns the models known.
    pub fn table(&self) -> &Table {
        &self.table
    }

    /// Returns the folder of a model of the table.
    pub fn folder(&self, entry: &Entry) -> PathBuf {
        self.options.root.join(&entry.name)
    }

    /// Returns a model of the table.
    /// # Errors
    /// [`HubError::Unknown`] where it has none of that name.
    pub fn entry(&self, name: &str) -> Result<&Entry, HubError> {
        let known = || self.table.models.iter().map(|entry| entry.name.clone()).collect();
        self.table.find(name).ok_or_else(|| HubError::Unknown { name: name.to_owned(), known: known() })
    }

    /// Says what of a model is here; files are looked for, not read.
    pub fn here(&self, entry: &Entry) -> Here {
        let folder = self.folder(entry);
        let has = |text_only| entry.paths(text_only).iter().all(|path| folder.join(path).is_file());
        match folder.join(description::FILE_NAME).is_file() && has(true) {
            false => Here::No,
            true if has(false) => Here::All,
            true => Here::Text,
        }
    }

    /// Pulls what of a model is not here, and writes its `model.toml`.
    ///
    /// Two pulls at a time wait for each other. Cut off at any moment, a pull leaves whole files and parts to go
    /// on with.
    /// # Errors
    /// [`HubError`]; [`HubError::Licence`] where the licence is neither accepted now nor was before.
    pub fn pull(&self, name: &str, side: Side, accepts_licence: bool) -> Result<Vec<PulledFile>, HubError> {
        let entry = self.entry(name)?;
        let root = &self.options.root;
        let mut lock = Lock::read(root)?;
        let was_accepted = lock.get(name).is_some_and(|accepted| accepted.licence == entry.licence);
        if !was_accepted && !accepts_licence {
            return Err(HubError::Licence {
                name: name.to_owned(),
                licence: entry.licence.clone(),
                url: entry.licence_url.clone(),
                note: entry.licence_note.clone(),
            });
        }
        fs_err::create_dir_all(root)?;
        let guard = fs_err::File::create(root.join(".pull"))?;
        guard.file().lock()?;
        // Another pull may have ended meanwhile.
        lock = Lock::read(root)?;
        lock.entry(name).licence.clone_from(&entry.licence);
        let client = Client::new(&self.options)?;
        let mut pull = Pull { hub: self, entry, side, client, lock };
        let paths = entry.paths(side == Side::Text);
        let pulled = paths.into_iter().map(|path| pull.file(path)).collect::<Result<Vec<_>, _>>()?;
        pull.name_image()?;
        let hash_of = |path: &str| Some(pull.expected(path)?.sha256);
        let description = self.table.description(entry, &hash_of);
        durable::write(&self.folder(entry).join(description::FILE_NAME), description.as_bytes())?;
        Ok(pulled)
    }

    /// Reads every file that is here of a model, and compares its hash with the recorded one.
    /// # Errors
    /// [`HubError`] where a file is absent that texts need, or not the recorded one.
    pub fn verify(folder: &Path) -> Result<Vec<String>, HubError> {
        let description = Description::read(&folder.join(description::FILE_NAME))?;
        let root = folder.join(&description.files_root);
        let mut verified = Vec::new();
        for (role, file) in description.files() {
            let path = root.join(&file.path);
            // A robot has the text side alone.
            if role == "image.model" && file.sha256.is_some() && !path.exists() {
                continue;
            }
            let found = hash_file(&path).map_err(|cause| DescriptionError::Read { cause })?;
            if let Some(expected) = file.sha256.filter(|expected| expected.0 != found) {
                let (expected, found) = (expected.to_string(), Sha256(found).to_string());
                return Err(DescriptionError::Hash { path, expected, found }.into());
            }
            verified.push(file.path.display().to_string());
        }
        Ok(verified)
    }

    /// Returns the folder that `name` stands for: that of a pulled model, where it is the name of one and no
    /// folder with a `model.toml`, else `name` itself.
    /// # Errors
    /// [`HubError::NotPulled`] where it is a model of the table and not here.
    pub fn resolve(&self, name: &Path) -> Result<PathBuf, HubError> {
        let entry = name.to_str().and_then(|name| self.table.find(name));
        match entry {
            // A name is a name even where the working folder has one of that name without a model in it.
            Some(entry) if !name.join(description::FILE_NAME).is_file() => match self.here(entry) {
                Here::No => {
                    let advice =
                        format!("{} is not pulled yet: `models pull {}` does", entry.name, entry.name);
                    Err(HubError::Io(io::Error::new(io::ErrorKind::NotFound, advice)))
                }
                _ => Ok(self.folder(entry)),
            },
            _ => Ok(name.to_owned()),
        }
    }
}

/// A pull under way.
struct Pull<'a> {
    hub: &'a Hub,
    entry: &'a Entry,
    side: Side,
    client: Client,
    lock: Lock,
}

impl Pull<'_> {
    fn url(&self, path: &str) -> String {
        let hub = self.hub.options.hub.as_deref().unwrap_or(&self.hub.table.hub).trim_end_matches('/');
        let locked = self.lock.get(&self.entry.name).and_then(|accepted| accepted.revision.as_deref());
        let revision = self.entry.revision.as_deref().or(locked).unwrap_or("main");
        format!("{hub}/{}/resolve/{revision}/{path}", self.entry.repository)
    }

    /// Returns the hash that a file must have, where somebody has said one.
    fn expected(&self, path: &str) -> Option<LockedFile> {
        let known = self.entry.known.get(path);
        let known = known.map(|known| LockedFile { sha256: known.sha256, on_the_word_of: Source::Table });
        known.or_else(|| self.lock.get(&self.entry.name)?.files.get(path).cloned())
    }

    /// Writes down what a file was accepted as.
    fn accept(&mut self, path: &str, file: LockedFile) -> Result<(), HubError> {
        self.lock.entry(&self.entry.name).files.insert(path.to_owned(), file);
        self.lock.write(&self.hub.options.root)
    }

    fn unreachable(&self, url: &str, failure: Failure) -> HubError {
        if let Failure::Io(error) = failure {
            return HubError::Io(error);
        }
        let folder = self.hub.folder(self.entry);
        let paths = self.entry.paths(self.side == Side::Text).into_iter();
        let wanted = paths.filter(|path| !folder.join(path).is_file()).map(|path| Wanted {
            url: self.url(path),
            path: folder.join(path),
            sha256: self.expected(path).map(|expected| expected.sha256),
        });
        HubError::Unreachable { url: url.to_owned(), failure: Box::new(failure), wanted: wanted.collect() }
    }

    /// Asks what the hub says of a file, which must be of the commit that is pulled.
    fn ask(&mut self, url: &str) -> Result<Advertised, HubError> {
        let advertised = self.client.ask(url).map_err(|failure| self.unreachable(url, failure))?;
        if let Some(found) = advertised.revision.clone() {
            let accepted = self.lock.entry(&self.entry.name);
            match self.entry.revision.clone().or(accepted.revision.clone()) {
                Some(expected) if expected != found => {
                    return Err(HubError::Revision { url: url.to_owned(), found, expected });
                }
                _ => accepted.revision = Some(found),
            }
        }
        Ok(advertised)
    }

    /// Has the image model's hash known even where the file is not needed: it names the space.
    fn name_image(&mut self) -> Result<(), HubError> {
        let path = self.entry.paths(false)[0];
        if self.expected(path).is_some() {
            return Ok(());
        }
        let url = self.url(path);
        let sha256 = self.ask(&url)?.sha256.ok_or(HubError::NoImageHash { url })?;
        self.accept(path, LockedFile { sha256, on_the_word_of: Source::Hub })
    }

    /// Brings one file here and into the lock.
    fn file(&mut self, path: &str) -> Result<PulledFile, HubError> {
        let target = self.hub.folder(self.entry).join(path);
        let was_here = target.is_file();
        if !was_here {
            let accepted = self.download(path, &target)?;
            self.accept(path, accepted)?;
        }
        let found = Sha256(hash_file(&target)?);
        let expected = match self.expected(path) {
            Some(expected) => expected,
            // Placed by hand, and nobody has said yet what it should be.
            None => match self.client.ask(&self.url(path)).ok().and_then(|advertised| advertised.sha256) {
                Some(sha256) => LockedFile { sha256, on_the_word_of: Source::Hub },
                None => LockedFile { sha256: found, on_the_word_of: Source::PlacedByHand },
            },
        };
        if found != expected.sha256 {
            return Err(expected.refusal(target, found, "remove the file and pull again"));
        }
        self.accept(path, expected.clone())?;
        let LockedFile { sha256, on_the_word_of } = expected;
        Ok(PulledFile { path: path.to_owned(), sha256, on_the_word_of, was_here })
    }

    /// Downloads a file to `target`; returns what it was found to be, and on whose word.
    fn download(&mut self, path: &str, target: &Path) -> Result<LockedFile, HubError> {
        let url = self.url(path);
        let expected = self.expected(path);
        let advertised = self.ask(&url)?;
        if let (Some(expected), Some(advertised)) = (&expected, advertised.sha256)
            && expected.sha256 != advertised
        {
            let (expected, by) = (expected.sha256, expected.on_the_word_of);
            return Err(HubError::Advertised { url, advertised, expected, by });
        }
        let hub = advertised.sha256.map(|sha256| LockedFile { sha256, on_the_word_of: Source::Hub });
        let stated = expected.or(hub);
        let part = target.with_added_extension("part");
        fs_err::create_dir_all(target.parent().unwrap_or(&self.hub.options.root))?;
        let len_bytes = self.entry.known.get(path).map(|known| known.len_bytes).or(advertised.len_bytes);
        tracing::info!("pulling {url}");
        loop {
            let received = self.client.receive(&url, &part, len_bytes);
            let was_begun = received.map_err(|failure| self.unreachable(&url, failure))?;
            let found = Sha256(hash_file(&part)?);
            let first = LockedFile { sha256: found, on_the_word_of: Source::FirstPull };
            let expected = stated.clone().unwrap_or(first);
            if expected.sha256 == found {
                durable::move_into_place(&part, target)?;
                discard(&part)?;
                return Ok(expected);
            }
            discard(&part)?;
            // Perhaps the part that was here already was another file's.
            if !was_begun {
                let advice = "what came was thrown away: pull again, or give another --hub";
                return Err(expected.refusal(target.to_owned(), found, advice));
            }
        }
    }
}
