// Everything that the page asks of the program that served it. Nothing else is ever fetched.

import { type CellGaussians, type Scores, readCell, readScores } from "./messages";

export type Vector = [number, number, number];

export interface Cell {
  cell: number;
  n_gaussians: number;
  /** Stale: of an earlier generation. */
  state: "on_board" | "stale" | "missing";
  generation: number;
  box_m: { min: Vector; max: Vector };
}

export interface Photo {
  name: string;
  position_m: Vector;
  rotation_xyzw: [number, number, number, number];
  width_px: number;
  height_px: number;
  focal_px: number;
  /** Whether `/v1/view/photos/{name}` has the picture. */
  has_picture: boolean;
}

/** Reply of `GET /v1/view`. */
export interface Description {
  program: string;
  scene: string;
  generation: number;
  n_gaussians: number;
  up: Vector;
  metric: boolean;
  geographic: boolean;
  can_ask: boolean;
  cells: Cell[];
  views: Photo[];
  /** What a robot fetched. */
  fetched?: { centre_m: Vector; radius_m: number };
  /** Where a robot is. */
  position_m?: Vector;
}

export interface Answer {
  id?: string;
  position_in_world: Vector;
  box_min_in_world: Vector;
  box_max_in_world: Vector;
  oriented_box?: { centre_in_world: Vector; size: Vector; rotation_world_from_box: [number, number, number, number] };
  score: number;
  n_gaussians?: number;
  evidence?: { photo: string; box_px: [number, number, number, number]; has_thumbnail?: boolean };
  geographic?: { latitude_deg: number; longitude_deg: number; height_m: number };
  /** How well the relation of a phrase holds, 0.5 to 1. */
  degree?: number;
  /** Of an object that was clicked, the likeliest first. */
  names?: { name: string; confidence: number }[];
  related_to?: { thing: string; position_in_world: Vector; score?: number }[];
}

/** Ids of objects begin with o; those of groups of Gaussians are numbers. */
export const isObject = ({ id }: Answer): boolean => id?.startsWith("o") ?? false;

/** A thing of a generation. */
export interface Thing {
  id: string;
  position_in_world: Vector;
  box_in_world: { min: Vector; max: Vector };
}

/** Reply of `/v1/changes`: from the generation before to the present one. */
export interface Changes {
  old_generation: number;
  new_generation: number;
  n_same: number;
  n_stayed: number;
  appeared: Thing[];
  went: Thing[];
  moved: { from: Thing; to: Thing }[];
}

/** A word to ask for, and how many things are found by it. */
export interface Word {
  word: string;
  n_things: number;
}

/** A place to stand; `/v1/goal` says more. */
export interface Goal {
  position_in_world: Vector;
  yaw_rad: number;
  sensor_in_world: Vector;
  clearance_m: number;
  visible_share: number;
  path_m: number;
}

/** Places to stand near a thing, or the reason why there is none. */
export interface Goals {
  goals: Goal[];
  thing: Vector | null;
  none: { kind: string; detail: string } | null;
}

export interface Answers {
  /** What was looked for: the question, or the thing of a phrase such as "mug on the table". */
  thing: string;
  answers: Answer[];
  /** Whether there are more answers than these. */
  hasMore?: boolean;
  threshold: number | null;
  none: string | null;
  /** Whether they answer words alone: groups of Gaussians may stand in for objects. */
  isPlain: boolean;
  /** What was asked in place of words that the model does not know. */
  askedAs: Record<string, string>;
  /** Best score of what was not found, if the service says it. */
  best: number | null;
  /** Whether that is of a Gaussian. */
  isOfPoints?: boolean;
  isBelowThreshold: boolean;
  /** Whether they do not reach the threshold, and are shown because that was wanted. */
  isNearest?: boolean;
  /** The question as parameters of an address. */
  query: string;
  /** From where relations were seen, if that counted. */
  seenFrom: string | null;
}

export interface Question {
  text: string;
  negatives: string[];
}

/** Who asks: where, and looking where, from x towards y; `from` in words. */
export interface Asker {
  at: Vector;
  headingRad: number | null;
  from: string;
}

/** A parameter is missing or wrong. */
export class Refused extends Error {
  constructor(detail: string, readonly parameter: string) {
    super(detail);
  }
}
export class Unauthorized extends Error {}
export class NotFound extends Error {}
export class Offline extends Error {}

const TOKEN = "slag-token";
/** Answers that are shown. */
export const MAX_ANSWERS = 20;

export function setToken(token: string): void {
  sessionStorage.setItem(TOKEN, token);
}

/** `chair -wall` asks for chairs, not walls. */
export function parseQuestion(line: string): Question {
  const words = line.trim().split(/\s+/).filter(Boolean);
  return {
    text: words.filter((word) => !/^-\p{L}/u.test(word)).join(" "),
    negatives: words.filter((word) => /^-\p{L}/u.test(word)).map((word) => word.slice(1)),
  };
}

async function get(path: string, signal?: AbortSignal, body?: Blob): Promise<Response> {
  const token = sessionStorage.getItem(TOKEN);
  let response: Response;
  try {
    response = await fetch(path, { signal, body, method: body ? "POST" : "GET", headers: { ...(token ? { authorization: `Bearer ${token}` } : {}), ...(body ? { "content-type": body.type } : {}) } });
  } catch (error) {
    if (signal?.aborted) throw error;
    throw new Offline("The service cannot be reached. The page tries again by itself.");
  }
  if (response.ok) return response;
  if (response.status === 401) throw new Unauthorized("This service asks for its token.");
  const problem = (await response.json().catch(() => null)) as { detail?: string; parameter?: string } | null;
  const detail = problem?.detail ?? `${path.split("?")[0]}: status ${response.status}`;
  if (problem?.parameter) throw new Refused(detail, problem.parameter);
  throw response.status === 404 ? new NotFound(detail) : new Error(detail);
}

export async function describe(): Promise<Description> {
  return (await get("/v1/view")).json();
}

/** What changed since the generation before, from a store's page or a robot's. */
export async function fetchChanges(): Promise<Changes> {
  const reply = await (await get("/v1/changes")).json();
  if (reply.to === undefined) return reply;
  if (reply.none) throw new Error(reply.none.detail);
  const thing = (of: { id: string; position_in_world: Vector; box_min_in_world: Vector; box_max_in_world: Vector }): Thing =>
    ({ id: of.id, position_in_world: of.position_in_world, box_in_world: { min: of.box_min_in_world, max: of.box_max_in_world } });
  return {
    old_generation: reply.from.generation, new_generation: reply.to.generation, n_same: reply.n_same, n_stayed: reply.n_stayed,
    appeared: reply.appeared.map(thing), went: reply.went.map(thing),
    moved: reply.moved.map(({ from, to }: { from: Parameters<typeof thing>[0]; to: Parameters<typeof thing>[0] }) => ({ from: thing(from), to: thing(to) })),
  };
}

/** How old a robot's scene is. */
export async function fetchMap(): Promise<{ age_secs: number; is_expired: boolean }> {
  return (await get("/v1/map")).json();
}

/** The smallest object on a robot whose box holds a point, or nearly. */
export async function fetchObjectAt(point: Vector): Promise<Answer | null> {
  const parameters = new URLSearchParams({ near: point.join(","), radius: "5", limit: "100" });
  const { objects } = (await (await get(`/v1/objects?${parameters}`)).json()) as { objects: Answer[] };
  const NEAR_M = 0.05;
  const holds = (object: Answer) => point.every((v, i) => v >= object.box_min_in_world[i] - NEAR_M && v <= object.box_max_in_world[i] + NEAR_M);
  const volume = (object: Answer) => object.box_max_in_world.reduce((product, v, i) => product * (v - object.box_min_in_world[i]), 1);
  return objects.filter(holds).sort((a, b) => volume(a) - volume(b))[0] ?? null;
}

/** Where a robot says that a photo was taken; axes of the camera as in `Photo`. */
export type Located =
  | { state: "found"; position_in_world: Vector; optical_rotation_xyzw: Photo["rotation_xyzw"]; n_inliers: number; verified_by: "landmarks" | "rendering" }
  | { state: "unsure" | "lost"; reason: string };

/** Asks a robot where a JPEG or PNG was taken by a camera without lens distortion. */
export async function locatePhoto(photo: Blob, focalPx: number): Promise<Located> {
  return (await get(`/v1/locate?focal_px=${focalPx.toFixed(2)}`, undefined, photo)).json();
}

/** Words to ask for, those of most things first; `complete`: whether all are counted. */
export async function fetchWords(): Promise<{ words: Word[]; complete: boolean }> {
  return (await get("/v1/view/words")).json();
}

/** The picture of a photo, by its index in the description. */
export async function fetchPhoto(index: number): Promise<Blob> {
  return (await get(`/v1/view/photos/${index}`)).blob();
}

/** The small picture of an object. */
export async function fetchThumbnail(id: string): Promise<Blob> {
  return (await get(`/v1/objects/${id}/thumbnail`)).blob();
}

/** Hands on a robot's events until the connection ends. */
export async function follow(onEvent: (name: string, data: unknown) => void): Promise<void> {
  const reader = (await get("/v1/events")).body?.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const read = await reader?.read();
    if (!read || read.done) return;
    text += read.value;
    const events = text.split("\n\n");
    text = events.pop() ?? "";
    for (const event of events) {
      const [name, data] = ["event: ", "data: "].map((field) => event.split("\n").find((line) => line.startsWith(field))?.slice(field.length));
      if (name && data) onEvent(name, JSON.parse(data));
    }
  }
}

/** The Gaussians of a cell, every `step`-th. */
export async function fetchCell(cell: number, generation: number, step: number): Promise<CellGaussians> {
  return readCell(await (await get(`/v1/view/cells/${cell}?generation=${generation}&step=${step}`)).arrayBuffer());
}

function parametersOf(question: Question): URLSearchParams {
  const parameters = new URLSearchParams({ text: question.text });
  for (const negative of question.negatives) parameters.append("negative", negative);
  return parameters;
}

export async function fetchScores(question: Question, signal: AbortSignal): Promise<Scores> {
  return readScores(await (await get(`/v1/view/scores?${parametersOf(question)}`, signal)).arrayBuffer());
}

/** Places to stand near a thing, by its id; a robot's radius in metres. */
export async function fetchGoals(id: string, radiusM: number, signal: AbortSignal): Promise<Goals> {
  const parameters = new URLSearchParams({ id, radius_m: String(radiusM) });
  const reply = await (await get(`/v1/goal?${parameters}`, signal)).json();
  return { goals: reply.goals, thing: reply.thing?.position_in_world ?? null, none: reply.none };
}

/**
 * The things that answer a question. `askers`: tried in turn where a relation depends on who asks ("chair near me"),
 * and only then: the asker's place changes the order of all answers.
 * One answer more than are shown tells that there are more.
 */
export async function fetchAnswers(question: Question, signal: AbortSignal, askers: Asker[]): Promise<Answers> {
  const parameters = parametersOf(question);
  const ask = async () => (await (await get(`/v1/query?${parameters}&limit=${MAX_ANSWERS + 1}`, signal)).json()).results[0];
  let seenFrom: string | null = null;
  let result;
  for (const left = [...askers]; !result;) {
    try {
      result = await ask();
    } catch (error) {
      const asker = error instanceof Refused && /^(near|heading_rad)$/.test(error.parameter) ? left.shift() : null;
      if (!asker) throw error;
      parameters.set("near", asker.at.map((v) => Number(v.toFixed(3))).join(","));
      if (asker.headingRad !== null) parameters.set("heading_rad", asker.headingRad.toFixed(4));
      seenFrom = asker.from;
    }
  }
  return {
    thing: result.understood?.thing ?? question.text,
    answers: result.answers,
    threshold: result.threshold ?? result.parts?.[0]?.threshold ?? null,
    none: result.none?.detail ?? null,
    isPlain: !result.understood,
    askedAs: result.asked_as ?? {},
    best: result.none?.best_score ?? null,
    isBelowThreshold: result.none?.kind === "below-threshold",
    query: String(parameters),
    seenFrom,
  };
}
