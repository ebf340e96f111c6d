// Everything that the page asks of the program that served it. Nothing else is ever fetched.

import { type CellGaussians, type Scores, readCell, readScores } from "./messages";

export type Vector = [number, number, number];

export interface Cell {
  cell: number;
  n_gaussians: number;
  state: "on_board" | "missing";
  appearance: boolean;
  box_m: { min: Vector; max: Vector };
  origin_m: Vector;
}

export interface Photo {
  name: string;
  position_m: Vector;
  rotation_xyzw: [number, number, number, number];
  width_px: number;
  height_px: number;
  focal_px: number;
}

/** Reply of `GET /v1/view`. */
export interface Description {
  program: string;
  scene: string;
  generation: number;
  n_gaussians: number;
  up: Vector;
  geographic: boolean;
  cells: Cell[];
  views: Photo[];
  position: { position_m?: Vector; radius_m?: number } | null;
}

export interface Answer {
  id?: string;
  position_in_world: Vector;
  box_min_in_world: Vector;
  box_max_in_world: Vector;
  oriented_box?: { centre_in_world: Vector; size: Vector; rotation_world_from_box: [number, number, number, number] };
  score: number;
  n_gaussians?: number;
  evidence?: { photo: string };
  position_geographic?: { lat: number; lon: number };
}

export interface Answers {
  answers: Answer[];
  threshold: number | null;
  none: string | null;
}

export interface Question {
  text: string;
  negatives: string[];
}

export class Unauthorized extends Error {}
export class NotFound extends Error {}
export class Offline extends Error {}

const TOKEN = "slag-token";

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

async function get(path: string, signal?: AbortSignal): Promise<Response> {
  const token = sessionStorage.getItem(TOKEN);
  let response: Response;
  try {
    response = await fetch(path, { signal, headers: token ? { authorization: `Bearer ${token}` } : {} });
  } catch (error) {
    if (signal?.aborted) throw error;
    throw new Offline("The service cannot be reached. The page tries again by itself.");
  }
  if (response.ok) return response;
  if (response.status === 401) throw new Unauthorized("This service asks for its token.");
  const problem = (await response.json().catch(() => null)) as { detail?: string } | null;
  const detail = problem?.detail ?? `${path.split("?")[0]}: status ${response.status}`;
  throw response.status === 404 ? new NotFound(detail) : new Error(detail);
}

export async function describe(): Promise<Description> {
  return (await get("/v1/view")).json();
}

export async function fetchCell(cell: number, generation: number): Promise<CellGaussians> {
  return readCell(await (await get(`/v1/view/cells/${cell}?generation=${generation}`)).arrayBuffer());
}

export async function fetchScores(question: Question, signal: AbortSignal): Promise<Scores> {
  const parameters = new URLSearchParams({ text: question.text });
  for (const negative of question.negatives) parameters.append("negative", negative);
  return readScores(await (await get(`/v1/view/scores?${parameters}`, signal)).arrayBuffer());
}

/** The things that answer a question; the robot's `/v1/query`, or `/query` where that is absent. */
export async function fetchAnswers(question: Question, signal: AbortSignal): Promise<Answers> {
  const parameters = new URLSearchParams({ text: question.text, limit: "20" });
  if (question.negatives.length > 0) parameters.set("negatives", question.negatives.join(","));
  try {
    const reply = await (await get(`/v1/query?${parameters}`, signal)).json();
    const result = reply.results[0];
    return { answers: result.answers, threshold: result.parts?.[0]?.threshold ?? null, none: result.none?.detail ?? null };
  } catch (error) {
    if (!(error instanceof NotFound)) throw error;
  }
  const reply = await (await get(`/query?${parameters}`, signal)).json();
  return { answers: reply.answers ?? [], threshold: reply.threshold ?? null, none: reply.none?.detail ?? null };
}
