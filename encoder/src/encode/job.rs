//! The state of an unfinished encode: which views are done, and their files of contributions.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::PathBuf;

use serde::Serialize;
use slag_common::container::ContainerError;
use slag_common::{Hash32, View, durable};

use super::error::EncodeError;
use super::inputs;
use super::settings::Restart;
use super::view::{ViewRecord, ViewSink};
use crate::lift::photos::{self, MaskOutline};
use crate::lift::{ContributionError, ContributionFile, ViewContributions};
use crate::segment::Segmenter;
use crate::store::{Store, remove_files};

const TREE: &str = "job";
const IDENTITY_KEY: &[u8] = b"identity";
/// Present if every finished view of the job is published.
const PUBLISHED_KEY: &[u8] = b"published";
const STEP_KEY: &[u8] = b"step";
const VIEW_PREFIX: &str = "view/";
const VIEWS_FOLDER: &str = "views";

/// What a store knows of the encode that it keeps views of.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct JobStatus {
    /// Views whose contributions are on disk.
    pub n_views: usize,
    /// Whether all of them are published; otherwise the encode is unfinished.
    pub is_published: bool,
    /// The step that it is at, or ended at.
    pub step: Option<String>,
    #[serde(skip)]
    pub(super) of_scene: Vec<u8>,
}

/// State of the store's kept views, if there are any. `db`: the store's catalogue, or a copy.
pub(crate) fn job_status(db: &sled::Db) -> Result<Option<JobStatus>, EncodeError> {
    let tree = db.open_tree(TREE)?;
    let Some(of_scene) = tree.get(IDENTITY_KEY)? else { return Ok(None) };
    let step = tree.get(STEP_KEY)?;
    Ok(Some(JobStatus {
        n_views: tree.scan_prefix(VIEW_PREFIX).count(),
        is_published: tree.contains_key(PUBLISHED_KEY)?,
        step: step.map(|name| String::from_utf8_lossy(&name).into_owned()),
        of_scene: of_scene.to_vec(),
    }))
}

pub(crate) struct Job {
    records: sled::Tree,
    folder: PathBuf,
    pub(crate) of_scene: Hash32,
    /// By name.
    pub(crate) id_of_view: BTreeMap<String, Hash32>,
}

impl Job {
    /// Resumes an earlier encode of the same scene, or begins one. Views with the same identity and sound files count
    /// as done. `id_of_view`: by name.
    pub(super) fn open(
        store: &Store,
        of_scene: Hash32,
        id_of_view: BTreeMap<String, Hash32>,
        restart: Restart,
    ) -> Result<Self, EncodeError> {
        let folder = store.job_dir()?;
        let records = store.db().open_tree(TREE)?;
        let job = Self { records, folder, of_scene, id_of_view };
        job.adopt()?;
        let found = job.records.get(IDENTITY_KEY)?;
        let same = found.as_deref() == Some(&of_scene.0);
        let published = job.records.contains_key(PUBLISHED_KEY)?;
        // A published job loses only contributions, which the published generation does not need.
        if found.is_some() && !same && restart == Restart::Never && !published {
            return Err(EncodeError::OtherJob {
                path: store.dir().to_owned(),
                n_done: job.records.scan_prefix(VIEW_PREFIX).count(),
            });
        }
        if !same || restart == Restart::Always {
            job.clear()?;
            job.records.insert(IDENTITY_KEY, &of_scene.0)?;
            job.flush()?;
        }
        fs_err::create_dir_all(job.views_folder())?;
        durable::write(&job.identity_path(), of_scene.to_string().as_bytes())?;
        job.drop_damaged()?;
        Ok(job)
    }

    /// Drops done views whose files are lost or damaged, so that they are made again. The lift checks the
    /// contributions' entries by their own checksums.
    fn drop_damaged(&self) -> Result<(), EncodeError> {
        for (view, id) in &self.id_of_view {
            if !self.records.contains_key(record_key(*id))? {
                continue;
            }
            let what = match self.check_files(view) {
                Ok(()) => continue,
                Err(ContributionError::Damaged { path, source }) => {
                    format!("{}: {}", path.display(), first_clause(&source))
                }
                Err(ContributionError::Io(e))
                    if matches!(e.kind(), io::ErrorKind::NotFound | io::ErrorKind::UnexpectedEof) =>
                {
                    e.to_string()
                }
                Err(e) => return Err(e.into()),
            };
            tracing::warn!("view {view} is made again: {what}");
            self.forget(*id)?;
        }
        Ok(())
    }

    /// Checks a view's files, except the entries of its contributions.
    fn check_files(&self, view: &str) -> Result<(), ContributionError> {
        let (_, regions) = ContributionFile::open(&self.contributions_path(view))?;
        let n_masks = regions.mask_vectors.len() / regions.dim;
        photos::read_outlines(&self.outlines_path(view), n_masks).map(drop)
    }

    /// Drops the view whose file an error names, so that the next encode makes it again; returns an error that says so.
    pub(super) fn forget_damaged(&self, error: ContributionError) -> EncodeError {
        let ContributionError::Damaged { path, source } = &error else { return error.into() };
        let stem = path.file_stem().and_then(|stem| stem.to_str());
        let of_path = |(_, id): &(&String, &Hash32)| stem.is_some_and(|stem| id.to_string() == stem);
        let Some((view, id)) = self.id_of_view.iter().find(of_path) else { return error.into() };
        match self.forget(*id) {
            Ok(()) => EncodeError::Failed(format!(
                "view {view}: {}: {}; run the same encode again: this view is made again, the others are kept",
                path.display(),
                first_clause(source)
            )),
            Err(error) => error,
        }
    }

    /// Drops first the record, then the files.
    fn forget(&self, id: Hash32) -> Result<(), EncodeError> {
        self.records.remove(record_key(id))?;
        self.flush()?;
        for extension in ["contributions", "outlines"] {
            match fs_err::remove_file(self.views_folder().join(format!("{id}.{extension}"))) {
                Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e.into()),
                _ => {}
            }
        }
        Ok(())
    }

    pub(crate) fn done_views(&self) -> Result<BTreeMap<String, ViewRecord>, EncodeError> {
        let mut done = BTreeMap::new();
        for (name, id) in &self.id_of_view {
            if let Some(value) = self.records.get(record_key(*id))? {
                // A lost record only affects the report.
                done.insert(name.clone(), serde_json::from_slice(&value).unwrap_or_default());
            }
        }
        Ok(done)
    }

    /// # Panics
    /// If the view is none of this encode's.
    pub(crate) fn contributions_path(&self, view: &str) -> PathBuf {
        // By identity: a replaced photo gets another file, so no record names the old one's.
        self.views_folder().join(format!("{}.contributions", self.id_of_view[view]))
    }

    pub(crate) fn outlines_path(&self, view: &str) -> PathBuf {
        self.contributions_path(view).with_extension("outlines")
    }

    /// Marks a view as done; its files must be durable.
    pub(crate) fn mark_done(&self, view: &str, record: ViewRecord) -> Result<(), EncodeError> {
        let record = serde_json::to_vec(&record).map_err(std::io::Error::from)?;
        // Atomic: with an unpublished view, the job may no longer be dropped silently.
        let mut batch = sled::Batch::default();
        batch.insert(record_key(self.id_of_view[view]), record);
        batch.remove(PUBLISHED_KEY);
        self.records.apply_batch(batch)?;
        self.flush()
    }

    /// Keeps the contributions of this encode's published views, for an encode that adds others.
    pub(super) fn keep_published(self) -> Result<(), EncodeError> {
        self.forget_others()?;
        self.records.insert(PUBLISHED_KEY, &[])?;
        self.flush()
    }

    pub(super) fn begin(&self, step: &str) -> Result<(), EncodeError> {
        self.records.insert(STEP_KEY, step)?;
        self.flush()
    }

    /// Removes records and files of views that are none of this encode's.
    fn forget_others(&self) -> Result<(), EncodeError> {
        let own: BTreeSet<String> = self.id_of_view.values().map(Hash32::to_string).collect();
        let mut batch = sled::Batch::default();
        for key in self.records.scan_prefix(VIEW_PREFIX).keys() {
            let key = key?;
            if !own.contains(&*String::from_utf8_lossy(&key[VIEW_PREFIX.len()..])) {
                batch.remove(key);
            }
        }
        self.records.apply_batch(batch)?;
        self.flush()?;
        self.remove_views(|id| !own.contains(id))
    }

    /// Removes the files of views, complete or not, by their identities.
    fn remove_views(&self, is_chosen: impl Fn(&str) -> bool) -> Result<(), EncodeError> {
        let id = |name: &str| Some(name.split_once('.')?.0.to_owned());
        let is_of_view =
            |name: &str| id(name).is_some_and(|id| id.parse::<Hash32>().is_ok() && is_chosen(&id));
        remove_files(&self.views_folder(), is_of_view)?;
        Ok(())
    }

    /// Adopts files of a job whose records were lost with the catalogue. A file of contributions is renamed into place
    /// once it and its outlines are whole.
    fn adopt(&self) -> Result<(), EncodeError> {
        if self.records.contains_key(IDENTITY_KEY)? {
            return Ok(());
        }
        let written = fs_err::read_to_string(self.identity_path()).ok();
        let Some(of_scene) = written.and_then(|text| text.parse::<Hash32>().ok()) else { return Ok(()) };
        if !self.views_folder().is_dir() {
            return Ok(());
        }
        let mut batch = sled::Batch::default();
        batch.insert(IDENTITY_KEY, &of_scene.0);
        for entry in fs_err::read_dir(self.views_folder())? {
            let path = entry?.path();
            let id =
                path.file_stem().and_then(|stem| stem.to_str()).and_then(|stem| stem.parse::<Hash32>().ok());
            let is_contributions = path.extension().is_some_and(|extension| extension == "contributions");
            if let Some(id) = id.filter(|_| is_contributions) {
                let record = serde_json::to_vec(&ViewRecord::default()).map_err(std::io::Error::from)?;
                batch.insert(record_key(id), record);
            }
        }
        self.records.apply_batch(batch)?;
        self.flush()
    }

    fn identity_path(&self) -> PathBuf {
        self.folder.join("identity")
    }

    fn views_folder(&self) -> PathBuf {
        self.folder.join(VIEWS_FOLDER)
    }

    pub(super) fn clear(&self) -> Result<(), EncodeError> {
        self.clear_steps(3)
    }

    /// Does the first steps of [`Self::clear`]; a crash after any leaves this job or none.
    fn clear_steps(&self, n_steps: usize) -> Result<(), EncodeError> {
        // First, so that nothing adopts the files once their records are gone.
        if n_steps > 0 && self.identity_path().exists() {
            fs_err::remove_file(self.identity_path())?;
            durable::sync_folder(&self.folder)?;
        }
        // Records before files: a file without a record is redone, a record without a file would be an error.
        if n_steps > 1 {
            self.records.clear()?;
            self.flush()?;
        }
        if n_steps > 2 {
            self.remove_views(|_| true)?;
            // Other files in them are not ours.
            let _ = fs_err::remove_dir(self.views_folder()).and_then(|()| fs_err::remove_dir(&self.folder));
        }
        Ok(())
    }

    fn flush(&self) -> Result<(), EncodeError> {
        self.records.flush()?;
        Ok(())
    }
}

impl ViewSink for Job {
    fn n_at_once(&self) -> usize {
        1
    }

    /// Both were read by now: if they still have the planned content, they had it then.
    fn check_unchanged(&self, view: &View, segmenter: &dyn Segmenter) -> Result<(), EncodeError> {
        let now = inputs::of_view(self.of_scene, view, segmenter)?;
        match now == self.id_of_view[&view.name] {
            true => Ok(()),
            false => Err(EncodeError::Changed { view: view.name.clone() }),
        }
    }

    /// Writes the files first, then the record that marks the view as done.
    fn keep(
        &self,
        view: &View,
        contributions: &ViewContributions,
        outlines: &[MaskOutline],
        record: ViewRecord,
    ) -> Result<(), EncodeError> {
        photos::write_outlines(&self.outlines_path(&view.name), outlines)?;
        contributions.write(&self.contributions_path(&view.name))?;
        self.mark_done(&view.name, record)
    }
}

/// An error's finding, without its advice to delete the file.
fn first_clause(error: &ContainerError) -> String {
    let text = error.to_string();
    text.split("; ").next().unwrap_or_default().to_owned()
}

fn record_key(id: Hash32) -> Vec<u8> {
    format!("{VIEW_PREFIX}{id}").into_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::tests::{DAMAGES, new_store};

    fn keep(job: &Job, view: &str) {
        let contributions = ViewContributions {
            dim: 1,
            mask_vectors: Vec::new(),
            masks_of_region: Vec::new(),
            entries_of_cell: Vec::new(),
        };
        let intrinsics = crate::raster::pinhole([1, 1], 1.0);
        let (name, image_path) = (view.to_owned(), PathBuf::new());
        let view = View { name, image_path, intrinsics, camera_from_world: glam::DAffine3::IDENTITY };
        job.keep(&view, &contributions, &[], ViewRecord::default()).expect("keeps");
    }

    fn try_open(store: &Store, of_scene: u8, views: &[(&str, u8)]) -> Result<Job, EncodeError> {
        let id_of_view = views.iter().map(|(name, id)| ((*name).to_owned(), Hash32([*id; 32]))).collect();
        Job::open(store, Hash32([of_scene; 32]), id_of_view, Restart::Never)
    }

    fn open(store: &Store, views: &[(&str, u8)]) -> Job {
        try_open(store, 1, views).expect("begins or goes on")
    }

    fn names(job: &Job) -> Vec<String> {
        job.done_views().expect("reads").into_keys().collect()
    }

    /// A view is done if its identity is: photos come, go and are replaced; leftovers go when the views are published.
    #[test]
    fn views_are_known_by_their_identities() {
        let (_dir, store) = new_store();
        let job = open(&store, &[("a", 1), ("b", 2)]);
        keep(&job, "a");
        keep(&job, "b");
        let of_b = job.contributions_path("b");
        assert_eq!(names(&open(&store, &[("a", 1), ("c", 3)])), ["a"]);
        // Another photo of the same name is not done, and does not replace the old one's file.
        let replaced = open(&store, &[("b", 4)]);
        assert!(names(&replaced).is_empty());
        keep(&replaced, "b");
        assert!(names(&open(&store, &[("a", 1), ("b", 2)])) == ["a", "b"] && of_b.exists());
        let kept = open(&store, &[("a", 1)]);
        let of_a = kept.contributions_path("a");
        kept.keep_published().expect("publishes");
        assert!(of_a.exists() && !of_b.exists());
        assert_eq!(names(&open(&store, &[("a", 1), ("b", 2)])), ["a"]);
    }

    /// Records that are lost with the catalogue are rebuilt from the files: nothing is redone, and another scene does
    /// not drop them.
    #[test]
    fn a_job_outlives_its_records() {
        let (dir, store) = new_store();
        let job = open(&store, &[("a", 1), ("b", 2)]);
        job.begin("views").expect("records");
        keep(&job, "a");
        let status = job_status(store.db()).expect("reads").expect("a job");
        assert_eq!((status.n_views, status.is_published, status.step.as_deref()), (1, false, Some("views")));
        drop(job);
        drop(store);
        fs_err::remove_dir_all(dir.path().join("db")).expect("there");
        let store = Store::create_or_open(dir.path()).expect("opens");
        assert_eq!(job_status(store.db()).expect("reads"), None);
        assert_eq!(names(&open(&store, &[("a", 1), ("b", 2)])), ["a"]);
        assert!(matches!(try_open(&store, 2, &[("a", 1)]), Err(EncodeError::OtherJob { n_done: 1, .. })));
    }

    /// A published job, half dropped by a crash, neither comes back nor keeps another scene out.
    #[test]
    fn a_job_that_was_dropped_in_part_stays_dropped() {
        for n_steps in 0..=3 {
            let (_dir, store) = new_store();
            let job = open(&store, &[("a", 1)]);
            keep(&job, "a");
            job.keep_published().expect("marks");
            open(&store, &[("a", 1)]).clear_steps(n_steps).expect("drops");
            let other = try_open(&store, 2, &[("a", 1)]).unwrap_or_else(|e| panic!("{n_steps} steps: {e}"));
            assert!(names(&other).is_empty(), "{n_steps} steps");
        }
    }

    /// Every way to lose, cut or damage a kept file, except its entries: only that view is made again, and is done once
    /// its files are.
    #[test]
    fn views_with_damaged_files_are_made_again() {
        for (number, damage) in DAMAGES.iter().enumerate() {
            for of_contributions in [true, false] {
                let (_dir, store) = new_store();
                let open = || open(&store, &[("a", 1), ("b", 2)]);
                let job = open();
                keep(&job, "a");
                keep(&job, "b");
                damage(&if of_contributions { job.contributions_path("a") } else { job.outlines_path("a") });
                let job = open();
                assert_eq!(names(&job), ["b"], "damage {number}");
                assert!(!job.contributions_path("a").exists() && !job.outlines_path("a").exists());
                keep(&job, "a");
                assert_eq!(names(&open()), ["a", "b"], "damage {number}");
            }
        }
    }

    /// A wrong checksum found by the lift: that view's record goes, and the error says what to do.
    #[test]
    fn a_view_that_the_lift_finds_damaged_is_forgotten() {
        let (_dir, store) = new_store();
        let job = open(&store, &[("a", 1), ("b", 2)]);
        keep(&job, "a");
        keep(&job, "b");
        let source = ContainerError::Checksum { id: 6, offset_bytes: 64, expected: 1, found: 2 };
        let found = ContributionError::Damaged { path: job.contributions_path("a"), source };
        let error = job.forget_damaged(found).to_string();
        assert!(error.contains("view a") && error.contains("run the same encode again"), "{error}");
        assert!(error.contains("section 6") && !error.contains("delete it"), "{error}");
        assert_eq!(names(&open(&store, &[("a", 1), ("b", 2)])), ["b"]);
    }

    #[test]
    fn a_restart_takes_nothing_over() {
        let (_dir, store) = new_store();
        for (restart, n_done) in [(Restart::Never, 1), (Restart::IfOther, 1), (Restart::Always, 0)] {
            keep(&open(&store, &[("a", 1)]), "a");
            let id_of_view = BTreeMap::from([("a".to_owned(), Hash32([1; 32]))]);
            let job = Job::open(&store, Hash32([1; 32]), id_of_view, restart).expect("opens");
            assert_eq!(names(&job).len(), n_done, "{restart:?}");
        }
    }

    /// A published job may be dropped, but not views that a later run adds before publishing again.
    #[test]
    fn views_added_to_a_published_job_are_not_dropped_silently() {
        let (_dir, store) = new_store();
        let open = |of_scene| try_open(&store, of_scene, &[("a", 1), ("b", 2)]);
        let job = open(1).expect("begins");
        keep(&job, "a");
        job.keep_published().expect("marks");
        keep(&open(1).expect("goes on"), "b");
        assert!(matches!(open(2), Err(EncodeError::OtherJob { n_done: 2, .. })));
        open(1).expect("goes on").keep_published().expect("marks");
        assert!(names(&open(2).expect("what is published may go")).is_empty());
    }
}
