//! `view`: a page that draws a store or a splat, and asks it.

use std::io::{self, Write};
use std::path::PathBuf;
use std::process::{Command, Stdio};

use anyhow::{Context, Result, ensure};
use clap::Args;
use glam::Vec3;
use slag_common::splat::{self, ReadOptions};
use slag_common::{View, poses};
use slag_service::access::AccessSettings;
use slag_service::listen::Listen;

use super::common::{Exit, ModelArgs, parse_frame, runtime, stopped, text_encoder_of};
use crate::ingest::{self, FrameChoice};
use crate::publish::serve::{self, Access};
use crate::view::{OpenText, Splat, Viewed, Viewer, router, up_of};

const EXAMPLES: &str = "Examples:\n\
    \x20 slag-encoder view --store STORE\n\
    \x20 slag-encoder view --store STORE --scene splat.ply --views sparse/0\n\
    \x20 slag-encoder view --scene splat.ply\n";

#[derive(Debug, Args)]
#[command(before_help = EXAMPLES)]
pub struct ViewArgs {
    /// Store to draw and to ask.
    #[arg(long, value_name = "DIR", required_unless_present = "scene")]
    pub store: Option<PathBuf>,
    /// Splat to draw: alone, or the one that the store was encoded from. The store is then drawn with its colours
    /// and scored in full precision.
    #[arg(long, value_name = "FILE")]
    pub scene: Option<PathBuf>,
    /// Poses of the photos, which are then shown where they were taken, with the answer's box drawn in its best
    /// photo.
    #[arg(long, value_name = "PATH")]
    pub views: Option<PathBuf>,
    /// Folder of the photos, if they are not beside the poses.
    #[arg(long, value_name = "DIR", requires = "views")]
    pub images: Option<PathBuf>,
    /// Says how the splat's frame follows from that of the poses, as for `encode`.
    #[arg(long, value_name = "auto|none|FILE", default_value = "auto", value_parser = parse_frame)]
    pub splat_frame: FrameChoice,
    /// Axis of the world that points up: x, y, z, -x, -y or -z [default: z in metric stores, else up in most
    /// photos, else z].
    #[arg(long, value_name = "AXIS", allow_hyphen_values = true, value_parser = parse_axis)]
    pub up: Option<Vec3>,
    /// Models; they must be those that the store was encoded with.
    #[command(flatten)]
    pub models: ModelArgs,
    /// Address to listen on.
    #[arg(long, value_name = "IP:PORT", default_value = "127.0.0.1:7735")]
    pub listen: Listen,
    /// Prints the link and opens no browser.
    #[arg(long)]
    pub(crate) no_open: bool,
}

fn parse_axis(text: &str) -> Result<Vec3, String> {
    let (sign, axis) = text.strip_prefix('-').map_or((1.0, text), |axis| (-1.0, axis));
    match axis {
        "x" => Ok(sign * Vec3::X),
        "y" => Ok(sign * Vec3::Y),
        "z" => Ok(sign * Vec3::Z),
        _ => Err("expected x, y, z, -x, -y or -z".into()),
    }
}

pub(super) fn open_text(models: ModelArgs) -> OpenText {
    Box::new(move |reader| text_encoder_of(reader, &models).map_err(|error| format!("{error:#}")))
}

pub(super) fn run(args: &ViewArgs) -> Result<Exit> {
    let viewer = Viewer::new(shown(args)?);
    // Fails here, not only in the page, if the store is missing or of another splat.
    viewer.check()?;
    ensure!(
        slag_view::is_built(),
        "this program was built without its page; run scripts/build-page.sh and build it again"
    );
    let access = Access::new(&args.listen, AccessSettings::default())?;
    let viewer = serve::bounded(router(viewer), serve::Limits::default(), access);
    runtime()?.block_on(async {
        let opened = |url: String| {
            let link = format!("{url}/view");
            let _ = writeln!(io::stdout(), "{link}");
            if !args.no_open {
                open_browser(&link);
            }
        };
        serve::serve(viewer, args.listen.clone(), serve::Limits::default(), None, opened, stopped()).await
    })?;
    Ok(Exit::Done)
}

fn shown(args: &ViewArgs) -> Result<Viewed> {
    let set = args.views.as_deref().map(|path| poses::read(path, args.images.as_deref())).transpose()?;
    let splat = match &args.scene {
        None => None,
        Some(path) => {
            let mut scene = splat::read(path, &ReadOptions { with_sh_rest: false })?;
            if let Some(set) = &set {
                ingest::to_poses(&mut scene, path, &args.splat_frame, set.source, set.applied)?;
            }
            let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            Some(Splat::new(name, scene, args.store.is_none()))
        }
    };
    let views: Vec<View> = set.map(|set| set.views).unwrap_or_default();
    let up = args.up.or_else(|| up_of(&views));
    let open_text = open_text(args.models.clone());
    Ok(Viewed { store: args.store.clone(), splat, views, up, open_text })
}

/// Opens a link; on failure the link is already on the terminal.
fn open_browser(link: &str) {
    let (program, arguments): (&str, &[&str]) = match std::env::consts::OS {
        "macos" => ("open", &[]),
        "windows" => ("rundll32", &["url.dll,FileProtocolHandler"]),
        _ => ("xdg-open", &[]),
    };
    let mut command = Command::new(program);
    command.args(arguments).arg(link).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    if let Err(error) = command.spawn().with_context(|| format!("cannot start {program}")) {
        tracing::info!("no browser was opened ({error:#}); open the link yourself");
    }
}
