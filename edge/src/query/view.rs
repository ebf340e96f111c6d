//! Messages for the page that draws the Gaussians on board and colours them by a question.

use glam::{DVec3, Vec3};
use slag_common::shard::ShardView;
use slag_view::{
    CELL_HEAD_BYTES, Cell, CellState, Description, Fetched, GAUSSIAN_BYTES, Photo, ScoresMessage, Step,
    Words, cell_message,
};

use super::engine::{Engine, QueryError};
use super::inventory::NAMES_WAIT;
use super::request::{Negatives, QueryRequest};
use super::scene::Scene;
use super::status::map_status;
use crate::score::{Budget, Precision, Question, Region, ScoreError, Search, relevancy};
use crate::store::Snapshot;

/// Below every cosine, and below every difference of two cosines.
const BELOW_ALL: f32 = -4.0;
const PROGRAM: &str = "slag-edge";

impl Engine {
    pub fn view(
        &self,
        robot_in_world: impl Fn(&Snapshot) -> Option<DVec3>,
        budget: &Budget,
    ) -> Result<Description, QueryError> {
        let on_board = self.on_board()?;
        let snapshot = &on_board.snapshot;
        let photos = snapshot.shards.iter().filter_map(|shard| shard.additions().photo_poses);
        let n_photos: usize = photos.map(|photos| photos.iter().count()).sum();
        budget.take(n_photos * size_of::<Photo>() + snapshot.manifest.cells.len() * size_of::<Cell>());
        budget.check()?;
        let can_ask = on_board.check().is_ok();
        let map = map_status(snapshot, 0, None);
        let known = map.cells.iter().map(|cell| Cell {
            cell: cell.cell_id,
            n_gaussians: cell.n_gaussians,
            state: if cell.generation == map.generation { CellState::OnBoard } else { CellState::Stale },
            generation: cell.generation,
            box_m: cell.bounds().into(),
        });
        let missing = map.missing.iter().map(|cell| Cell {
            cell: cell.cell_id,
            n_gaussians: 0,
            state: CellState::Missing,
            generation: map.generation,
            box_m: cell.bounds().into(),
        });
        let mut cells: Vec<Cell> = known.chain(missing).collect();
        cells.sort_by_key(|cell| cell.cell);
        let photos = snapshot.shards.iter().flat_map(|shard| {
            let origin = DVec3::from(shard.view().header.origin_in_world);
            shard.additions().photo_poses.into_iter().flat_map(move |photos| Photo::of_shard(origin, photos))
        });
        Ok(Description {
            program: PROGRAM,
            scene: map.scene,
            generation: map.generation,
            n_gaussians: map.n_gaussians,
            up: Vec3::Z,
            metric: snapshot.manifest.metric,
            geographic: map.geo_reference.is_some(),
            can_ask,
            cells,
            views: photos.collect(),
            fetched: Some(Fetched { centre_m: map.centre_in_world, radius_m: map.radius }),
            position_m: robot_in_world(snapshot),
        })
    }

    /// Returns the message of a cell's Gaussians (one in `step`), if on board and of `generation` or that is absent.
    pub(crate) fn view_cell(
        &self,
        cell_id: u32,
        generation: Option<u64>,
        step: Step,
        budget: &Budget,
    ) -> Result<Option<Vec<u8>>, QueryError> {
        let snapshot = self.snapshot()?;
        let is_asked_for = generation.is_none_or(|asked| asked == snapshot.manifest.generation);
        let found = snapshot.shards.iter().find(|shard| shard.cell.cell_id == cell_id);
        let Some(shard) = found.filter(|_| is_asked_for) else { return Ok(None) };
        let view = shard.view();
        let sent = step.indices(view.header.n_gaussians as usize);
        budget.take(CELL_HEAD_BYTES + sent.len() * (GAUSSIAN_BYTES + size_of::<DVec3>()));
        budget.check()?;
        let positions: Vec<DVec3> = sent.map(|at| view.position_in_world(at)).collect();
        Ok(Some(cell_message(&positions, shard.additions().appearance, step)))
    }

    /// Returns the names of the things on board, each with the number of things it is best for; then the remaining
    /// words of a model with a limited vocabulary.
    pub(crate) fn view_words(&self, budget: &Budget) -> Result<Words, QueryError> {
        let on_board = self.on_board()?;
        on_board.check()?;
        let generation = on_board.snapshot.manifest.generation;
        let Some(names) = self.names(&on_board, NAMES_WAIT, budget)? else {
            return Ok(Words::pending(generation));
        };
        let best = (0..names.len()).filter_map(|object| names.of(object).next());
        Ok(Words::new(generation, best, on_board.text.nouns()))
    }

    pub(crate) fn view_scores(
        &self,
        text: String,
        negatives: Negatives,
        budget: &Budget,
    ) -> Result<Vec<u8>, QueryError> {
        let request = QueryRequest { negatives, ..QueryRequest::new(text.as_str()) };
        request.check()?;
        let on_board = self.on_board()?;
        on_board.check()?;
        let negatives = on_board.encode_negatives(&request)?;
        let question = Question { negatives, ..Question::new(on_board.encode(&text)?) };
        let scene = Scene::of(&on_board.snapshot);
        Ok(scores_message(&scene.shards, &question, scene.manifest.generation, budget)?)
    }
}

fn scores_message(
    shards: &[ShardView<'_>],
    question: &Question,
    generation: u64,
    budget: &Budget,
) -> Result<Vec<u8>, ScoreError> {
    let cells: Vec<(u32, u32)> =
        shards.iter().map(|shard| (shard.header.cell_id, shard.header.n_gaussians)).collect();
    budget.take(ScoresMessage::len(cells.len(), cells.iter().map(|(_, n)| *n as usize).sum()));
    let (questions, everywhere) = (std::slice::from_ref(question), Region::default());
    let searches = Search::batch(shards, questions, &everywhere, Precision::Centroids, budget)?;
    let mut runs = searches[0].matching(BELOW_ALL).runs;
    budget.check()?;
    if !question.negatives.is_empty() {
        runs.iter_mut().for_each(|run| run.score = relevancy(run.score));
    }
    let least = runs.iter().map(|run| run.score).reduce(f32::min).unwrap_or(0.0);
    let largest = runs.iter().map(|run| run.score).reduce(f32::max).unwrap_or(0.0);
    let mut message = ScoresMessage::new(generation, [least, largest], &cells);
    for run in runs {
        message.fill(run.shard as usize, run.start as usize..run.end as usize, run.score);
    }
    Ok(message.into_bytes())
}
