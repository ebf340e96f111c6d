//! `encode --view` and `encode --report`: a page that watches an encode, and one that reports what it did.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::sync_channel;
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Context, Result, anyhow};
use clap::Args;
use slag_service::access::AccessSettings;
use slag_service::listen::Listen;

use super::common::{ModelArgs, runtime};
use super::view::{check_page, open_browser, open_text};
use crate::encode::{EncodeSettings, EncodeSummary};
use crate::progress::Progress;
use crate::publish::serve::{self, Access};
use crate::report;
use crate::view::{Shown, Viewer, router};
use crate::watch::Watch;

/// Time between two looks whether ctrl-c was pressed.
const LOOK_FOR_STOP: Duration = Duration::from_millis(200);

/// The flags.
#[derive(Clone, Debug, Args)]
#[command(next_help_heading = "Pages")]
pub struct WatchArgs {
    /// Shows the encode on a page while it is at work: progress by stage, the views on a map, the last masks, the time so far.
    /// When it is published, the page shows the scene, until ctrl-c ends it.
    #[arg(long)]
    pub view: bool,
    /// Address of that page.
    #[arg(long, value_name = "IP:PORT", default_value = "127.0.0.1:7735", requires = "view")]
    pub view_listen: Listen,
    /// Prints the page's link and opens no browser.
    #[arg(long, requires = "view")]
    pub no_open: bool,
    /// Writes a report of the encode, one HTML file: views, masks, objects, cells, errors by profile, what was left out and
    /// why.
    #[arg(long, value_name = "FILE")]
    pub report: Option<PathBuf>,
}

/// An encode that may be watched.
pub(super) struct Watched {
    watch: Option<Arc<Watch>>,
    /// The service of the page; it ends at ctrl-c.
    page: Option<JoinHandle<Result<()>>>,
    report: Option<PathBuf>,
}

impl Watched {
    /// Opens the page, if it was asked for.
    ///
    /// # Errors
    /// If the program has no page, or the address is taken.
    pub(super) fn begin(
        args: &WatchArgs,
        settings: &EncodeSettings,
        models: &ModelArgs,
        cancel: &Arc<AtomicBool>,
    ) -> Result<Self> {
        let report = args.report.clone();
        let watch = (args.view || report.is_some()).then(|| Arc::new(Watch::new(report.is_some())));
        let page = match &watch {
            Some(watch) if args.view => {
                Some(open_page(args, settings, models, Arc::clone(watch), Arc::clone(cancel))?)
            }
            _ => None,
        };
        Ok(Self { watch, page, report })
    }

    /// Runs the encode.
    ///
    /// # Errors
    /// Those of the encode.
    pub(super) fn encode(
        &self,
        progress: &dyn Progress,
        encode: impl FnOnce(&dyn Progress) -> Result<EncodeSummary>,
    ) -> Result<EncodeSummary> {
        let Some(watch) = &self.watch else { return encode(progress) };
        let result = encode(&watch.beside(progress));
        watch.end_with(match &result {
            Ok(summary) => format!("Generation {} is published.", summary.generation),
            Err(error) => format!("The encode ended: {error:#}"),
        });
        result
    }

    /// Writes the report, and waits until the page is no longer wanted.
    ///
    /// # Errors
    /// If the report cannot be written, or the page's service failed.
    pub(super) fn end(self, settings: &EncodeSettings, summary: &EncodeSummary) -> Result<()> {
        if let (Some(path), Some(watch)) = (&self.report, &self.watch) {
            let html = report::of_encode(&settings.output.scene_name, summary, watch)?;
            fs_err::write(path, html)?;
        }
        match self.page {
            Some(page) => page.join().map_err(|_| anyhow!("the page's thread panicked"))?,
            None => Ok(()),
        }
    }
}

/// Serves the page from a thread of its own, and returns once it listens.
fn open_page(
    args: &WatchArgs,
    settings: &EncodeSettings,
    models: &ModelArgs,
    watch: Arc<Watch>,
    cancel: Arc<AtomicBool>,
) -> Result<JoinHandle<Result<()>>> {
    check_page()?;
    let shown = Shown {
        store: Some(settings.output.store.clone()),
        splat: None,
        views: Vec::new(),
        up: None,
        open_text: open_text(models.clone()),
        work: Some(watch),
    };
    let (listen, opens) = (args.view_listen.clone(), !args.no_open);
    let access = Access::new(&listen, AccessSettings::default())?;
    let limits = serve::Limits::default();
    let service = serve::bounded(router(Viewer::new(shown)), limits, access);
    let (listening, is_listening) = sync_channel(1);
    let serve = move || -> Result<()> {
        let opened = move |url: String| {
            let link = format!("{url}/view");
            eprintln!("{link}");
            if opens {
                open_browser(&link);
            }
            // Nobody waits any more if the encode has failed meanwhile.
            listening.send(()).unwrap_or_default();
        };
        // The encode's own handler has the signals.
        let stopped = async move {
            while !cancel.load(Ordering::Relaxed) {
                tokio::time::sleep(LOOK_FOR_STOP).await;
            }
        };
        Ok(runtime()?.block_on(serve::serve_router(service, listen, limits, None, opened, stopped))?)
    };
    let page =
        std::thread::Builder::new().name("page".into()).spawn(serve).context("cannot start the page")?;
    match is_listening.recv() {
        Ok(()) => Ok(page),
        Err(_) => match page.join().map_err(|_| anyhow!("the page's thread panicked"))? {
            Ok(()) => Err(anyhow!("the page ended before the encode began")),
            Err(error) => Err(error),
        },
    }
}
