//! Answers the page from what is shown.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use glam::{DQuat, DVec3, Vec3};
use slag_common::{Hash32, View};
use slag_models::names::words_of;
use slag_models::{TextEncoder, one_to_find, words_to_find};
use slag_view::{Description, Photo, Step, Words};

use super::error::ViewError;
use super::generation::Generation;
use super::splat::Splat;
use crate::diff::{self, Diff};
use crate::store::StoreReader;

/// A request encodes no further word after this time, because questions wait meanwhile.
const ENCODING: Duration = Duration::from_millis(500);

/// Opens the text encoder of a store; the error says what to do.
pub(crate) type OpenText = Box<dyn Fn(&StoreReader) -> Result<Box<dyn TextEncoder>, String> + Send + Sync>;

pub(crate) struct Viewed {
    pub(crate) store: Option<PathBuf>,
    /// The store's, if there is one.
    pub(crate) splat: Option<Splat>,
    /// In the world of the splat.
    pub(crate) views: Vec<View>,
    /// Upward; the world's z if absent.
    pub(crate) up: Option<Vec3>,
    /// Called at the first question.
    pub(crate) open_text: OpenText,
}

struct OpenedText {
    id: Hash32,
    encoder: Box<dyn TextEncoder>,
    /// Words that name things, with their vectors as far as needed; `None` for words unknown to the model.
    words: Vec<String>,
    vectors: Vec<Option<Vec<f32>>>,
}

impl OpenedText {
    /// Encodes more words; returns whether all are encoded.
    fn encode_words(&mut self) -> bool {
        let started = Instant::now();
        while let Some(word) = self.words.get(self.vectors.len()) {
            if started.elapsed() > ENCODING {
                return false;
            }
            self.vectors.push(self.encoder.encode(word).ok());
        }
        true
    }

    fn known(&self) -> impl Iterator<Item = (&str, &[f32])> {
        self.words.iter().zip(&self.vectors).filter_map(|(word, vector)| Some((&**word, vector.as_deref()?)))
    }
}

pub(crate) struct Viewer {
    shown: Viewed,
    /// Locked while another generation is opened, so that only one request opens it.
    generation: Mutex<Option<Arc<Generation>>>,
    /// Locked while a question is scored: one at a time bounds memory.
    text: Mutex<Option<OpenedText>>,
}

impl Viewer {
    pub(crate) fn new(shown: Viewed) -> Self {
        Self { shown, generation: Mutex::default(), text: Mutex::default() }
    }

    /// The store's current generation; blocks while it is read. One that fails to open leaves the previous one.
    fn generation(&self) -> Result<Arc<Generation>, ViewError> {
        let Some(store) = &self.shown.store else { return Err(ViewError::NoStore) };
        let mut opened = locked(&self.generation);
        if let Some(generation) = opened.as_ref().filter(|generation| generation.reader.is_current()) {
            return Ok(Arc::clone(generation));
        }
        let fresh = StoreReader::open(store)
            .map_err(ViewError::from)
            .and_then(|reader| Generation::open(reader, self.shown.splat.as_ref()));
        match (fresh, opened.as_ref()) {
            (Ok(fresh), _) => Ok(Arc::clone(opened.insert(Arc::new(fresh)))),
            (Err(error), Some(before)) => {
                tracing::warn!("the page stays at the generation before: {error}");
                Ok(Arc::clone(before))
            }
            (Err(error), None) => Err(error),
        }
    }

    /// Opens what is shown, as the first request would.
    pub(crate) fn check(&self) -> Result<(), ViewError> {
        self.describe().map(drop)
    }

    pub(super) fn describe(&self) -> Result<Description, ViewError> {
        let mut description = match (&self.shown.store, &self.shown.splat) {
            (None, Some(splat)) => splat.describe(),
            _ => self.generation()?.describe(),
        };
        if let Some(up) = self.shown.up.filter(|_| !description.metric) {
            description.up = up;
        }
        // Photos take precedence over published poses: they have pictures.
        if !self.shown.views.is_empty() {
            description.views = self.shown.views.iter().map(photo).collect();
        }
        Ok(description)
    }

    pub(super) fn changes(&self) -> Result<Diff, ViewError> {
        let generation = self.generation()?;
        let reader = &generation.reader;
        let before = reader.previous().ok_or(ViewError::OneGeneration)?;
        let of = |published| diff::Generation { reader, published };
        Ok(diff::diff(of(before), of(reader.current()))?)
    }

    pub(super) fn cell(
        &self,
        cell_id: u32,
        generation: Option<u64>,
        step: Step,
    ) -> Result<Vec<u8>, ViewError> {
        match (&self.shown.store, &self.shown.splat) {
            (None, Some(splat)) => splat.cell(cell_id, step),
            (_, splat) => self.generation()?.cell(cell_id, generation, step, splat.as_ref()),
        }
    }

    pub(super) fn thumbnail(&self, id: u64) -> Result<Option<Vec<u8>>, ViewError> {
        self.generation()?.thumbnail(id)
    }

    /// File of a photo, by its index in the description.
    pub(super) fn photo(&self, number: usize) -> Option<PathBuf> {
        self.shown.views.get(number).map(|view| view.image_path.clone())
    }

    /// Runs work on the vectors of a question and its negatives, in the current generation's space.
    pub(super) fn asked<T>(
        &self,
        text: &str,
        negatives: &[String],
        work: impl FnOnce(&Generation, &[Vec<f32>]) -> Result<T, ViewError>,
    ) -> Result<T, ViewError> {
        self.with_text_encoder(|generation, OpenedText { encoder, .. }| {
            let texts = std::iter::once(text).chain(negatives.iter().map(String::as_str));
            let known = encoder.known_phrases().cloned();
            let vectors = texts.map(|text| encoder.encode(&one_to_find(text, known.as_deref())?));
            let vectors = vectors.collect::<Result<Vec<_>, _>>()?;
            work(generation, &vectors)
        })
    }

    /// Replacements for texts with words that the model does not know.
    pub(super) fn asked_as(&self, texts: &[String]) -> Result<BTreeMap<String, String>, ViewError> {
        self.with_text_encoder(|_, OpenedText { encoder, .. }| {
            let known = encoder.known_phrases();
            let asked_as = |text: &String| known?.asked_as(&words_to_find(text).ok()?);
            Ok(texts.iter().filter_map(|text| Some((text.clone(), asked_as(text)?))).collect())
        })
    }

    /// Names of the current generation's things, as on the robot.
    pub(super) fn words(&self) -> Result<Words, ViewError> {
        self.with_text_encoder(|generation, opened| {
            let manifest = generation.reader.manifest();
            if !opened.encode_words() {
                return Ok(Words::pending(manifest.generation));
            }
            let known: Vec<(&str, &[f32])> = opened.known().collect();
            let best = generation.things.best_names(manifest, &known);
            Ok(Words::new(manifest.generation, best, opened.encoder.nouns().unwrap_or_default()))
        })
    }

    fn with_text_encoder<T>(
        &self,
        work: impl FnOnce(&Generation, &mut OpenedText) -> Result<T, ViewError>,
    ) -> Result<T, ViewError> {
        let generation = self.generation()?;
        let encoder_id = generation.reader.manifest().encoder.id;
        let mut opened = locked(&self.text);
        if opened.as_ref().is_none_or(|opened| opened.id != encoder_id) {
            let encoder = (self.shown.open_text)(&generation.reader).map_err(ViewError::Models)?;
            let words = words_of(encoder.nouns());
            *opened = Some(OpenedText { id: encoder_id, encoder, words, vectors: Vec::new() });
        }
        let Some(opened) = opened.as_mut() else { return Err(ViewError::NoStore) };
        work(&generation, opened)
    }
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn photo(view: &View) -> Photo {
    let world_from_camera = view.camera_from_world.inverse();
    let rotation = DQuat::from_mat3(&world_from_camera.matrix3).as_quat();
    Photo {
        name: view.name.clone(),
        position_m: world_from_camera.translation,
        rotation_xyzw: rotation.to_array(),
        width_px: view.intrinsics.width_px,
        height_px: view.intrinsics.height_px,
        focal_px: ((view.intrinsics.focal_x_px + view.intrinsics.focal_y_px) / 2.0) as f32,
        has_picture: view.image_path.is_file(),
    }
}

/// Mean of the photos' upward axes; `None` if these cancel out.
pub(crate) fn up_of(views: &[View]) -> Option<Vec3> {
    let up = |view: &View| view.camera_from_world.inverse().transform_vector3(DVec3::NEG_Y).normalize();
    let sum: DVec3 = views.iter().map(up).sum();
    (sum.length() > 0.2 * views.len() as f64).then(|| sum.normalize().as_vec3())
}

#[cfg(test)]
mod tests {
    use glam::{DAffine3, DMat3};
    use slag_common::Gaussians;
    use slag_test_support::assert_error;

    use super::*;
    use crate::store;

    /// A camera at (1, 2, 3) that looks along the world's y, with z upward.
    fn level() -> View {
        let world_from_camera = DAffine3 {
            matrix3: DMat3::from_cols(DVec3::X, DVec3::NEG_Z, DVec3::Y),
            translation: DVec3::new(1.0, 2.0, 3.0),
        };
        View {
            name: "a.jpg".into(),
            image_path: "none".into(),
            intrinsics: crate::raster::pinhole([64, 48], 60.0),
            camera_from_world: world_from_camera.inverse(),
        }
    }

    /// A store that can answer no request is refused before there is an address.
    #[test]
    fn a_store_that_is_not_there_or_of_another_splat_is_refused() {
        let dir = tempfile::tempdir().expect("a folder");
        let check = |splat: Option<usize>| {
            let scene = |n| Gaussians { means_in_world: vec![DVec3::ZERO; n], ..Gaussians::default() };
            let splat = splat.map(|n| Splat::new("splat".into(), scene(n), false));
            let open_text: OpenText = Box::new(|_| Err("none".into()));
            let store = Some(dir.path().to_owned());
            Viewer::new(Viewed { store, splat, views: Vec::new(), up: None, open_text }).check()
        };
        assert_error(check(None), &["nothing has been published here yet"]);
        let store = store::Store::create_or_open(dir.path()).expect("opens");
        store.publish(&store::tests::manifest(1, &[]), &store::Extras::new()).expect("publishes");
        check(None).expect("a store");
        assert_error(
            check(Some(7)),
            &["the splat has 7 Gaussians, but the store was encoded from one with 0"],
        );
    }

    #[test]
    fn poses_are_those_of_the_cameras() {
        let photo = photo(&level());
        assert!((photo.position_m - DVec3::new(1.0, 2.0, 3.0)).length() < 1e-9 && !photo.has_picture);
        let forward = glam::Quat::from_array(photo.rotation_xyzw) * Vec3::Z;
        assert!((forward - Vec3::Y).length() < 1e-6, "{forward}");
        assert!((up_of(&[level()]).expect("up") - Vec3::Z).length() < 1e-6);
        assert_eq!(up_of(&[]), None);
    }
}
