//! Following a robot, for `fetch --watch` and `serve --follow`.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use crate::fetch::follow::{FollowEnvironment, FollowSettings, Following, follow, read_positions};
use crate::fetch::{FetchError, FetchRequest, fetch, last_position, only_follower};
use crate::http::{App, RESTARTS, keep_following};
use crate::store::EdgeCache;
use anyhow::anyhow;
use clap::Args;

use super::args::parse_reach;
use super::failure::Failure;
use super::output::print_json;
use super::progress::{Bar, environment, print_line, random};

/// Settings for following a robot.
#[derive(Debug, Args)]
pub struct FollowArgs {
    /// When following: distance fetched beyond the radius, world units [default: a quarter of the radius, 1 if
    /// that is 0].
    #[arg(long, value_name = "D", value_parser = parse_reach)]
    pub margin: Option<f64>,
    /// When following: least seconds between fetches.
    #[arg(long, value_name = "S", default_value_t = 2)]
    pub min_interval_secs: u64,
    /// When following: seconds after which a resting robot looks for a new generation; 0: never.
    #[arg(long, value_name = "S", default_value_t = 300)]
    pub refresh_secs: u64,
}

impl FollowArgs {
    pub fn settings(&self, radius: f64) -> FollowSettings {
        FollowSettings {
            radius,
            margin: self.margin.unwrap_or(if radius > 0.0 { radius / 4.0 } else { 1.0 }),
            min_interval: Duration::from_secs(self.min_interval_secs),
            refresh: (self.refresh_secs > 0).then(|| Duration::from_secs(self.refresh_secs)),
            ..FollowSettings::default()
        }
    }
}

/// Follows positions from stdin until they end.
pub fn watch(
    cache: &EdgeCache,
    request: &FetchRequest,
    ca: Option<&Path>,
    settings: FollowSettings,
    cancel: &AtomicBool,
    bar: &Bar,
    json: bool,
) -> Result<(), Failure> {
    let _place = only_follower(cache).map_err(FetchError::from)?;
    let following = Arc::<Following>::default();
    if let Some(at) = request.at {
        following.post(at);
    }
    let posting = Arc::clone(&following);
    // Not joined: it may wait for a line that never comes.
    std::thread::Builder::new()
        .name("positions".into())
        .spawn(move || {
            let read = read_positions(io::stdin().lock(), |line, position| match position {
                Ok(position) => posting.post(position),
                Err(error) => tracing::warn!("line {line}: {error}"),
            });
            if let Err(error) = read {
                tracing::warn!("positions can no longer be read: {error}");
            }
            posting.close();
        })
        .map_err(|e| Failure::failed("threads", e))?;
    let mut printed = Ok(());
    let followed = follow(
        cache,
        request,
        settings,
        &following,
        FollowEnvironment {
            fetch: &mut |request| fetch(cache, request, &environment(ca, cancel, bar)),
            report: &mut |outcome| {
                bar.finish();
                let result = match outcome {
                    Ok(report) if json => print_json(report),
                    Ok(report) => print_line(report),
                    Err(error) => {
                        tracing::warn!("{}", crate::error_line(error));
                        Ok(())
                    }
                };
                if result.is_err() {
                    printed = result;
                    cancel.store(true, Ordering::Relaxed);
                }
            },
            random: &random,
            cancel,
        },
    );
    printed?;
    followed?;
    match following.status().position {
        Some(_) => Ok(()),
        None => {
            let expected =
                "standard input had no position; expected lines `x y z`, `lat,lon[,height]` or JSON";
            Err(Failure::failed("positions", anyhow!(expected)))
        }
    }
}

/// Follows the positions posted to the service, on a separate thread, until the returned flag is set. The service
/// reports a follower that panicked, and restarts it.
pub fn follow_in_background(
    request: FetchRequest,
    ca: Option<PathBuf>,
    settings: FollowSettings,
    cache: EdgeCache,
    following: Arc<Following>,
    app: Arc<App>,
) -> Result<Arc<AtomicBool>, Failure> {
    let place = only_follower(&cache).map_err(FetchError::from)?;
    let cancel = Arc::new(AtomicBool::new(false));
    let stop = Arc::clone(&cancel);
    // The robot is most likely where it was, until a first position is posted.
    if let Some(at) = last_position(&cache) {
        following.post(at);
    }
    std::thread::Builder::new().name("follow".into()).spawn(move || {
        let followed = keep_following(&following, RESTARTS, &stop, || {
            let environment = FollowEnvironment {
                fetch: &mut |request| fetch(&cache, request, &environment(ca.as_deref(), &stop, &())),
                report: &mut |outcome| match outcome {
                    Ok(report) => {
                        // Load the generation before it is announced.
                        app.reload_now();
                        let (n, generation) = (report.downloaded.n_shards, report.generation);
                        tracing::info!("fetched {n} shards of generation {generation}");
                    }
                    Err(error) => tracing::warn!("{}", crate::error_line(error)),
                },
                random: &random,
                cancel: &stop,
            };
            follow(&cache, &request, settings.clone(), &following, environment)
        });
        if let Some(Err(error)) = followed {
            tracing::info!("no longer following: {error}");
        }
        drop(place);
    })?;
    Ok(cancel)
}
