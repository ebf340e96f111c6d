//! The runs in a bucket. They have consecutive numbers, and the highest one counts. A run ends once: by its
//! coordinator's word that it publishes, or by that of the next run's coordinator. Both put the same object on
//! condition that it is not there, so one put decides whether a run is published.

use super::documents::{self, End, PlannedBy, RunPlan};
use crate::blobs::Bucket;
use crate::encode::EncodeError;

/// Keys of a run: how it ended; all its views are done.
const END: &str = "end.json";
const DONE: &str = "done";

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

    pub(super) fn failed_key(self, view: usize) -> String {
        format!("{}/{view:06}.json", self.failed_folder())
    }

    pub(super) fn heartbeat_key(self) -> String {
        self.key("heartbeat")
    }

    /// The newest run, and the names of all runs' objects.
    fn newest(bucket: &Bucket) -> Result<Option<(Self, Vec<String>)>, EncodeError> {
        let names = bucket.list("jobs")?;
        let number = |name: &String| name.strip_suffix("/plan.json")?.parse().ok();
        let newest = names.iter().filter_map(number).max().map(Self);
        Ok(newest.map(|run| (run, names)))
    }

    fn has(self, names: &[String], name: &str) -> bool {
        names.contains(&format!("{:08}/{name}", self.0))
    }

    pub(super) fn begin(bucket: &Bucket, plan: &RunPlan) -> Result<Self, EncodeError> {
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

    /// The newest run and its plan, unless it has ended or its views are done.
    pub(super) fn open(bucket: &Bucket) -> Result<Option<(Self, RunPlan)>, EncodeError> {
        let Some((run, names)) = Self::newest(bucket)? else { return Ok(None) };
        if [DONE, END].iter().any(|name| run.has(&names, name)) {
            return Ok(None);
        }
        let key = run.key("plan.json");
        let bytes = bucket.require(&key)?;
        let PlannedBy { program: planned } = documents::parse(bucket, &key, &bytes)?;
        let own = documents::own_version();
        if planned != own {
            return Err(EncodeError::Failed(format!(
                "run {} was planned by slag-encoder {planned}, this is {own}: install the same program on all machines of the \
                 fleet",
                run.0
            )));
        }
        Ok(Some((run, documents::parse(bucket, &key, &bytes)?)))
    }

    pub(super) fn is_first(bucket: &Bucket) -> Result<bool, EncodeError> {
        Ok(Self::newest(bucket)?.is_none())
    }

    pub(super) fn is_open(self, bucket: &Bucket) -> Result<bool, EncodeError> {
        Ok(!self.has_ended(bucket)? && bucket.len_of(&self.key(DONE))?.is_none())
    }

    fn has_ended(self, bucket: &Bucket) -> Result<bool, EncodeError> {
        Ok(bucket.len_of(&self.key(END))?.is_some())
    }

    /// Dismisses the workers: all views are in the bucket, or have failed.
    pub(super) fn views_are_done(self, bucket: &Bucket) -> Result<(), EncodeError> {
        Ok(bucket.put(&self.key(DONE), "")?)
    }

    /// Whether another coordinator has superseded the run; its own run follows at once.
    pub(super) fn is_superseded(self, bucket: &Bucket) -> Result<bool, EncodeError> {
        let key = self.key(END);
        let Some(bytes) = bucket.get(&key)? else { return Ok(false) };
        Ok(documents::parse::<End>(bucket, &key, &bytes)? == End::Superseded)
    }

    pub(super) fn check(self, bucket: &Bucket) -> Result<(), EncodeError> {
        if self.has_ended(bucket)? { Err(self.superseded(bucket)) } else { Ok(()) }
    }

    pub(super) fn publish(self, bucket: &Bucket) -> Result<(), EncodeError> {
        // Only the run's own coordinator puts this.
        match bucket.claim(&self.key(END), documents::to_bytes(&End::Published)?)? {
            true => Ok(()),
            false => Err(self.superseded(bucket)),
        }
    }

    fn superseded(self, bucket: &Bucket) -> EncodeError {
        EncodeError::Failed(format!(
            "run {} was superseded: another `encode --blobs` uses {}. Let one of them finish, or give the other another prefix",
            self.0, bucket.url
        ))
    }
}

#[cfg(test)]
mod tests;
