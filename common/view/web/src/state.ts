// What a link to the page holds: questions, threshold and camera, in the address's fragment; and the history of
// questions, the browser's and the one that is suggested.

import type { Vector } from "./network";

export interface State {
  question: string;
  /** A second one, beside it. */
  second: string;
  /** A score, or null for the encoder's own threshold. */
  threshold: number | null;
  camera: { position: Vector; target: Vector } | null;
}

const HISTORY = "slag-history";
/** A question that stood shorter was on the way to another: it has no entry of its own in the browser's history. */
const SETTLED_MS = 2000;

let askedMs = -Infinity;

export function readState(fragment = location.hash): State {
  const parameters = new URLSearchParams(fragment.replace(/^#/, ""));
  const threshold = Number.parseFloat(parameters.get("threshold") ?? "");
  const numbers = (parameters.get("camera") ?? "").split(",").map(Number.parseFloat);
  const isCamera = numbers.length === 6 && numbers.every(Number.isFinite);
  return {
    question: (parameters.get("q") ?? "").slice(0, 500),
    second: (parameters.get("and") ?? "").slice(0, 500),
    threshold: Number.isFinite(threshold) ? threshold : null,
    camera: isCamera ? { position: numbers.slice(0, 3) as Vector, target: numbers.slice(3) as Vector } : null,
  };
}

/** Writes the address; another question is another entry of the browser's history. */
export function writeState(state: State): void {
  const parameters = new URLSearchParams();
  if (state.question) parameters.set("q", state.question);
  if (state.second) parameters.set("and", state.second);
  if (state.threshold !== null) parameters.set("threshold", state.threshold.toFixed(3));
  if (state.camera) parameters.set("camera", [...state.camera.position, ...state.camera.target].map((v) => v.toFixed(3)).join(","));
  const written = new URLSearchParams(location.hash.slice(1));
  const isOther = ["q", "and"].some((name) => (written.get(name) ?? "") !== (parameters.get(name) ?? ""));
  const isNew = isOther && performance.now() - askedMs > SETTLED_MS;
  if (isOther) askedMs = performance.now();
  history[isNew ? "pushState" : "replaceState"](null, "", `#${parameters}`);
}

export function readHistory(): string[] {
  try {
    const found: unknown = JSON.parse(localStorage.getItem(HISTORY) ?? "[]");
    return Array.isArray(found) ? found.filter((entry) => typeof entry === "string").slice(0, 20) : [];
  } catch {
    return [];
  }
}

export function remember(question: string): void {
  localStorage.setItem(HISTORY, JSON.stringify([question, ...readHistory().filter((entry) => entry !== question)].slice(0, 20)));
}
