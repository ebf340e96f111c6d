//! The grid of flags to measure: built in, or read from a file.
//!
//! ```json
//! {"points": [{
//!   "axis": "views by coverage", "name": "25 %",
//!   "views": "--view-order coverage --views-limit 25%",
//!   "lift": "--compact-error 0.1",
//!   "eval": "", "profile": "compact"
//! }]}
//! ```
//!
//! `axis` names the curve of the plots that a point belongs to. `views` are the flags of `encode` that change the views'
//! contributions; `lift` are its other flags; `eval` are flags of `eval labelled`. The shards of `profile` are evaluated,
//! measured and queried. All profiles are made, because the exact shards tell which Gaussian is which.
//!
//! `{masks}` stands for the scene's folder of true masks, `{sam}` for the model directory of Segment Anything, and
//! `{gpu:N}` for the number N, where the machine has more GPUs than that, and `{gpus:N}` for `gpu`, all of them, where it
//! has at least N; without these a point is not run. Points of
//! a scene with the same `views` share one store, and their contributions are computed once.
//!
//! `ordered` names the axes whose points ascend: plots connect their points, in the grid's order.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use slag_common::shard::Profile;

use super::error::TradeoffError;

const QUICK: &str = include_str!("quick.json");
const FULL: &str = include_str!("full.json");
const PAPER: &str = include_str!("paper.json");

/// Points to measure.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Grid {
    /// The points, in any order.
    pub points: Vec<Point>,
    /// Axes whose points ascend.
    #[serde(default)]
    pub ordered: Vec<String>,
}

/// One way of encoding a scene.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Point {
    /// The varied setting.
    pub axis: String,
    /// Its value.
    pub name: String,
    /// Flags of `encode` that change contributions.
    #[serde(default)]
    pub views: String,
    /// Other flags of `encode`.
    #[serde(default)]
    pub lift: String,
    /// Flags of `eval labelled`.
    #[serde(default)]
    pub eval: String,
    /// Profile of the evaluated shards.
    #[serde(default = "compact")]
    pub profile: Profile,
}

fn compact() -> Profile {
    Profile::Compact
}

impl Grid {
    /// Returns a small grid: ten minutes on two cores for a scene of 100,000 Gaussians and 100 views with given masks.
    ///
    /// # Errors
    /// None: a test parses the built-in grid.
    pub fn quick() -> Result<Self, TradeoffError> {
        Self::parse(QUICK, Path::new("quick.json"))
    }

    /// Returns the grid behind the figures in the documentation.
    ///
    /// # Errors
    /// None: a test parses the built-in grid.
    pub fn full() -> Result<Self, TradeoffError> {
        Self::parse(FULL, Path::new("full.json"))
    }

    /// Returns the paper's four configurations: grid of SAM's points by image step.
    ///
    /// # Errors
    /// None: a test parses the built-in grid.
    pub fn paper() -> Result<Self, TradeoffError> {
        Self::parse(PAPER, Path::new("paper.json"))
    }

    /// Reads a grid.
    ///
    /// # Errors
    /// [`TradeoffError::Grid`].
    pub fn read(path: &Path) -> Result<Self, TradeoffError> {
        Self::parse(&fs_err::read_to_string(path)?, path)
    }

    fn parse(text: &str, path: &Path) -> Result<Self, TradeoffError> {
        let wrong = |what: String| TradeoffError::Grid { path: path.to_owned(), what };
        let grid: Self = serde_json::from_str(text).map_err(|error| wrong(error.to_string()))?;
        for (number, point) in grid.points.iter().enumerate() {
            let twice = grid.points[..number].iter().any(|p| p.axis == point.axis && p.name == point.name);
            if twice {
                return Err(wrong(format!("{} / {} occurs twice", point.axis, point.name)));
            }
        }
        for axis in &grid.ordered {
            if !grid.points.iter().any(|p| p.axis == *axis) {
                return Err(wrong(format!("{axis} is ordered, and no point has this axis")));
            }
        }
        Ok(grid)
    }
}

/// What placeholders stand for, besides the scene's own data.
#[derive(Clone, Debug, Default)]
pub struct Equipment {
    /// Model directory of Segment Anything.
    pub segmenter: Option<PathBuf>,
    /// GPUs, software renderers not counted.
    pub n_gpus: usize,
}

/// Flags with their placeholders filled in, or what is missing to do so.
pub type Expanded = Result<Vec<String>, &'static str>;

/// A labelled scene: splat and poses beside `gt/` and `test/`, as `generate scene` and the labelled house have them.
#[derive(Clone, Debug)]
pub struct LabelledScene {
    /// Its folder's name.
    pub name: String,
    /// Its folder.
    pub dir: PathBuf,
    /// The splat.
    pub splat: PathBuf,
    /// The poses.
    pub poses: PathBuf,
}

impl LabelledScene {
    /// Finds the files of a labelled scene in a folder.
    ///
    /// # Errors
    /// [`TradeoffError::Scene`].
    pub fn find(dir: &Path) -> Result<Self, TradeoffError> {
        let first = |names: &[&str], what: &'static str| {
            let found = names.iter().map(|name| dir.join(name)).find(|path| path.exists());
            found.ok_or_else(|| TradeoffError::Scene {
                dir: dir.to_owned(),
                what: format!("no {what} ({})", names.join(", ")),
            })
        };
        let splat = first(&["scene.ply", "point_cloud.ply", "point_cloud.spz"], "splat")?;
        let poses = first(&["sparse/0", "transforms.json"], "poses")?;
        first(&["gt/gaussian_instance.npy"], "labels")?;
        let name = dir.canonicalize()?.file_name().unwrap_or_default().to_string_lossy().into_owned();
        Ok(Self { name, dir: dir.to_owned(), splat, poses })
    }

    /// Returns the folder of true masks, if present.
    pub fn masks(&self) -> Option<PathBuf> {
        Some(self.dir.join("gt/masks")).filter(|path| path.is_dir())
    }

    /// Replaces the placeholders in flags; the inner error says what the scene or machine lacks.
    ///
    /// # Errors
    /// [`TradeoffError::Flags`] for an unknown placeholder.
    pub fn expand(&self, flags: &str, equipment: &Equipment) -> Result<Expanded, TradeoffError> {
        let unknown = |word: &str| TradeoffError::Flags { flags: flags.to_owned(), word: word.to_owned() };
        let mut words = Vec::new();
        for word in flags.split_whitespace() {
            let inner = word.strip_prefix('{').and_then(|word| word.strip_suffix('}'));
            words.push(match inner {
                None if word.contains(['{', '}']) => return Err(unknown(word)),
                None => word.to_owned(),
                Some("masks") => match self.masks() {
                    Some(path) => path.display().to_string(),
                    None => return Ok(Err("it has no gt/masks")),
                },
                Some("sam") => match &equipment.segmenter {
                    Some(path) => path.display().to_string(),
                    None => return Ok(Err("no --segmenter is given")),
                },
                Some(inner) => {
                    let number_of = |name: &str| inner.strip_prefix(name)?.parse::<usize>().ok();
                    if let Some(least) = number_of("gpus:") {
                        match equipment.n_gpus >= least {
                            true => words.push("gpu".to_owned()),
                            false => return Ok(Err("the machine has too few GPUs")),
                        }
                        continue;
                    }
                    match number_of("gpu:") {
                        Some(number) if number < equipment.n_gpus => number.to_string(),
                        Some(_) => return Ok(Err("the machine has too few GPUs")),
                        None => return Err(unknown(word)),
                    }
                }
            });
        }
        Ok(Ok(words))
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use slag_encoder::cli::Cli;

    use super::*;

    fn scene(dir: &Path) -> LabelledScene {
        let path = dir.to_owned();
        LabelledScene { name: "a".into(), dir: path.clone(), splat: path.clone(), poses: path }
    }

    #[test]
    fn built_in_grids_have_flags_of_encode() {
        let dir = tempfile::tempdir().expect("a folder");
        fs_err::create_dir_all(dir.path().join("gt/masks")).expect("makes");
        let equipment = Equipment { segmenter: Some(dir.path().into()), n_gpus: 16 };
        for grid in [Grid::quick(), Grid::full(), Grid::paper()] {
            let grid = grid.expect("a grid");
            assert!(grid.points.len() >= 4);
            for point in &grid.points {
                let scene = scene(dir.path());
                let expand = |flags: &String| {
                    scene.expand(flags, &equipment).expect("known words").expect("it has all")
                };
                let mut line: Vec<String> = "slag-encoder encode --scene a --views b --store c"
                    .split(' ')
                    .map(str::to_owned)
                    .collect();
                line.extend([&point.views, &point.lift].into_iter().flat_map(expand));
                let parsed = Cli::try_parse_from(&line);
                assert!(
                    parsed.is_ok(),
                    "{line:?}: {}",
                    parsed.err().map_or(String::new(), |e| e.to_string())
                );
            }
        }
    }

    #[test]
    fn placeholders_are_the_scenes() {
        let dir = tempfile::tempdir().expect("a folder");
        let scene = scene(dir.path());
        let nothing = Equipment::default();
        let words = scene.expand("--views-limit 25% --x", &nothing).expect("known").expect("there");
        assert_eq!(words, ["--views-limit", "25%", "--x"]);
        assert_eq!(scene.expand("--masks {masks}", &nothing).expect("known"), Err("it has no gt/masks"));
        assert_eq!(
            scene.expand("--segmenter {sam}", &nothing).expect("known"),
            Err("no --segmenter is given")
        );
        let one = Equipment { segmenter: Some("/a b".into()), n_gpus: 1 };
        assert_eq!(scene.expand("--x {sam}", &one).expect("known"), Ok(vec!["--x".into(), "/a b".into()]));
        assert_eq!(scene.expand("{gpu:0}", &one).expect("known"), Ok(vec!["0".into()]));
        assert!(scene.expand("{gpu:1}", &one).expect("known").is_err());
        for wrong in ["{view}", "{masks", "a{masks}", "{gpu:x}"] {
            let message = scene.expand(wrong, &nothing).expect_err("unknown").to_string();
            assert!(message.contains(wrong), "{message}");
        }
        let wrong = r#"{"points": [{"axis": "a", "name": "b"}, {"axis": "a", "name": "b"}]}"#;
        let message = Grid::parse(wrong, Path::new("g.json")).expect_err("twice").to_string();
        assert!(message.contains("g.json") && message.contains("a / b occurs twice"), "{message}");
        let message =
            Grid::parse(r#"{"points": [{"name": "b"}]}"#, Path::new("g.json")).expect_err("no axis");
        assert!(message.to_string().contains("axis"), "{message}");
    }
}
