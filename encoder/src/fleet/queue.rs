//! A run's queue on NATS JetStream: a stream with work-queue retention for each run, and one durable pull consumer
//! that all workers share. It only hands out work: the coordinator fills it again from what the bucket lacks.
//!
//! A worker holds few messages at a time, reports progress on each every third of the ack wait, and acknowledges a
//! message once its result is in the bucket.

use std::collections::{HashMap, VecDeque};
use std::fmt::Display;
use std::path::PathBuf;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

use async_nats::ConnectOptions;
use async_nats::jetstream::consumer::{AckPolicy, PullConsumer, pull};
use async_nats::jetstream::stream::{self, RetentionPolicy};
use async_nats::jetstream::{self, AckKind, Context, Message};
use clap::Args;
use futures_util::StreamExt;
use slag_common::Hash32;
use tokio::runtime::Runtime;

use super::dispatch::{Dispatcher, OpenViews};
use super::run::Run;
use crate::encode::EncodeError;

const CONSUMER: &str = "workers";
/// How long a pull request waits at the server.
const PULL_WAIT: Duration = Duration::from_secs(1);
/// Pause before a retry: the server may be down, or its stream not made yet.
const RETRY_PAUSE: Duration = Duration::from_millis(300);
/// Interval of the coordinator's checks of the stream.
const LOOK_INTERVAL: Duration = Duration::from_secs(1);

/// Where work is handed out, and how patiently.
#[derive(Clone, Debug, Args)]
#[command(next_help_heading = "Fleet")]
pub(crate) struct QueueSettings {
    /// NATS server with JetStream that hands out the work; without it, workers have shares. TLS with tls://.
    #[arg(long, value_name = "nats://HOST:PORT", hide_short_help = true)]
    pub(crate) fleet: Option<String>,
    /// Credentials file for the NATS server.
    #[arg(long, value_name = "FILE", requires = "fleet", env = "NATS_CREDS", hide_short_help = true)]
    nats_credentials: Option<PathBuf>,
    /// File with the seed of an nkey for the NATS server.
    #[arg(
        long,
        value_name = "FILE",
        requires = "fleet",
        conflicts_with = "nats_credentials",
        hide_short_help = true
    )]
    nats_nkey: Option<PathBuf>,
    /// Certificates of the authority that signed the NATS server's.
    #[arg(long, value_name = "FILE", requires = "fleet", hide_short_help = true)]
    nats_ca: Option<PathBuf>,
    /// Seconds without a sign of life after which a worker's view goes to another.
    #[arg(long, value_name = "SECS", default_value = "60", value_parser = parse_period, hide_short_help = true)]
    ack_wait: Duration,
    /// Times that a view is handed out; then it is left out.
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=1000), hide_short_help = true)]
    max_deliver: u32,
}

pub(crate) fn parse_period(text: &str) -> Result<Duration, String> {
    let period = text.parse().ok().and_then(|secs| Duration::try_from_secs_f64(secs).ok());
    period.filter(|period| period.as_millis() >= 100).ok_or_else(|| "expected seconds, at least 0.1".into())
}

impl QueueSettings {
    /// One address, or several with commas.
    fn url(&self) -> &str {
        self.fleet.as_deref().unwrap_or_default()
    }

    async fn connect(&self) -> Result<Context, EncodeError> {
        let url = self.url();
        let refuse = |problem: &dyn Display| {
            EncodeError::Failed(format!(
                "{url}: {problem}; check the address, that nats-server runs with JetStream (-js), and the credentials"
            ))
        };
        let mut options = ConnectOptions::new().name("slag-encoder");
        if let Some(path) = &self.nats_credentials {
            options = options.credentials_file(path).await.map_err(|e| refuse(&e))?;
        }
        if let Some(path) = &self.nats_nkey {
            let seed = fs_err::read_to_string(path).map_err(|e| refuse(&e))?;
            options = options.nkey(seed.trim().to_owned());
        }
        if let Some(path) = &self.nats_ca {
            options = options.add_root_certificates(path.clone()).require_tls(true);
        }
        let addresses: Vec<String> = url.split(',').map(str::to_owned).collect();
        let client = options.connect(addresses).await.map_err(|e| refuse(&e))?;
        Ok(jetstream::new(client))
    }
}

fn stream_name(run: Run, of_scene: Hash32) -> String {
    format!("SLAG-{}-{}", &of_scene.to_string()[..16], run.0)
}

pub(super) struct Enqueuer {
    runtime: Arc<Runtime>,
    context: Context,
    settings: QueueSettings,
    stream: String,
    last_look: Option<Instant>,
    is_filled: bool,
    /// The last check found an empty queue with open views.
    was_empty: bool,
}

impl Enqueuer {
    /// Connects; the stream is made when first filled.
    pub(super) fn open(
        runtime: &Arc<Runtime>,
        settings: &QueueSettings,
        run: Run,
        of_scene: Hash32,
    ) -> Result<Self, EncodeError> {
        let context = runtime.block_on(settings.connect())?;
        Ok(Self {
            runtime: Arc::clone(runtime),
            context,
            settings: settings.clone(),
            stream: stream_name(run, of_scene),
            last_look: None,
            is_filled: false,
            was_empty: false,
        })
    }

    /// Fills the queue with open views if the stream is gone, was never filled, or has lost them. A server that refuses
    /// or does not answer is retried later.
    pub(super) fn keep_filled(&mut self, open: &[usize]) {
        let is_due = self.last_look.is_none_or(|last| last.elapsed() >= LOOK_INTERVAL);
        if !is_due || open.is_empty() {
            return;
        }
        let runtime = Arc::clone(&self.runtime);
        if let Err(problem) = runtime.block_on(self.look(open)) {
            tracing::warn!("{}: {problem}; the queue is looked at again", self.settings.url());
        }
        self.last_look = Some(Instant::now());
    }

    async fn look(&mut self, open: &[usize]) -> Result<(), String> {
        if self.is_filled {
            match self.n_left().await {
                Some(0) if self.was_empty => tracing::warn!("the queue has lost {} views", open.len()),
                // A worker may have stored the last one since the bucket was listed.
                Some(0) => {
                    self.was_empty = true;
                    return Ok(());
                }
                Some(_) => {
                    self.was_empty = false;
                    return Ok(());
                }
                None => tracing::warn!("the queue is gone; it is filled again from the bucket"),
            }
        }
        self.fill(open).await?;
        (self.was_empty, self.is_filled) = (false, true);
        Ok(())
    }

    /// Number of views waiting or in work; `None` without a queue.
    async fn n_left(&self) -> Option<u64> {
        let stream = self.context.get_stream(&self.stream).await.ok()?;
        let mut consumer: PullConsumer = stream.get_consumer(CONSUMER).await.ok()?;
        let info = consumer.info().await.ok()?;
        Some(info.num_pending + info.num_ack_pending as u64)
    }

    async fn fill(&self, open: &[usize]) -> Result<(), String> {
        let config = stream::Config {
            name: self.stream.clone(),
            subjects: vec![format!("slag.{}.>", self.stream)],
            retention: RetentionPolicy::WorkQueue,
            ..stream::Config::default()
        };
        let stream = self.context.get_or_create_stream(config).await.map_err(|e| e.to_string())?;
        // Workers, not the server, give a view up, so that the failure is recorded in the bucket.
        let consumer = pull::Config {
            durable_name: Some(CONSUMER.into()),
            ack_policy: AckPolicy::Explicit,
            ack_wait: self.settings.ack_wait,
            max_deliver: -1,
            max_ack_pending: -1,
            ..pull::Config::default()
        };
        stream.get_or_create_consumer(CONSUMER, consumer).await.map_err(|e| e.to_string())?;
        let mut stored = Vec::with_capacity(open.len());
        for view in open {
            let body = serde_json::to_vec(view).map_err(|e| e.to_string())?;
            let subject = format!("slag.{}.work", self.stream);
            stored.push(self.context.publish(subject, body.into()).await.map_err(|e| e.to_string())?);
        }
        for stored in stored {
            stored.await.map_err(|e| e.to_string())?;
        }
        Ok(())
    }

    /// Removes a finished run's queue; one that stays does no harm.
    pub(super) fn close(&self) {
        if let Err(error) = self.runtime.block_on(self.context.delete_stream(&self.stream)) {
            tracing::warn!("{}: {error}", self.stream);
        }
    }
}

pub(super) struct Queue {
    held: Arc<Held>,
    max_deliver: i64,
}

struct Held {
    runtime: tokio::runtime::Handle,
    n_most: usize,
    messages: Mutex<Messages>,
    changed: Condvar,
}

#[derive(Default)]
struct Messages {
    waiting: VecDeque<usize>,
    dead: Vec<usize>,
    of_view: HashMap<usize, Arc<Message>>,
}

impl Held {
    fn messages(&self) -> MutexGuard<'_, Messages> {
        self.messages.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn add(&self, message: Message, max_deliver: i64) {
        let Ok(view) = serde_json::from_slice::<usize>(&message.payload) else {
            tracing::warn!("the queue has a message that is no work: it is left to others");
            return;
        };
        let is_dead = message.info().is_ok_and(|info| info.delivered > max_deliver);
        let mut messages = self.messages();
        let is_new = messages.of_view.insert(view, Arc::new(message)).is_none();
        match is_dead {
            true => messages.dead.push(view),
            // A view that is redelivered while in work here is the same work.
            false if is_new => messages.waiting.push_back(view),
            false => {}
        }
        drop(messages);
        self.changed.notify_all();
    }
}

impl Queue {
    /// Connects, and pulls at most `n_most` views at a time until dropped.
    pub(super) fn open(
        runtime: &Arc<Runtime>,
        settings: &QueueSettings,
        run: Run,
        of_scene: Hash32,
        n_most: usize,
    ) -> Result<Self, EncodeError> {
        let context = runtime.block_on(settings.connect())?;
        let held = Arc::new(Held {
            runtime: runtime.handle().clone(),
            n_most,
            messages: Mutex::default(),
            changed: Condvar::new(),
        });
        let max_deliver = i64::from(settings.max_deliver);
        let stream = stream_name(run, of_scene);
        runtime.spawn(pull_work(Arc::downgrade(&held), context, stream, max_deliver));
        runtime.spawn(send_heartbeats(Arc::downgrade(&held), settings.ack_wait / 3));
        Ok(Self { held, max_deliver })
    }
}

async fn pull_work(held: Weak<Held>, context: Context, stream: String, max_deliver: i64) {
    let mut consumer: Option<PullConsumer> = None;
    loop {
        let Some(n_free) = held.upgrade().map(|held| {
            let n_held = held.messages().of_view.len();
            held.n_most.saturating_sub(n_held)
        }) else {
            return;
        };
        if n_free == 0 {
            tokio::time::sleep(RETRY_PAUSE / 10).await;
            continue;
        }
        let Some(open) = consumer.take() else {
            // The coordinator makes the stream, perhaps anew.
            match context.get_consumer_from_stream(CONSUMER, &stream).await {
                Ok(found) => consumer = Some(found),
                Err(_) => tokio::time::sleep(RETRY_PAUSE).await,
            }
            continue;
        };
        let Ok(mut batch) = open.fetch().max_messages(n_free).expires(PULL_WAIT).messages().await else {
            tokio::time::sleep(RETRY_PAUSE).await;
            continue;
        };
        let mut is_sound = true;
        while let Some(message) = batch.next().await {
            match (message, held.upgrade()) {
                (Ok(message), Some(held)) => held.add(message, max_deliver),
                (Err(_), _) => is_sound = false,
                (_, None) => return,
            }
        }
        if is_sound { consumer = Some(open) } else { tokio::time::sleep(RETRY_PAUSE).await }
    }
}

async fn send_heartbeats(held: Weak<Held>, interval: Duration) {
    loop {
        tokio::time::sleep(interval).await;
        let Some(held) = held.upgrade() else { return };
        let messages: Vec<Arc<Message>> = held.messages().of_view.values().cloned().collect();
        for message in messages {
            // A lost one causes redelivery, and the work is done twice.
            let _ = message.ack_with(AckKind::Progress).await;
        }
    }
}

impl Dispatcher for Queue {
    fn offer(&self, _open: OpenViews<'_>) -> Result<(), EncodeError> {
        Ok(())
    }

    fn take(&self) -> Option<usize> {
        self.held.messages().waiting.pop_front()
    }

    fn done(&self, view: usize) {
        let Some(message) = self.held.messages().of_view.remove(&view) else { return };
        self.held.runtime.spawn(async move {
            // If it is lost, the view is redelivered and found done.
            let _ = message.double_ack().await;
        });
    }

    fn wait(&self, pause: Duration) -> bool {
        let is_idle = |messages: &mut Messages| messages.waiting.is_empty() && messages.dead.is_empty();
        let waited = self.held.changed.wait_timeout_while(self.held.messages(), pause, is_idle);
        let (mut messages, _) = waited.unwrap_or_else(PoisonError::into_inner);
        !is_idle(&mut messages)
    }

    fn take_dead(&self) -> Vec<usize> {
        let dead = std::mem::take(&mut self.held.messages().dead);
        for view in &dead {
            tracing::warn!("view {view} was handed out more than {} times; it is given up", self.max_deliver);
        }
        dead
    }
}
