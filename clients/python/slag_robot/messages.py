"""The messages of slag-edge's API, as GET /openapi.json describes them. Written by generate.py; do not edit."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Mapping, Optional, Sequence


@dataclass(frozen=True)
class Witness:
    """A thing that another is related to."""

    thing: str
    """The words that it answers to."""
    position_in_world: Sequence[float]
    """Where it is."""
    id: Optional[str] = None
    """Its id; absent for the asker."""
    score: Optional[float] = None
    """Its score with the words; absent for the asker."""


@dataclass(frozen=True)
class Answer:
    """An answer, with the frame and the generation of its positions."""

    frame: str
    """Frame of every position: the scene's world frame."""
    generation: int
    """Generation that every position belongs to."""
    rank: int
    """Position in the list, from 1."""
    position_in_world: Sequence[float]
    """Mean of its Gaussians inside the box."""
    score: float
    """Mean score of its Gaussians; for an object, of its masks."""
    best_score: Optional[float] = None
    """Best score of its Gaussians; for an object, its score."""
    box_max_in_world: Optional[Sequence[float]] = None
    """Largest corner: 98th percentile."""
    box_min_in_world: Optional[Sequence[float]] = None
    """Smallest corner of its box: the 2nd percentile along each axis, so that floaters do not count."""
    cell_id: Optional[int] = None
    """Its cell."""
    degree: Optional[float] = None
    """For a phrase: degree of its relation, 0.5 to 1."""
    distance: Optional[float] = None
    """Distance of the position from `near`."""
    evidence: Optional[Mapping[str, Any]] = None
    """For an object: the photo that shows it best."""
    geographic: Optional[Mapping[str, Any]] = None
    """The same as latitude, longitude and height, if the scene is geo-referenced."""
    id: Optional[str] = None
    """For a cluster, the cell and index of its first Gaussian: valid within a generation. For an object, `o` and 16
    hex digits: valid as long as its Gaussians stay the same."""
    index: Optional[int] = None
    """Its index in the cell's shard."""
    input_index: Optional[int] = None
    """Its index in the input splat file, if the shard knows it."""
    n_gaussians: Optional[int] = None
    """Its Gaussians; for an object, those on board in the region asked for."""
    n_gaussians_in_scene: Optional[int] = None
    """For an object: its Gaussians in the whole scene."""
    oriented_box: Optional[Mapping[str, Any]] = None
    """Its box along axes of its own, upright if the world has a known up."""
    related_to: Sequence[Witness] = ()
    """For a phrase: what the answer is related to."""
    relevance: Optional[float] = None
    """Key of the ranking: (score - base) / (1 + distance / 10 m), 0 below base; base is the mean score of unrelated
    texts for cosines, 0 for relevancies; without a metric scale 10 m is 40 default voxels."""
    size: Optional[Sequence[float]] = None
    """Edges of the box."""
    whole: Optional[Mapping[str, Any]] = None
    """For an object that the region asked for cuts: where the whole of it is. Everything else describes the part
    inside."""
    more: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """The whole message as the robot sent it."""


@dataclass(frozen=True)
class Nothing:
    """Why nothing was found."""

    kind: str
    """The reason."""
    detail: str
    """The same in words."""
    best_degree: Optional[float] = None
    """Greatest degree of the relation among all pairs; it holds from 0.5."""
    best_position_in_world: Optional[Sequence[float]] = None
    """Where the best score is."""
    best_score: Optional[float] = None
    """Best score found."""
    seen_share: Optional[float] = None
    """Share of the Gaussians on board in the region asked for that a used view saw; absent where there are none."""
    thing: Optional[str] = None
    """The part of a phrase that failed."""


@dataclass(frozen=True)
class Result:
    """The answers to one question."""

    question: Mapping[str, Any]
    """The question."""
    understood: Optional[Mapping[str, Any]]
    """The phrase that a text was understood as, if it names a relation."""
    kind: str
    """Kind of the answers."""
    none: Optional[Nothing]
    """Why nothing was found; null if something was."""
    next_offset: Optional[int]
    """`offset` of the next page; null if there is none."""
    answers: Sequence[Answer]
    """The answers, best first."""
    area_fetched: Optional[bool] = None
    """Whether all cells in the region asked for, or of the whole scene, are on board."""
    asked_as: Optional[Mapping[str, Any]] = None
    """What was asked in place of words that the model does not know."""
    bad_cells: Sequence[Mapping[str, Any]] = ()
    """Cells in the region asked for whose shards could not be fetched."""
    clustering: Optional[Mapping[str, Any]] = None
    """How matches were clustered; only for `kind=clusters`."""
    is_exact: Optional[bool] = None
    """Whether exactly the Gaussians at or above the threshold match. Otherwise a Gaussian with a score within
    `score_error_bound` of the threshold may be misplaced."""
    n_cells_not_fetched: Optional[int] = None
    """Number of these cells that were not fetched."""
    n_matching: Optional[int] = None
    """Gaussians that match."""
    n_searched: Optional[int] = None
    """Gaussians with an embedding in the shards searched."""
    negatives: Sequence[str] = ()
    """Negative prompts."""
    parts: Sequence[Mapping[str, Any]] = ()
    """For phrases: the things that they name."""
    score_error_bound: Optional[float] = None
    """Bound on the error of every score."""
    score_error_likely: Optional[float] = None
    """For 95 of 100 questions, 99 of 100 scores of each shard err by no more: measured over texts that the codebook
    was not made for. With negatives, for 90 of 100. Absent if answers are exact or it was not measured."""
    score_kind: Optional[str] = None
    """Meaning of scores."""
    threshold: Optional[float] = None
    """Score at or above which a Gaussian matches."""
    threshold_source: Optional[str] = None
    """Source of the threshold."""
    more: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """The whole message as the robot sent it."""


@dataclass(frozen=True)
class Reply:
    """The reply of version 1, to one question or many."""

    scene: str
    """Name of the scene."""
    generation: int
    """Generation that answers."""
    frame: str
    """Frame of every position: the scene's world frame."""
    unit: str
    """Unit of every position and length; world: the model is not metric."""
    results: Sequence[Result]
    """One for each question: texts, then vectors, then phrases."""


@dataclass(frozen=True)
class Goal:
    """A pose to stand in, in the scene's world frame: x forward, y left, z up (REP-103)."""

    position_in_world: Sequence[float]
    """The ground below the robot's middle."""
    yaw_rad: float
    """Direction of x, towards the middle of what is seen: from the world's x towards its y."""
    orientation_xyzw: Sequence[float]
    """The same as a quaternion: x, y, z, w."""
    sensor_in_world: Sequence[float]
    """The sensor."""
    clearance_m: float
    """Horizontal distance from the robot's middle to what it must not touch."""
    visible_share: float
    """Share of the thing's sampled Gaussians that the sensor sees."""
    path_m: float
    """Length of the way, along eight directions: up to 8 % longer than a straight one."""
    distance_m: float
    """Horizontal distance from the robot's middle to the thing's surface."""
    cost_m: float
    """What the poses are ordered by: way, clearance and sight, in metres of way."""
    geographic: Optional[Mapping[str, Any]] = None
    """The same on the earth, if the scene is geo-referenced."""


@dataclass(frozen=True)
class Changed:
    """A thing as it is or was."""

    id: str
    """Its id in its generation: `o` and 16 hex digits."""
    position_in_world: Sequence[float]
    """Mean of its Gaussians inside the box."""
    box_min_in_world: Sequence[float]
    """Smallest corner of its box."""
    box_max_in_world: Sequence[float]
    """Largest corner."""
    n_gaussians_in_scene: int
    """Its Gaussians in the whole scene."""
    photo: str
    """Name of the photo that shows it best."""
    geographic: Optional[Mapping[str, Any]] = None
    """The same on the earth, if the scene is geo-referenced."""
    like: Optional[Mapping[str, Any]] = None
    """The text that it is most like, if the request has any."""


@dataclass(frozen=True)
class Moved:
    """A thing that lies elsewhere."""

    before: Changed
    """As it was."""
    now: Changed
    """As it is."""
    distance: float
    """Between the positions."""
