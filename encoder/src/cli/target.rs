//! `encode --target-seconds S --target-bytes B`: the choices are picked from a measured front.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, Result, anyhow};
use clap::{Args, FromArgMatches};
use slag_common::ByteSize;

use super::choices::ChoiceArgs;
use super::common::parse_secs;
use crate::encode::front::{Expectation, Front, Target};
use crate::encode::{InputSettings, count_inputs};

/// A target instead of a preset.
#[derive(Clone, Debug, Default, Args)]
#[command(next_help_heading = "Target")]
pub(crate) struct TargetArgs {
    /// Picks the most accurate measured setting that is expected to take at most this many seconds. The
    /// expectation holds for the machine, models and size of photos that the front was measured with.
    #[arg(long, value_name = "S", value_parser = parse_secs, requires = "front", conflicts_with_all = ["choices", "segmenter"], hide_short_help = true)]
    target_seconds: Option<Duration>,
    /// Picks the most accurate measured setting whose compact shards are expected to have at most this many bytes.
    #[arg(long, value_name = "BYTES", requires = "front", conflicts_with_all = ["choices", "segmenter"], hide_short_help = true)]
    target_bytes: Option<ByteSize>,
    /// Front to pick from: front.json, as `slag-lab bench tradeoff` writes it for your machine and scenes.
    #[arg(long, value_name = "FILE", hide_short_help = true)]
    front: Option<PathBuf>,
}

impl TargetArgs {
    /// Returns the choices that meet the target on the inputs, and what is expected of them; `None` without a
    /// target.
    pub(super) fn choose(&self, inputs: &InputSettings) -> Result<Option<(ChoiceArgs, Expectation)>> {
        let seconds = self.target_seconds.map(|seconds| seconds.as_secs_f64());
        let target = Target { seconds, bytes: self.target_bytes.map(|bytes| bytes.0) };
        let Some(path) = &self.front else { return Ok(None) };
        if target == Target::default() {
            return Err(anyhow!("--front needs --target-seconds or --target-bytes"));
        }
        let front = Front::read(path)?;
        let (n_photos, n_gaussians) = count_inputs(inputs)?;
        let chosen = front.choose(target, n_photos, n_gaussians)?;
        let bytes = ByteSize(chosen.bytes as u64);
        tracing::info!(
            "setting {:?} ({}): {:.1} s and {bytes} of {} shards are expected for {n_photos} photos and {n_gaussians} \
             Gaussians, measured on {} scenes on {} with {}; mIoU there {:.3}",
            chosen.setting.name,
            chosen.setting.flags,
            chosen.seconds,
            chosen.setting.profile,
            front.n_scenes,
            front.machine,
            front.measured_with,
            chosen.setting.miou,
        );
        Ok(Some((parse_choices(&chosen.setting.flags)?, chosen)))
    }
}

/// Parses the flags of a front's setting.
fn parse_choices(flags: &str) -> Result<ChoiceArgs> {
    let command = ChoiceArgs::augment_args(clap::Command::new("encode").no_binary_name(true));
    command
        .try_get_matches_from(flags.split_whitespace())
        .and_then(|matches| ChoiceArgs::from_arg_matches(&matches))
        .with_context(|| format!("the front's setting {flags:?} is not understood"))
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;
    use crate::cli::Cli;
    use crate::encode::{EncodeSettings, ViewsLimit};

    #[test]
    fn a_setting_of_a_front_has_choices_and_nothing_else() {
        let choices = parse_choices("--preset fast --views-limit 25% --superpoint 3").expect("understood");
        let mut settings = EncodeSettings::new(PathBuf::new(), PathBuf::new(), PathBuf::new(), true);
        choices.apply(&mut settings);
        assert_eq!(
            (settings.run.views_limit, settings.aggregation.superpoint),
            (ViewsLimit::Share(0.25), 3.0)
        );
        for wrong in ["--scene x", "--segmenter x", "--threads 1", "--preset nothing", "--models=x"] {
            let message = format!("{:#}", parse_choices(wrong).expect_err("refused"));
            assert!(message.contains(wrong), "{message}");
        }
    }

    #[test]
    fn a_target_excludes_what_it_chooses() {
        let parse = |flags: &str| {
            let line = format!("slag-encoder encode --scene a --views b --store c {flags}");
            Cli::command().try_get_matches_from(line.split_whitespace())
        };
        for flag in ["--preset fast", "--keep-slivers", "--max-components 8", "--fill true", "--segmenter x"]
        {
            parse(flag).expect("a flag of encode");
            let error = parse(&format!("--front f.json --target-bytes 3MiB {flag}")).expect_err("excluded");
            assert_eq!(error.kind(), clap::error::ErrorKind::ArgumentConflict, "{flag}");
        }
        parse("--front f.json --target-bytes 3MiB --threads 2").expect("no choice");
        assert!(parse("--front f.json --target-seconds 0").is_err());
        let without = parse("--target-seconds 60").expect_err("no front");
        assert_eq!(without.kind(), clap::error::ErrorKind::MissingRequiredArgument);
    }
}
