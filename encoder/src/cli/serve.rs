//! `serve`: publishes a store over HTTP.

use std::io::{self, Write};
use std::path::PathBuf;
use std::time::Duration;

use anyhow::Result;
use clap::Args;
use slag_common::note;
use slag_service::listen::Listen;
use slag_service::tls::TlsFiles;

use super::common::{Exit, ModelArgs, runtime, stopped, warn_of_expiry};
use super::next;
use super::view::open_text;
use crate::publish::serve::{self, Access, AccessSettings};
use crate::store::StoreReader;
use crate::view::{self, Viewed, Viewer};

const EXPIRY_INTERVAL: Duration = Duration::from_secs(86_400);

const EXAMPLES: &str = "Examples:\n\
    \x20 slag-encoder serve --store STORE\n\
    \x20 slag-encoder serve --store STORE --listen 0.0.0.0:7733\n\
    \x20 slag-encoder serve --store STORE --listen 0.0.0.0:7733 --tls-cert cert.pem --tls-key key.pem\n";

#[derive(Debug, Args)]
#[command(before_help = EXAMPLES)]
pub struct ServeArgs {
    /// Store.
    #[arg(long, value_name = "DIR")]
    pub store: PathBuf,
    /// Address to listen on, or unix:PATH; 0.0.0.0:7733 lets other machines connect.
    #[arg(long, value_name = "IP:PORT|unix:PATH", default_value = "127.0.0.1:7733")]
    pub listen: Listen,
    /// Name that robots call this machine by; other names are then refused. May be repeated [default: any name
    /// beyond this machine, else localhost and IP addresses].
    #[arg(long, value_name = "NAME")]
    pub(crate) host: Vec<String>,
    /// Let pages of this origin read answers (CORS), such as https://map.example. May be repeated.
    #[arg(long, value_name = "ORIGIN")]
    pub(crate) cors: Vec<String>,
    /// Speak TLS with this certificate and the chain to its authority (PEM); it is read anew when it changes.
    #[arg(long, value_name = "FILE", requires = "tls_key")]
    pub(crate) tls_cert: Option<PathBuf>,
    /// Private key of --tls-cert (PEM).
    #[arg(long, value_name = "FILE", requires = "tls_cert")]
    pub(crate) tls_key: Option<PathBuf>,
    /// Models of the page at /view; they must be those that the store was encoded with.
    #[command(flatten)]
    pub models: ModelArgs,
}

pub(super) fn run(args: &ServeArgs) -> Result<Exit> {
    let is_any_host = args.host.is_empty() && !args.listen.is_local();
    let settings = AccessSettings { hosts: args.host.clone(), origins: args.cors.clone(), token_file: None };
    let access = Access::new(&args.listen, settings)?;
    let access = if is_any_host { access.with_any_host() } else { access };
    let files = args.tls_cert.clone().zip(args.tls_key.clone());
    let tls = args.listen.tls(files.map(|(cert, key)| TlsFiles { cert, key }))?;
    let limits = serve::Limits::default();
    let open_text = open_text(args.models.clone());
    let shown =
        Viewed { store: Some(args.store.clone()), splat: None, views: Vec::new(), up: None, open_text };
    let page = view::router(Viewer::new(shown));
    let router = serve::router(&args.store, limits, access, page)?;
    runtime()?.block_on(async {
        // On stdout, so that a script learns the port where it was 0.
        let listening = |url: String| {
            let _ = writeln!(io::stdout(), "listening on {url}");
            if tracing::enabled!(tracing::Level::INFO)
                && let Ok(store) = StoreReader::open(&args.store)
                && let Ok(lines) = next::of_robot(&store, &url)
            {
                note(lines.trim_end());
            }
        };
        let store = args.store.clone();
        tokio::spawn(async move {
            let mut days = tokio::time::interval(EXPIRY_INTERVAL);
            loop {
                days.tick().await;
                warn_of_expiry(&store);
            }
        });
        serve::serve(router, args.listen.clone(), limits, tls, listening, stopped()).await
    })?;
    Ok(Exit::Done)
}
