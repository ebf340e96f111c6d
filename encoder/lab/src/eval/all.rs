//! `eval all`: every table that a change is judged by, from one command.

use std::ffi::OsStr;
use std::fmt;

use anyhow::Result;
use clap::{Args, Command};
use serde::Serialize;
use slag_encoder::progress::Progress;

use super::run::ScenesArgs;
use super::{defaults, goal, masks, relations};

#[derive(Clone, Debug, Serialize)]
pub(crate) struct AllReport {
    defaults: defaults::DefaultsReport,
    masks: masks::MasksReport,
    relations: relations::RelationsReport,
    goal: goal::GoalReport,
}

pub(crate) fn run(args: &ScenesArgs, progress: &dyn Progress) -> Result<AllReport> {
    let dir = |flag: &str| args.out.join(flag).into_os_string();
    let (of_relations, of_goal) = (dir("relations"), dir("goal"));
    let scenes = args.scene.iter().map(|dir| dir.as_os_str());
    let of_masks: Vec<&OsStr> = [OsStr::new("--scene")].into_iter().chain(scenes).collect();
    let [of_relations, of_goal] = [&of_relations, &of_goal].map(|out| [OsStr::new("--out"), out.as_os_str()]);
    // What fails early comes first.
    Ok(AllReport {
        masks: masks::run(&with_defaults(&of_masks)?, progress)?,
        defaults: defaults::run(args, progress)?,
        relations: relations::run(&with_defaults(&of_relations)?, progress)?,
        goal: goal::run(&with_defaults(&of_goal)?, progress)?,
    })
}

/// Returns a command's arguments with only these flags given.
fn with_defaults<T: Args>(flags: &[&OsStr]) -> Result<T> {
    let command = T::augment_args(Command::new("all").no_binary_name(true));
    Ok(T::from_arg_matches(&command.try_get_matches_from(flags)?)?)
}

impl fmt::Display for AllReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { defaults, masks, relations, goal } = self;
        write!(f, "Words and objects\n\n{defaults}\nMasks\n\n{masks}\n")?;
        write!(f, "Relations\n\n{relations}\nPlaces to stand\n\n{goal}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_command_takes_its_flags() {
        let flags = ["--scene", "a", "b"].map(OsStr::new);
        let masks = with_defaults::<masks::MasksArgs>(&flags).map(|args| format!("{args:?}"));
        assert!(masks.is_ok_and(|args| args.contains(r#"scene: ["a", "b"]"#)));
        let out = ["--out", "c"].map(OsStr::new);
        assert!(with_defaults::<relations::RelationsArgs>(&out).is_ok());
        assert!(with_defaults::<goal::GoalArgs>(&out).is_ok());
    }
}
