//! The runs in a bucket. They have consecutive numbers, and the highest one counts. A run ends once: by its coordinator's
//! word that it publishes, or by that of the next run's coordinator. Both put the same object on condition that it is
//! not there, so one put decides whether a run is published.

use super::documents::{self, End, PlannedBy, RunPlan};
use super::error::FleetError;
use crate::blobs::Bucket;

/// Objects of a run: how it ended; all its views are done.
const END: &str = "end.json";
const DONE: &str = "done";

/// A run of an encode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Run(pub(super) u64);

impl Run {
    fn folder(self) -> String {
        format!("jobs/{:08}", self.0)
    }

    fn key(self, name: &str) -> String {
        format!("{}/{name}", self.folder())
    }

    pub(super) fn failed_folder(self) -> String {
        self.key("failed")
    }

    /// Returns the key of the record of a view that failed, by its number in the plan.
    pub(super) fn failed_key(self, view: usize) -> String {
        format!("{}/{view:06}.json", self.failed_folder())
    }

    pub(super) fn heartbeat_key(self) -> String {
        self.key("heartbeat")
    }

    /// Returns the newest run, and the names of all objects of runs.
    fn newest(bucket: &Bucket) -> Result<Option<(Self, Vec<String>)>, FleetError> {
        let names = bucket.list("jobs")?;
        let number = |name: &String| name.strip_suffix("/plan.json")?.parse().ok();
        let newest = names.iter().filter_map(number).max().map(Self);
        Ok(newest.map(|run| (run, names)))
    }

    fn has(self, names: &[String], name: &str) -> bool {
        names.contains(&format!("{:08}/{name}", self.0))
    }

    /// Begins the next run; one that has not ended is superseded.
    ///
    /// # Errors
    /// [`FleetError::Superseded`] if another coordinator begins one at the same moment.
    pub(super) fn begin(bucket: &Bucket, plan: &RunPlan) -> Result<Self, FleetError> {
        let newest = Self::newest(bucket)?;
        if let Some((run, names)) = &newest
            && !run.has(names, END)
        {
            let end = documents::to_bytes(&End::Superseded)?;
            if bucket.put_new(&run.key(END), end)? {
                tracing::info!("run {} had not ended; this one takes its place", run.0);
            }
        }
        let next = Self(newest.map_or(1, |(run, _)| run.0 + 1));
        match bucket.claim(&next.key("plan.json"), documents::to_bytes(plan)?)? {
            true => Ok(next),
            false => Err(next.superseded(bucket)),
        }
    }

    /// Returns the newest run and its plan, unless its views are done or it has ended.
    ///
    /// # Errors
    /// [`FleetError::Version`] if another version of the program planned it.
    pub(super) fn open(bucket: &Bucket) -> Result<Option<(Self, RunPlan)>, FleetError> {
        let Some((run, names)) = Self::newest(bucket)? else { return Ok(None) };
        if [DONE, END].iter().any(|name| run.has(&names, name)) {
            return Ok(None);
        }
        let key = run.key("plan.json");
        let bytes = bucket.require(&key)?;
        let PlannedBy { program: planned } = documents::parse(bucket, &key, &bytes)?;
        let own = documents::own_version();
        if planned != own {
            return Err(FleetError::Version { run: run.0, planned, own });
        }
        Ok(Some((run, documents::parse(bucket, &key, &bytes)?)))
    }

    /// Returns whether workers have views to do.
    pub(super) fn is_open(self, bucket: &Bucket) -> Result<bool, FleetError> {
        Ok(!self.has_ended(bucket)? && bucket.len_of(&self.key(DONE))?.is_none())
    }

    fn has_ended(self, bucket: &Bucket) -> Result<bool, FleetError> {
        Ok(bucket.len_of(&self.key(END))?.is_some())
    }

    /// Lets workers go: all views are in the bucket, or have failed.
    pub(super) fn views_are_done(self, bucket: &Bucket) -> Result<(), FleetError> {
        Ok(bucket.put(&self.key(DONE), "")?)
    }

    /// Returns whether another coordinator has taken the run's place: its own run follows at once.
    ///
    /// # Errors
    /// [`FleetError::Blob`]; a document that is none.
    pub(super) fn is_superseded(self, bucket: &Bucket) -> Result<bool, FleetError> {
        let key = self.key(END);
        let Some(bytes) = bucket.get(&key)? else { return Ok(false) };
        Ok(documents::parse::<End>(bucket, &key, &bytes)? == End::Superseded)
    }

    /// Fails if another coordinator has taken the run's place.
    pub(super) fn check(self, bucket: &Bucket) -> Result<(), FleetError> {
        match self.has_ended(bucket)? {
            true => Err(self.superseded(bucket)),
            false => Ok(()),
        }
    }

    /// Ends the run by its publication.
    ///
    /// # Errors
    /// [`FleetError::Superseded`] if another coordinator was first.
    pub(super) fn publish(self, bucket: &Bucket) -> Result<(), FleetError> {
        // Only the run's own coordinator puts this.
        match bucket.claim(&self.key(END), documents::to_bytes(&End::Published)?)? {
            true => Ok(()),
            false => Err(self.superseded(bucket)),
        }
    }

    fn superseded(self, bucket: &Bucket) -> FleetError {
        FleetError::Superseded { run: self.0, url: bucket.url().to_owned() }
    }
}

#[cfg(test)]
mod tests {
    use slag_common::Hash32;

    use super::*;
    use crate::cells::CellLimits;
    use crate::encode::EncodeSettings;

    fn plan() -> RunPlan {
        let settings = EncodeSettings::new("a".into(), "b".into(), "c".into(), true);
        RunPlan {
            program: documents::own_version(),
            coordinator: 1,
            engines: "none".into(),
            of_scene: Hash32([1; 32]),
            scene: Hash32([2; 32]),
            settings: settings.view,
            limits: CellLimits::by_count(5),
            data_set: None,
            views: Vec::new(),
        }
    }

    /// A second coordinator takes the place of the first, which cannot publish any more; a published run is not
    /// superseded, but followed.
    #[test]
    fn one_put_decides_who_publishes() {
        let dir = tempfile::tempdir().expect("a folder");
        let bucket = Bucket::open(dir.path().to_str().expect("UTF-8"), []).expect("opens");
        assert!(Run::open(&bucket).expect("reads").is_none());
        let first = Run::begin(&bucket, &plan()).expect("begins");
        assert_eq!(Run::open(&bucket).expect("reads").map(|(run, _)| run), Some(first));
        assert!(first.is_open(&bucket).expect("reads"));
        let second = Run::begin(&bucket, &plan()).expect("begins");
        first.check(&bucket).expect_err("superseded");
        assert!(matches!(first.publish(&bucket), Err(FleetError::Superseded { run: 1, .. })));
        assert!(second.is_open(&bucket).expect("reads") && !first.is_open(&bucket).expect("reads"));
        second.views_are_done(&bucket).expect("puts");
        assert!(Run::open(&bucket).expect("reads").is_none(), "workers have nothing to do");
        second.check(&bucket).expect("it is still the newest");
        second.publish(&bucket).expect("publishes");
        assert!(Run::open(&bucket).expect("reads").is_none());
        assert_eq!(Run::begin(&bucket, &plan()).expect("begins"), Run(3));
    }

    #[test]
    fn a_plan_of_another_version_is_refused() {
        let dir = tempfile::tempdir().expect("a folder");
        let bucket = Bucket::open(dir.path().to_str().expect("UTF-8"), []).expect("opens");
        bucket.put("jobs/00000001/plan.json", r#"{"program": "7.0.0", "news": 1}"#).expect("puts");
        let message = Run::open(&bucket).expect_err("another version").to_string();
        assert!(message.contains("7.0.0") && message.contains(env!("CARGO_PKG_VERSION")), "{message}");
    }
}
