//! `models`: lists, pulls and checks public models.

use anyhow::Result;
use slag_models::ModelDir;
use slag_models::commands::{self, ModelsCommand};

use super::common::{print, session_options};
use super::exit::Exit;

pub(super) fn run(command: &ModelsCommand, json: bool) -> Result<Exit> {
    let context = commands::Context {
        variable: &|name| std::env::var_os(name),
        image: Some(&ModelDir::image_encoder),
        ask: &|question| !json && commands::ask(question),
        session: &session_options,
    };
    let report = commands::run(command, &context)?;
    print(json, &report, &report)?;
    Ok(Exit::Done)
}
