//! ScanNet v2 (Dai et al. 2017) with the protocol of OpenGaussian (Wu et al. 2024): ten scenes, 19, 15 and 10 classes,
//! argmax over the classes' words, means over the classes that a scene has.
//!
//! OpenGaussian trains with Gaussians fixed to the mesh's vertices and compares by index; for other splats, the nearest
//! Gaussian answers for a vertex. Gaussians with an opacity below `MIN_OPACITY` do not count, as in its
//! `scripts/eval_scannet.py`.

use std::collections::{BTreeMap, HashMap};
use std::fmt;

use glam::DVec3;
use serde::Serialize;
use slag_common::Gaussians;
use slag_models::TextEncoder;

use super::error::{EvalError, check_scene};
use super::filter;
use super::metrics::{Confusion, mean};
use super::report::Subset;
use super::scan::{Scan, ScanError};
use super::settings::EvalSettings;
use slag_encoder::lift::superpoint::{NO_SUPERPOINT, SuperpointSettings, Superpoints};
use slag_encoder::query;
use slag_encoder::store::StoreReader;

/// The protocol's scenes.
pub const SCENES: [&str; 10] = [
    "scene0000_00",
    "scene0062_00",
    "scene0070_00",
    "scene0097_00",
    "scene0140_00",
    "scene0200_00",
    "scene0347_00",
    "scene0400_00",
    "scene0590_00",
    "scene0645_00",
];
/// NYU40 ids and words of the 19 classes.
const CLASSES: [(u16, &str); 19] = [
    (1, "wall"),
    (2, "floor"),
    (3, "cabinet"),
    (4, "bed"),
    (5, "chair"),
    (6, "sofa"),
    (7, "table"),
    (8, "door"),
    (9, "window"),
    (10, "bookshelf"),
    (11, "picture"),
    (12, "counter"),
    (14, "desk"),
    (16, "curtain"),
    (24, "refrigerator"),
    (28, "shower curtain"),
    (33, "toilet"),
    (34, "sink"),
    (36, "bathtub"),
];
/// Ids of the 15 classes, and of the 10.
const IDS_OF_15: [u16; 15] = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 14, 16, 33, 34];
const IDS_OF_10: [u16; 10] = [1, 2, 4, 5, 6, 7, 8, 9, 10, 33];
/// More transparent Gaussians are ignored.
const MIN_OPACITY: f32 = 0.1;
/// Farther from every Gaussian, a vertex has no answer.
const MAX_DISTANCE_M: f64 = 0.1;

/// The Gaussian that answers for a vertex.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Matching {
    /// The Gaussian with the vertex's index.
    Index,
    /// The nearest Gaussian.
    Nearest,
}

/// Where the segments of the prediction filter come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum Segments {
    /// The scan's segs.json, or else superpoints.
    Auto,
    /// The scan's segs.json.
    Scan,
    /// Our superpoints of the splat.
    Superpoints,
}

/// Figures of a scene after the prediction filter.
#[derive(Clone, Debug, Serialize)]
pub struct FilteredReport {
    /// Where the segments came from: `Scan` or `Superpoints`.
    pub segments: Segments,
    /// Segments with a vertex.
    pub n_segments: usize,
    /// 19, 15 and 10 classes.
    pub subsets: Vec<Subset>,
}

/// Figures of a scene.
#[derive(Clone, Debug, Serialize)]
pub struct ScanReport {
    /// The scene.
    pub scene: String,
    /// 19, 15 and 10 classes; `n_classes` are those that the scene has.
    pub subsets: Vec<Subset>,
    /// The same after the prediction filter, where it was asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub filtered: Option<FilteredReport>,
    /// Labelled vertices of the 19 classes.
    pub n_labelled: usize,
    /// Labelled vertices without an answer, because no Gaussian is near or it has no evidence; they count as wrong.
    pub n_without_answer: usize,
    /// Labels that the table of categories lacks, with their vertices, which are not counted.
    pub unknown_labels: BTreeMap<String, usize>,
    /// Classes with words that the encoder does not know, and why; they count as never found.
    pub unknown_words: BTreeMap<String, String>,
}

/// Figures of several scenes.
#[derive(Clone, Debug, Serialize)]
pub struct ScannetReport {
    /// Each.
    pub scenes: Vec<ScanReport>,
    /// Means over the scenes, of 19, 15 and 10 classes.
    pub means: Vec<Subset>,
    /// The same after the prediction filter, where it was asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub filtered_means: Option<Vec<Subset>>,
    /// The paper's rows, over its ten scenes.
    pub paper: [PaperRow; 2],
    /// Scenes of the protocol that were not evaluated.
    pub missing_scenes: Vec<&'static str>,
}

/// A row of the paper's ScanNet table, in percent (Szilagyi, Engelmann, Bohg, RA-L 2025).
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PaperRow {
    /// Its name.
    pub name: &'static str,
    /// mIoU and mAcc of 19, 15 and 10 classes.
    pub percent: [[f64; 2]; 3],
}

/// The paper's rows without and with its prediction filter.
const PAPER: [PaperRow; 2] = [
    PaperRow { name: "SLAG (paper)", percent: [[28.98, 43.40], [28.98, 44.26], [37.14, 54.80]] },
    PaperRow { name: "SLAG PF (paper)", percent: [[37.54, 49.99], [37.71, 50.70], [45.46, 60.08]] },
];

/// Evaluates a store against a labelled mesh.
///
/// `scene` is the splat that was encoded, in the mesh's frame. With `segments`, the figures after the paper's prediction
/// filter are beside the plain ones: all vertices of a segment take the class that most of its vertices with an answer
/// have, ties going to the first of the list. Labels have no part in it; vertices without one vote too.
///
/// # Errors
/// [`EvalError`].
pub fn scannet(
    reader: &StoreReader,
    scan: &Scan,
    scene: &Gaussians,
    encoder: &mut dyn TextEncoder,
    matching: Matching,
    segments: Option<Segments>,
    settings: &EvalSettings,
) -> Result<ScanReport, EvalError> {
    check_scene(reader, scene)?;
    let gaussian_of = match matching {
        Matching::Index => by_index(scan, scene)?,
        Matching::Nearest => by_distance(scan, scene),
    };
    let mut unknown_words = BTreeMap::new();
    let mut first_error = None;
    let mut scores: Vec<Option<Vec<f32>>> = Vec::new();
    for (_, word) in CLASSES {
        let vector = match encoder.encode(word) {
            Ok(vector) => vector,
            Err(error) => {
                unknown_words.insert(word.to_owned(), error.to_string());
                first_error.get_or_insert((word.to_owned(), error));
                scores.push(None);
                continue;
            }
        };
        scores.push(Some(match settings.profile {
            Some(profile) => query::scores_of_shards(reader, &vector, profile)?.cosines,
            None => query::scores(reader, &vector)?.cosines,
        }));
    }
    if let (true, Some((first, source))) = (scores.iter().all(Option::is_none), first_error) {
        return Err(EvalError::NoWords { n: CLASSES.len(), first, source: Box::new(source) });
    }
    let score = |class: usize, gaussian: usize| {
        let of_class = scores[class].as_ref()?;
        of_class.get(gaussian).copied().filter(|score| !score.is_nan())
    };
    let ids_of_19 = CLASSES.map(|(id, _)| id);
    let filter = segments.map(|from| segments_of(scan, scene, &gaussian_of, from)).transpose()?;
    let judge = |ids: &[u16], filter: Option<&Superpoints>| {
        let classes: Vec<usize> =
            (0..CLASSES.len()).filter(|class| ids.contains(&CLASSES[*class].0)).collect();
        let answer = |answerer: &Answerer| {
            let gaussian = answerer.counted()??;
            let answers = classes.iter().filter_map(|class| Some((*class, score(*class, gaussian)?)));
            answers.max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0))).map(|(class, _)| class)
        };
        let mut answers: Vec<Option<usize>> = gaussian_of.iter().map(answer).collect();
        if let Some(segments) = filter {
            filter::vote(&mut answers, segments);
        }
        subset(&classes, scan, &gaussian_of, &answers)
    };
    let all_subsets = |filter: Option<&Superpoints>| {
        [&ids_of_19[..], &IDS_OF_15, &IDS_OF_10].map(|ids| judge(ids, filter)).to_vec()
    };
    let subsets = all_subsets(None);
    let filtered = filter.map(|(segments, of_vertex)| FilteredReport {
        segments,
        n_segments: of_vertex.n,
        subsets: all_subsets(Some(&of_vertex)),
    });
    let counted = scan.labels.iter().zip(&gaussian_of).filter(|(label, _)| ids_of_19.contains(label));
    let counted: Vec<Option<usize>> = counted.filter_map(|(_, gaussian)| gaussian.counted()).collect();
    let has_answer = |gaussian: &Option<usize>| {
        gaussian.is_some_and(|gaussian| (0..CLASSES.len()).any(|class| score(class, gaussian).is_some()))
    };
    Ok(ScanReport {
        scene: scan.name.clone(),
        subsets,
        filtered,
        n_labelled: counted.len(),
        n_without_answer: counted.iter().filter(|gaussian| !has_answer(gaussian)).count(),
        unknown_labels: scan.unknown_labels.clone(),
        unknown_words,
    })
}

/// Compares answers with labels; means are over the classes that the scene has, as in the protocol.
fn subset(classes: &[usize], scan: &Scan, gaussian_of: &[Answerer], answers: &[Option<usize>]) -> Subset {
    let mut confusion = Confusion::new(CLASSES.len());
    for ((label, answerer), answer) in scan.labels.iter().zip(gaussian_of).zip(answers) {
        let truth = classes.iter().copied().find(|class| CLASSES[*class].0 == *label);
        if let (Some(truth), Some(_)) = (truth, answerer.counted()) {
            confusion.count(truth, *answer);
        }
    }
    let present: Vec<usize> =
        classes.iter().copied().filter(|class| confusion.accuracy(*class).is_some()).collect();
    Subset {
        n_classes: present.len(),
        miou: mean(present.iter().map(|class| confusion.iou(*class))),
        macc: mean(present.iter().map(|class| confusion.accuracy(*class))),
    }
}

/// Returns the segment of each vertex, numbered from 0, and where it came from. Vertices that are left out are in none.
fn segments_of(
    scan: &Scan,
    scene: &Gaussians,
    gaussian_of: &[Answerer],
    from: Segments,
) -> Result<(Segments, Superpoints), EvalError> {
    let of_scan = if from == Segments::Superpoints { None } else { scan.segments()? };
    if of_scan.is_none() && from == Segments::Scan {
        let what = "does not exist; add it, or use --segments superpoints".to_owned();
        return Err(ScanError::Wrong { path: scan.segments_path(), what }.into());
    }
    let (used, ids) = match of_scan {
        Some(ids) => (Segments::Scan, ids),
        None => {
            let superpoints = Superpoints::new(scene, None, &SuperpointSettings::of_looks());
            let of_vertex = |answerer: &Answerer| match answerer {
                Answerer::Gaussian(gaussian) => superpoints.of_gaussian[*gaussian],
                Answerer::None | Answerer::LeftOut => NO_SUPERPOINT,
            };
            (Segments::Superpoints, gaussian_of.iter().map(of_vertex).collect())
        }
    };
    let mut number_of = HashMap::new();
    let mut of_gaussian = Vec::with_capacity(ids.len());
    for (id, answerer) in ids.iter().zip(gaussian_of) {
        if *answerer == Answerer::LeftOut || (used == Segments::Superpoints && *id == NO_SUPERPOINT) {
            of_gaussian.push(NO_SUPERPOINT);
            continue;
        }
        // Fewer segments than vertices, which a mesh of less than 4 GiB numbers with 32 bits.
        let next = number_of.len() as u32;
        of_gaussian.push(*number_of.entry(*id).or_insert(next));
    }
    Ok((used, Superpoints { of_gaussian, n: number_of.len() }))
}

/// The answer's source for a vertex.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Answerer {
    /// A Gaussian.
    Gaussian(usize),
    /// None is near; the vertex counts as wrong.
    None,
    /// The Gaussian is too transparent; the vertex is left out.
    LeftOut,
}

impl Answerer {
    /// Returns `None` where the vertex is left out, and else the Gaussian, if there is one.
    fn counted(self) -> Option<Option<usize>> {
        match self {
            Self::Gaussian(gaussian) => Some(Some(gaussian)),
            Self::None => Some(None),
            Self::LeftOut => None,
        }
    }
}

fn by_index(scan: &Scan, scene: &Gaussians) -> Result<Vec<Answerer>, ScanError> {
    let (n_vertices, n_gaussians) = (scan.vertices.len(), scene.len());
    if n_vertices != n_gaussians {
        return Err(ScanError::Length { dir: scan.dir.clone(), n_vertices, n_gaussians });
    }
    let answerer = |k: usize| match scene.opacities[k] < MIN_OPACITY {
        true => Answerer::LeftOut,
        false => Answerer::Gaussian(k),
    };
    Ok((0..n_gaussians).map(answerer).collect())
}

fn by_distance(scan: &Scan, scene: &Gaussians) -> Vec<Answerer> {
    let counts = |k: &usize| scene.is_usable(*k) && scene.opacities[*k] >= MIN_OPACITY;
    // Cubes of edge MAX_DISTANCE_M: a Gaussian within reach lies in the vertex's own cube or in a neighbouring one.
    let cube_of = |point: DVec3| (point / MAX_DISTANCE_M).floor().to_array().map(|v| v as i64);
    let mut cubes: HashMap<[i64; 3], Vec<usize>> = HashMap::new();
    for k in (0..scene.len()).filter(counts) {
        cubes.entry(cube_of(scene.means_in_world[k])).or_default().push(k);
    }
    let nearest = |vertex: &[f64; 3]| {
        let vertex = DVec3::from_array(*vertex);
        let [x, y, z] = cube_of(vertex);
        let steps =
            || (-1..=1).flat_map(|dx| (-1..=1).flat_map(move |dy| (-1..=1).map(move |dz| [dx, dy, dz])));
        let near = steps().filter_map(|[dx, dy, dz]| {
            cubes.get(&[x.saturating_add(dx), y.saturating_add(dy), z.saturating_add(dz)])
        });
        let distances = near.flatten().map(|k| (scene.means_in_world[*k].distance_squared(vertex), *k));
        // Ties are broken by index.
        let (distance2, k) = distances.min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)))?;
        (distance2 <= MAX_DISTANCE_M * MAX_DISTANCE_M).then_some(k)
    };
    scan.vertices.iter().map(|vertex| nearest(vertex).map_or(Answerer::None, Answerer::Gaussian)).collect()
}

impl ScannetReport {
    /// Takes the means over scenes.
    pub fn new(scenes: Vec<ScanReport>) -> Self {
        let means_of = |subsets: &dyn Fn(&ScanReport) -> Option<Vec<Subset>>| -> Option<Vec<Subset>> {
            let of_scenes: Vec<Vec<Subset>> = scenes.iter().map(subsets).collect::<Option<_>>()?;
            let mean_of = |at: usize| Subset {
                n_classes: [CLASSES.len(), IDS_OF_15.len(), IDS_OF_10.len()][at],
                miou: mean(of_scenes.iter().map(|subsets| subsets[at].miou)),
                macc: mean(of_scenes.iter().map(|subsets| subsets[at].macc)),
            };
            Some((0..3).map(mean_of).collect())
        };
        let means = means_of(&|scene| Some(scene.subsets.clone())).unwrap_or_default();
        let filtered_means = means_of(&|scene| Some(scene.filtered.as_ref()?.subsets.clone()));
        let missing_scenes =
            SCENES.into_iter().filter(|name| !scenes.iter().any(|s| s.scene == *name)).collect();
        Self { scenes, means, filtered_means, paper: PAPER, missing_scenes }
    }
}

impl fmt::Display for ScannetReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let show = |value: Option<f64>| value.map_or("-".into(), |v| format!("{v:.3}"));
        let figures = |subsets: &[Subset]| {
            let figures = subsets.iter().map(|s| format!("{:>7} {:>7}", show(s.miou), show(s.macc)));
            figures.collect::<Vec<_>>().join(" |")
        };
        writeln!(f, "{:<16} {}", "", ["  19 classes    ", "   15 classes    ", "   10 classes"].concat())?;
        writeln!(f, "{:<16} {}", "scene", ["   mIoU    mAcc"; 3].join(" |"))?;
        for scene in &self.scenes {
            writeln!(f, "{:<16} {}", scene.scene, figures(&scene.subsets))?;
            if let Some(filtered) = &scene.filtered {
                writeln!(f, "{:<16} {}", format!("{} PF", scene.scene), figures(&filtered.subsets))?;
            }
        }
        writeln!(f, "{:<16} {}", "mean", figures(&self.means))?;
        if let Some(means) = &self.filtered_means {
            writeln!(f, "{:<16} {}", "mean PF", figures(means))?;
        }
        for row in &self.paper {
            let figures =
                row.percent.map(|[miou, macc]| format!("{:>7.3} {:>7.3}", miou / 100.0, macc / 100.0));
            writeln!(f, "{:<16} {}", row.name, figures.join(" |"))?;
        }
        for scene in &self.scenes {
            if let Some(FilteredReport { segments, n_segments, .. }) = &scene.filtered {
                let from = match segments {
                    Segments::Superpoints => {
                        "superpoints of the splat, as the scan has no segs.json or it was not asked for"
                    }
                    Segments::Auto | Segments::Scan => "segments of ScanNet's segs.json",
                };
                writeln!(f, "{} PF: majority class of {n_segments} {from}", scene.scene)?;
            }
        }
        for scene in &self.scenes {
            if scene.n_without_answer > 0 {
                let (n, of) = (scene.n_without_answer, scene.n_labelled);
                writeln!(
                    f,
                    "{}: {n} of {of} labelled vertices have no answer and count as wrong",
                    scene.scene
                )?;
            }
            for (label, n) in &scene.unknown_labels {
                writeln!(
                    f,
                    "{}: {n} vertices left out: the table of categories lacks {label:?}",
                    scene.scene
                )?;
            }
            for (word, reason) in &scene.unknown_words {
                writeln!(
                    f,
                    "{}: unknown to the encoder and counted as never found: {word} ({reason})",
                    scene.scene
                )?;
            }
        }
        if !self.missing_scenes.is_empty() {
            writeln!(
                f,
                "the means differ from the protocol's: {} were not evaluated",
                self.missing_scenes.join(", ")
            )?;
        }
        Ok(())
    }
}
