//! ScanNet v2 (Dai et al. 2017) with the protocol of OpenGaussian (Wu et al. 2024): ten scenes, 19, 15 and 10
//! classes, argmax over the classes' words, means over the classes that a scene has.
//!
//! The nearest Gaussian answers for a vertex (OpenGaussian fixes Gaussians to the mesh's vertices). Gaussians with
//! an opacity below `MIN_OPACITY` do not count, as in its `scripts/eval_scannet.py`.

use std::collections::{BTreeMap, HashMap};
use std::fmt;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use glam::DVec3;
use serde::{Deserialize, Serialize};
use slag_common::poses::PoseSource;
use slag_common::splat::ply::read_vertices;
use slag_common::{Gaussians, splat};
use slag_encoder::cli::common::{ModelArgs, parse_frame, text_encoder_of};
use slag_encoder::ingest::{self, FrameChoice};
use slag_encoder::query;
use slag_encoder::store::StoreReader;
use slag_models::TextEncoder;

use super::judge::Subset;
use super::metrics::{Confusion, mean};
use super::truth::check_scene;
use crate::table::{Table, figure};

const SCENES: &str = "scene0000_00 scene0062_00 scene0070_00 scene0097_00 scene0140_00 scene0200_00 scene0347_00 scene0400_00 \
                      scene0590_00 scene0645_00";
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
const IDS_OF_15: [u16; 15] = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 14, 16, 33, 34];
const IDS_OF_10: [u16; 10] = [1, 2, 4, 5, 6, 7, 8, 9, 10, 33];
/// More transparent Gaussians are ignored.
const MIN_OPACITY: f32 = 0.1;
/// A vertex farther than this from every Gaussian has no answer.
const MAX_DISTANCE_M: f64 = 0.1;
/// The paper's rows over its ten scenes: mIoU and mAcc of 19, 15 and 10 classes (Szilagyi, Engelmann, Bohg, RA-L
/// 2025).
const PAPER: [(&str, [[f64; 2]; 3]); 3] = [
    ("OpenGaussian (paper)", [[0.2473, 0.4154], [0.3013, 0.4825], [0.3829, 0.5519]]),
    ("SLAG (paper)", [[0.2898, 0.4340], [0.2898, 0.4426], [0.3714, 0.5480]]),
    ("SLAG PF (paper)", [[0.3754, 0.4999], [0.3771, 0.5070], [0.4546, 0.6008]]),
];

#[derive(Debug, Args)]
pub(crate) struct ScannetArgs {
    /// Store; once per scan.
    #[arg(long, value_name = "DIR", required = true)]
    store: Vec<PathBuf>,
    /// The splat that was encoded; once per scan.
    #[arg(long, value_name = "FILE", required = true)]
    scene: Vec<PathBuf>,
    /// Scan: scans/sceneXXXX_YY; may be repeated.
    #[arg(long, value_name = "DIR", required = true)]
    scan: Vec<PathBuf>,
    /// Says how the splat's frame follows from that of the scan, see `slag-encoder encode --help`: auto, none or a
    /// file.
    #[arg(long, value_name = "auto|none|FILE", default_value = "auto", value_parser = parse_frame)]
    splat_frame: FrameChoice,
    /// The models that the stores were encoded with.
    #[command(flatten)]
    models: ModelArgs,
    /// Also evaluates with the paper's prediction filter (PF): all vertices of a segment of ScanNet's segs.json
    /// take its most frequent class.
    #[arg(long)]
    segments: bool,
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct ScanReport {
    scene: String,
    /// 19, 15 and 10 classes; `n_classes` are those that the scene has.
    pub(super) subsets: Vec<Subset>,
    /// The same after the prediction filter.
    pub(super) filtered: Option<Vec<Subset>>,
    pub(super) n_labelled: usize,
    /// Labelled vertices without an answer, because no Gaussian is near or it has no evidence; they count as
    /// wrong.
    pub(super) n_without_answer: usize,
    /// Classes with words that the encoder does not know, and why; they count as never found.
    pub(super) unknown_words: BTreeMap<String, String>,
}

#[derive(Clone, Debug, Serialize)]
pub(crate) struct ScannetReport {
    scenes: Vec<ScanReport>,
    /// Means over the scenes, of 19, 15 and 10 classes.
    means: Vec<Subset>,
    filtered_means: Option<Vec<Subset>>,
    /// Scenes of the protocol that were not evaluated.
    pub(super) missing_scenes: Vec<&'static str>,
}

pub(crate) fn run(args: &ScannetArgs) -> Result<ScannetReport> {
    let (n_scans, n_stores, n_scenes) = (args.scan.len(), args.store.len(), args.scene.len());
    if n_stores != n_scans || n_scenes != n_scans {
        bail!(
            "{n_scans} scans, {n_stores} stores and {n_scenes} splats; give --scan, --store and --scene once per scan, \
             in the same order"
        );
    }
    let mut scenes = Vec::new();
    for ((scan, store), path) in args.scan.iter().zip(&args.store).zip(&args.scene) {
        let reader = StoreReader::open(store)?;
        let mut encoder = text_encoder_of(&reader, &args.models)?;
        let mut scene = splat::read(path, &splat::ReadOptions { with_sh_rest: false })?;
        ingest::to_poses(&mut scene, path, &args.splat_frame, PoseSource::Scannet, None)?;
        let scan = Scan::read(scan)?;
        scenes.push(judge(&reader, &scan, &scene, &mut *encoder, args.segments)?);
    }
    Ok(ScannetReport::new(scenes))
}

/// Evaluates a store against a labelled mesh. `scene` is the splat that was encoded, in the mesh's frame.
pub(super) fn judge(
    reader: &StoreReader,
    scan: &Scan,
    scene: &Gaussians,
    encoder: &mut dyn TextEncoder,
    with_segments: bool,
) -> Result<ScanReport> {
    check_scene(reader, scene.len())?;
    let nearest = nearest_gaussians(scan, scene);
    let (mut unknown_words, mut scores) = (BTreeMap::new(), Vec::new());
    for (_, word) in CLASSES {
        scores.push(match encoder.encode(word) {
            Ok(vector) => query::scores(reader, &vector)?.cosines,
            Err(error) => {
                unknown_words.insert(word.to_owned(), error.to_string());
                Vec::new()
            }
        });
    }
    if unknown_words.len() == CLASSES.len() {
        bail!("the encoder knows none of the {} words: {unknown_words:?}", CLASSES.len());
    }
    let answers = Answers { scan, nearest: &nearest, scores: &scores };
    let segments = if with_segments { Some(scan.segments()?) } else { None };
    let subsets = |segments: Option<&[u32]>| {
        let ids_of_19 = CLASSES.map(|(id, _)| id);
        [&ids_of_19[..], &IDS_OF_15, &IDS_OF_10].map(|ids| answers.subset(ids, segments)).to_vec()
    };
    let is_judged = |label: &u16| CLASSES.iter().any(|(id, _)| id == label);
    let judged = scan.labels.iter().zip(&nearest).filter(|(label, _)| is_judged(label));
    let judged: Vec<Option<usize>> = judged.map(|(_, nearest)| *nearest).collect();
    let all: Vec<usize> = (0..CLASSES.len()).collect();
    Ok(ScanReport {
        scene: scan.name.clone(),
        subsets: subsets(None),
        filtered: segments.as_deref().map(|segments| subsets(Some(segments))),
        n_labelled: judged.len(),
        n_without_answer: judged.iter().filter(|gaussian| answers.best(**gaussian, &all).is_none()).count(),
        unknown_words,
    })
}

/// The Gaussian that answers each vertex, and its scores of each class.
struct Answers<'a> {
    scan: &'a Scan,
    /// `None`: no Gaussian within reach; the vertex counts as wrong.
    nearest: &'a [Option<usize>],
    /// By class; empty for an unknown word.
    scores: &'a [Vec<f32>],
}

impl Answers<'_> {
    /// Best of some classes; ties go to the first.
    fn best(&self, gaussian: Option<usize>, classes: &[usize]) -> Option<usize> {
        let gaussian = gaussian?;
        let score =
            |class: &usize| self.scores[*class].get(gaussian).copied().filter(|score| !score.is_nan());
        let scored = classes.iter().filter_map(|class| Some((*class, score(class)?)));
        scored.max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0))).map(|(class, _)| class)
    }

    /// Compares answers with labels; means are over the classes in the scene, as in the protocol.
    fn subset(&self, ids: &[u16], segments: Option<&[u32]>) -> Subset {
        let classes: Vec<usize> =
            (0..CLASSES.len()).filter(|class| ids.contains(&CLASSES[*class].0)).collect();
        let mut answers: Vec<Option<usize>> =
            self.nearest.iter().map(|gaussian| self.best(*gaussian, &classes)).collect();
        if let Some(segments) = segments {
            vote(&mut answers, segments);
        }
        let mut confusion = Confusion::new(CLASSES.len());
        for (label, answer) in self.scan.labels.iter().zip(answers) {
            if let Some(truth) = classes.iter().copied().find(|class| CLASSES[*class].0 == *label) {
                confusion.count(truth, answer);
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
}

/// The paper's prediction filter: all vertices of a segment take the class that most of its vertices with an answer
/// have, ties going to the first of the list. Vertices without a label vote, too.
fn vote(answers: &mut [Option<usize>], segments: &[u32]) {
    let mut votes: HashMap<u32, [u32; CLASSES.len()]> = HashMap::new();
    for (segment, answer) in segments.iter().zip(&*answers) {
        if let Some(class) = answer {
            votes.entry(*segment).or_default()[*class] += 1;
        }
    }
    for (segment, answer) in segments.iter().zip(answers) {
        if let Some(counts) = votes.get(segment) {
            *answer = (0..counts.len()).max_by_key(|class| (counts[*class], std::cmp::Reverse(*class)));
        }
    }
}

fn nearest_gaussians(scan: &Scan, scene: &Gaussians) -> Vec<Option<usize>> {
    let counts = |k: &usize| scene.is_usable(*k) && scene.opacities[*k] >= MIN_OPACITY;
    // Cubes of edge MAX_DISTANCE_M: a Gaussian within reach lies in the vertex's own or a neighbouring cube.
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
    scan.vertices.iter().map(nearest).collect()
}

impl ScannetReport {
    pub(super) fn new(scenes: Vec<ScanReport>) -> Self {
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
        let filtered_means = means_of(&|scene| scene.filtered.clone());
        let missing_scenes =
            SCENES.split(' ').filter(|name| !scenes.iter().any(|s| s.scene == *name)).collect();
        Self { scenes, means, filtered_means, missing_scenes }
    }

    pub(crate) fn is_complete(&self) -> bool {
        self.scenes.iter().all(|s| s.unknown_words.is_empty())
    }
}

impl fmt::Display for ScannetReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let columns = ["scene", "mIoU of 19", "mAcc", "mIoU of 15", "mAcc", "mIoU of 10", "mAcc"];
        let mut table = Table::new(columns);
        let mut row = |name: String, subsets: &[Subset]| {
            let figures = subsets.iter().flat_map(|s| [figure(s.miou), figure(s.macc)]);
            table.row(std::iter::once(name).chain(figures));
        };
        for scene in &self.scenes {
            row(scene.scene.clone(), &scene.subsets);
            scene.filtered.iter().for_each(|subsets| row(format!("{} PF", scene.scene), subsets));
        }
        row("mean".into(), &self.means);
        self.filtered_means.iter().for_each(|means| row("mean PF".into(), means));
        for (name, figures) in PAPER {
            let subset = |[miou, macc]: [f64; 2]| Subset { n_classes: 0, miou: Some(miou), macc: Some(macc) };
            row(name.into(), &figures.map(subset));
        }
        write!(f, "{table}")?;
        for scene in &self.scenes {
            let name = &scene.scene;
            if scene.n_without_answer > 0 {
                let (n, of) = (scene.n_without_answer, scene.n_labelled);
                writeln!(f, "{name}: {n} of {of} labelled vertices have no answer and count as wrong")?;
            }
            for (word, reason) in &scene.unknown_words {
                writeln!(f, "{name}: unknown to the encoder and counted as never found: {word} ({reason})")?;
            }
        }
        if !self.missing_scenes.is_empty() {
            let missing = self.missing_scenes.join(", ");
            writeln!(f, "the means differ from the protocol's: {missing} were not evaluated")?;
        }
        Ok(())
    }
}

const MAX_ID: u16 = 40;

#[derive(Clone, Debug)]
pub(super) struct Scan {
    pub(super) name: String,
    pub(super) dir: PathBuf,
    /// The vertices, world frame, metres.
    pub(super) vertices: Vec<[f64; 3]>,
    /// `[N]`: NYU40 ids; 0 for none.
    pub(super) labels: Vec<u16>,
}

#[derive(Deserialize)]
struct Segments {
    #[serde(rename = "segIndices")]
    of_vertex: Vec<u32>,
}

impl Scan {
    pub(super) fn read(dir: &Path) -> Result<Self> {
        let name = dir.canonicalize()?.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let path = dir.join(format!("{name}_vh_clean_2.labels.ply"));
        let rows = read_vertices(&path, ["x", "y", "z", "label"])?;
        if let Some(row) = rows.iter().find(|row| !(0.0..=f64::from(MAX_ID)).contains(&row[3])) {
            let label = row[3];
            bail!(
                "{}: label {label}, expected 0 to {MAX_ID} (NYU40); use the file of the v2 release",
                path.display()
            );
        }
        let (vertices, labels) = rows.iter().map(|[x, y, z, label]| ([*x, *y, *z], *label as u16)).unzip();
        Ok(Self { name, dir: dir.to_owned(), vertices, labels })
    }

    /// Returns the segment of each vertex (`[N]`, numbers of the file) by ScanNet's Segmentator.
    pub(super) fn segments(&self) -> Result<Vec<u32>> {
        let path = self.dir.join(format!("{}_vh_clean_2.0.010000.segs.json", self.name));
        let expected = || format!("{}: expected segIndices, one per vertex", path.display());
        let segments: Segments = serde_json::from_slice(&fs_err::read(&path)?).with_context(expected)?;
        let (n, n_vertices) = (segments.of_vertex.len(), self.vertices.len());
        if n != n_vertices {
            bail!(
                "{}: {n} segments, expected one for each of {n_vertices} vertices; use both files of one release",
                path.display()
            );
        }
        Ok(segments.of_vertex)
    }
}
